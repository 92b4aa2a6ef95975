"""One Crazyflie's flight firmware: setpoints in, a velocity command for the vehicle model out.

Everything that a person could do wrong with a real one goes wrong here, too: a high-level command while setpoints are
streamed has no effect until the stream is declared over; a stream that is declared over while the high-level commander
has nothing to fly stops the motors; old setpoints end in a fall, an emergency stop is for good. What is followed is the
firmware of 2025.02 and later.
"""

from __future__ import annotations

import errno
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from dtsa_agent.crazyflie.state import decompress_quaternion, yaw_of

from .planner import DISABLED, FLYING, IDLE, LANDING, Goal, Planner, Triple
from .supervisor import LEVEL_OUT, FirmwareSupervisor

# What the vehicle does during a step.
OFF = "off"  # motors stopped: it falls, or stands
FLY = "fly"  # follows a velocity command
LEVEL = "level"  # attitude level: drifts on, only drag slows it down; height is still controlled

POSITION_GAIN = 2.0  # 1/s
PRIORITY_NONE, PRIORITY_HIGH_LEVEL, PRIORITY_STREAM = 0, 1, 2  # an app's may be higher

# Of the battery, a single lithium cell.
FULL_V = 4.15
EMPTY_V = 3.25
SAG_V = 0.15  # while the motors run
FLIGHT_S = 420.0  # a full cell's time in the air
IDLE_S = 7200.0


class Battery:
    """Charge of one cell, and the voltage that it shows under load."""

    def __init__(self, charge: float = 1.0) -> None:
        self.charge = charge  # 1 full; may go below 0 by force, to show what the firmware makes of it
        self.voltage = FULL_V
        self.update(0.0, motors=False)

    def update(self, dt: float, *, motors: bool) -> None:
        """Use energy for dt seconds."""
        if dt and self.charge > 0:
            self.charge = max(0.0, self.charge - dt / (FLIGHT_S if motors else IDLE_S))
        self.voltage = EMPTY_V + (FULL_V - EMPTY_V) * self.charge - (SAG_V if motors else 0.0)

    def force(self, voltage: float, *, motors: bool) -> None:
        """Set the charge so that this voltage (V) is shown at the present load."""
        self.charge = (voltage + (SAG_V if motors else 0.0) - EMPTY_V) / (FULL_V - EMPTY_V)
        self.update(0.0, motors=motors)


@dataclass(slots=True)
class FirmwareSetpoint:
    """What a streamed command or the planner asks for; None: that axis is not controlled so."""

    time: float
    position: Triple | None = None
    velocity: Triple | None = None
    acceleration: Triple = (0.0, 0.0, 0.0)
    body_velocity: tuple[float, float] | None = None  # m/s, forward and left
    height: float | None = None  # m
    yaw: float | None = None  # rad
    yaw_rate: float = 0.0  # rad/s
    motors: bool = True


# Length of a packet on the generic commander's port, by its type: stop, full state, position, velocity, hover. 8 and 10
# count yaw rates as usual; the older 1 and 5 have the opposite sign and are not sent to protocol version 9 and later.
LENGTHS = {0: 1, 6: 29, 7: 17, 8: 17, 10: 17}


def decode_setpoint(data: bytes, t: float) -> FirmwareSetpoint:
    """The setpoint of such a packet that came at t (s)."""
    kind = data[0]
    if kind == 0:
        return FirmwareSetpoint(t, motors=False)
    if kind == 6:
        values = struct.unpack_from("<9hI3h", data, 1)
        position, velocity, acceleration = (
            (values[i] / 1000, values[i + 1] / 1000, values[i + 2] / 1000) for i in (0, 3, 6)
        )
        yaw = yaw_of(decompress_quaternion(values[9]))
        return FirmwareSetpoint(t, position, velocity, acceleration, yaw=yaw, yaw_rate=values[12] / 1000)
    a, b, c, d = struct.unpack_from("<4f", data, 1)
    if kind == 7:
        return FirmwareSetpoint(t, position=(a, b, c), yaw=math.radians(d))
    if kind == 8:
        return FirmwareSetpoint(t, velocity=(a, b, c), yaw_rate=math.radians(d))
    return FirmwareSetpoint(t, body_velocity=(a, b), height=d, yaw_rate=math.radians(c))


class Firmware:
    """Commander, high-level commander, supervisor and battery of one Crazyflie. Times (`t`) are s, the fleet's clock.

    `report` is called with the name of each event and details. Wanted accelerations make up for `tau`, the lag (s) of
    the vehicle's velocity.
    """

    def __init__(self, report: Callable[..., None], tau: float, *, auto_arming: bool = False) -> None:
        self._report = report
        self._tau = tau
        self._auto_arming = auto_arming
        self.reset()

    def reset(self) -> None:
        """Power on."""
        self.supervisor = FirmwareSupervisor(self._report, auto_arming=self._auto_arming)
        self.planner = Planner()
        self.groups = 0  # a bit each
        self.battery = Battery()
        self.setpoint: FirmwareSetpoint | None = None
        self.priority = PRIORITY_NONE  # of the source whose setpoint counts
        self._streaming = False
        self._here = Goal()  # where a path would begin: on the present path, or where the vehicle is
        self.yaw = 0.0

    # -- commands from the radio ------------------------------------------------------------------------------------
    def stream(self, data: bytes, t: float) -> None:
        """A packet of the generic commander: a streamed setpoint."""
        if data and len(data) >= LENGTHS.get(data[0], math.inf):
            self.offer(decode_setpoint(data, t), PRIORITY_STREAM)

    def manual(self, data: bytes, t: float) -> None:
        """Roll, pitch, yaw rate, thrust: only thrust 0 (stop) and level flight are modelled."""
        *_, thrust = struct.unpack_from("<3fH", data)
        self.offer(FirmwareSetpoint(t, velocity=(0.0, 0.0, 0.0), motors=thrust > 0), PRIORITY_STREAM)

    def offer(self, setpoint: FirmwareSetpoint, priority: int) -> bool:
        """Accept a setpoint from a source of this priority; False: one of a higher priority counts."""
        if priority < self.priority:
            return False
        self.priority = priority
        self.setpoint = setpoint
        if priority > PRIORITY_HIGH_LEVEL:
            self.planner.state = IDLE
            if not self._streaming:
                self._streaming = True
                self._report("streaming")
        return True

    def notify_stop(self) -> None:
        """The stream of setpoints is over: high-level commands count again."""
        if self.priority > PRIORITY_HIGH_LEVEL:
            self.priority = PRIORITY_HIGH_LEVEL
            self._streaming = False
            self._report("stream ended")

    def high_level(self, data: bytes, t: float) -> int:
        """A packet of the high-level commander; 0, or an error number of the firmware's. There are no trajectories."""
        kind = data[0] if data else -1
        lengths = {3: 2, 7: 15, 8: 15, 12: 24}
        if len(data) < lengths.get(kind, math.inf):
            return errno.ENOEXEC
        if kind != 3 and not self.supervisor.motors_allowed:
            return errno.EBUSY
        if data[1] and not data[1] & self.groups:
            return 0
        if kind == 3:
            self.planner.state = IDLE
            self._report("high-level stop")
            return 0
        here = self._here
        if kind == 12:
            _, relative, _, x, y, z, yaw, duration = struct.unpack_from("<B??5f", data, 1)
            if relative:
                x, y, z = (a + b for a, b in zip((x, y, z), here.position, strict=True))
                yaw += self.yaw
            self.planner.plan(FLYING, t, here, (x, y, z), yaw, duration)
            self._report("go_to", goal=[round(v, 3) for v in (x, y, z)])
            return 0
        _, height, yaw, keep_yaw, duration = struct.unpack_from("<Bff?f", data, 1)
        takes_off, state = kind == 7, self.planner.state
        if (takes_off and state != IDLE) or (not takes_off and state == LANDING):  # it flies, or lands, already
            return 1
        place, yaw = (*here.position[:2], height), self.yaw if keep_yaw else yaw
        self.planner.plan(FLYING if takes_off else LANDING, t, Goal(here.position), place, yaw, duration)  # from rest
        self._report("takeoff" if takes_off else "land", height=round(height, 3))
        return 0

    # -- one step of control ----------------------------------------------------------------------------------------
    def step(self, t: float, dt: float, position: Triple, velocity: Triple) -> tuple[str, Triple]:
        """What the vehicle does from t to t + dt by its estimate: OFF, FLY or LEVEL, and the velocity command, m/s."""
        allowed = self.supervisor.motors_allowed
        if not allowed:
            self.planner.state = IDLE
        goal = self.planner.goal(t)
        self._here = goal or Goal(position, velocity, yaw=self.yaw)
        if allowed and self.priority <= PRIORITY_HIGH_LEVEL and self.planner.state != DISABLED:
            self.priority = PRIORITY_HIGH_LEVEL
            self.setpoint = FirmwareSetpoint(t, motors=False)  # if it has nothing to fly
            if goal is not None:
                self.setpoint = FirmwareSetpoint(t, goal.position, goal.velocity, goal.acceleration, yaw=goal.yaw)
        setpoint = self.setpoint if allowed else None
        thrust = setpoint is not None and setpoint.motors
        age = math.inf if setpoint is None else t - setpoint.time
        self.supervisor.update(t, setpoint_age=age, thrust=thrust)
        self.battery.update(dt, motors=thrust)
        if not (thrust and self.supervisor.motors_allowed) or setpoint is None:
            return OFF, (0.0, 0.0, 0.0)
        return LEVEL if self.supervisor.state == LEVEL_OUT else FLY, self._velocity(setpoint, position, dt)

    def _velocity(self, s: FirmwareSetpoint, position: Triple, dt: float) -> Triple:
        if s.yaw is not None:
            self.yaw = s.yaw
        else:
            self.yaw += s.yaw_rate * dt
            self.yaw = math.atan2(math.sin(self.yaw), math.cos(self.yaw))
        if s.body_velocity is not None:
            c, n = math.cos(self.yaw), math.sin(self.yaw)
            vx, vy = s.body_velocity
            height = s.height if s.height is not None else position[2]
            return c * vx - n * vy, n * vx + c * vy, _limit(POSITION_GAIN * (height - position[2]))
        if s.position is None:
            x, y, z = s.velocity or (0.0, 0.0, 0.0)
            return x, y, z if s.height is None else _limit(POSITION_GAIN * (s.height - position[2]))
        # With a speed of its own (planner, full state) the correction is added to it and not limited to 1 m/s.
        error = [POSITION_GAIN * (s.position[i] - position[i]) for i in range(3)]
        if s.velocity is None:
            return _limit(error[0]), _limit(error[1]), _limit(error[2])
        x, y, z = (error[i] + s.velocity[i] + self._tau * s.acceleration[i] for i in range(3))
        return x, y, z


def _limit(v: float) -> float:
    return min(1.0, max(-1.0, v))
