"""What a Crazyflie's firmware has to fly: a stream of commands, a path, a landing, or a velocity without a place.

A set-point's way from the graph to the motors, and what may stop it:

1. **Topic.** `commands` reads each vehicle's `cmd_*` topics in a thread of its own, turns a message into a
   :class:`~dtsa_agent.crazyflie.commands.Setpoint`, dated by its publication, and refuses one that is too fast or leads
   out of the fence.
2. **Whether it counts now** is decided here, in :meth:`Controls.command`. It does not count unless the vehicle is
   armed or flies, after a safety rule has taken the controls (`overruled`, until the next take-off), while motion
   capture does not see the vehicle (`paused`), or while a take-off or go-to is flown to its end (`guard_until`). One
   that counts ends whatever else was flown: a braking, an order that is being repeated.
3. **The link** (`link`) gives it to cflib, whose driver (`drivers`) keeps the newest one until it can be sent.
4. **When the stream stops.** `safety` checks the command's age 50 times a second: first the vehicle holds its place
   (`hold_place`), then it lands (`land`). Both brake by a stream of zero velocity, then give an order to the firmware's
   high-level commander. The order goes out before the end of the stream, or the motors would stop for a moment.

The firmware's high-level commander flies polynomials of degree 7 from rest to rest, whatever the duration. If it is too
short, the vehicle lags behind its path, and a landing stops the motors at the end of the path, wherever the vehicle is.
So durations that no vehicle can keep are refused, and a landing takes longer.

The vehicle's lock protects all of it. Times (`now`, `until`) are s, monotonic.
"""

from __future__ import annotations

import errno
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from .commands import Setpoint, velocity_world
from .link import CrazyflieLink, Send
from .settings import GroundStationSettings
from .state import State, StateMachine, Vector

PEAK = 35 / 16  # largest over mean speed of such a polynomial, at its middle
SHORTEST_S = 0.1  # of any path, however short
MIN_LAND_S = 1.0
# A landing is planned as if from rest, and a path to a place swings out by metres if it begins at high speed: before a
# landing and before holding a place the vehicle is first braked by streamed setpoints of zero velocity.
SLOW_MPS = 0.25
BRAKE_LIMIT_S = 1.5
DOWN_M = 0.04  # m: it stands, by motion capture
STANDSTILL: Vector = (0.0, 0.0, 0.0)
SINK_MPS = 0.3  # of a vehicle that does not know where it is
SINK_MORE_S = 1.5  # s: it sinks that much longer than its last known height takes
BLIND_REPEAT_S, BLIND_REPEATS = 0.5, 3  # a landing that may not have been heard is ordered again
BLIND_LAND_S = 2.0

TAKEOFF, LAND, GO_TO = "take-off", "landing", "go_to"
KINDS = {7: TAKEOFF, 8: LAND, 4: GO_TO, 12: GO_TO}  # by the first byte of the firmware's packets
ACCEPTED = (0, 1)  # 1: it takes off or lands already
REPEAT_S = 0.15
BUSY = 4  # a take-off is ordered so often while the supervisor lets no motor run: 3 s after a landing it goes through a
# state in which none may, also where the vehicle arms itself again at once
ENDS = 2  # the end of a stream of setpoints is not answered: it is sent this often again
ACCEPTS_COMMANDS = frozenset({State.ARMED, State.FLYING})


def shortest_s(distance: float, limit: float) -> float:
    """Shortest duration (s) of a path (m) from rest to rest with a largest speed of `limit` (m/s)."""
    return max(SHORTEST_S, PEAK * abs(distance) / limit)


def too_short(duration: float, distance: float, limit: float) -> str:
    """Why a duration (s) is too short for a distance (m) at a largest speed of `limit` (m/s); empty if it is not."""
    needed = shortest_s(distance, limit)
    if duration >= needed:
        return ""
    return (
        f"duration {duration:.2f} s is too short for {abs(distance):.2f} m: "
        f"at least {needed:.2f} s (station.max_speed_mps is {limit:g})"
    )


def landing_s(distance: float, wanted: float, station: GroundStationSettings) -> float:
    """Duration (s) of a landing over a distance (m): as wanted (0: at the station's speed), or longer if too short."""
    seconds = wanted if wanted > 0.0 else max(MIN_LAND_S, abs(distance) / station.land_speed_mps)
    return max(seconds, shortest_s(distance, station.max_speed_mps))


def end_of_stream(cf: Any) -> None:
    """Tell the firmware that the stream of setpoints is over."""
    cf.commander.send_notify_setpoint_stop()


@dataclass(slots=True)
class _Order:
    kind: str
    send: Send
    end: Send | None  # ends the stream of setpoints before it; None: there was none
    next: float  # s, monotonic, when to send again
    ends: int
    answered: bool = False
    busy: int = 0  # answers that the supervisor lets no motor run


class Delivery:
    """The last high-level order to one Crazyflie: sent again until the firmware has answered."""

    def __init__(self) -> None:
        self._order: _Order | None = None

    def begin(self, kind: str, send: Send, end: Send | None, now: float) -> None:
        """An order of a kind was sent; it replaces the one before, and `end` ends the stream before it."""
        self._order = _Order(kind, send, end, now + REPEAT_S, ENDS if end else 0)

    def cancel(self) -> None:
        """The order does not count any more."""
        self._order = None

    @property
    def landing(self) -> bool:
        """Whether the firmware has answered that it lands."""
        return self._order is not None and self._order.kind == LAND and self._order.answered

    def answered(self, code: int, result: int) -> str:
        """The firmware has answered an order (its first byte) with a result (0, or an errno); why it refuses, or ""."""
        order = self._order
        if order is None or KINDS.get(code) != order.kind or order.answered:
            return ""
        if result in ACCEPTED:
            order.answered = True
            return ""
        if order.kind == TAKEOFF and result == errno.EBUSY:
            order.busy += 1
            if order.busy < BUSY:
                return ""  # `due` sends it again
        self._order = None  # it would refuse it again
        return f"the firmware refuses the {order.kind} (error {result})"

    def due(self, now: float) -> Send | None:
        """What has to be sent now, if anything."""
        order = self._order
        if order is None or now < order.next:
            return None
        order.next = now + REPEAT_S
        if not order.answered:
            return order.send
        if order.ends > 0:
            order.ends -= 1
            return order.end
        return None


class Controls:
    """The present stream, path, braking or landing of one Crazyflie."""

    def __init__(
        self,
        link: CrazyflieLink,
        station: GroundStationSettings,
        machine: StateMachine,
        lock: Any,
        log: Callable[[str], None],
    ) -> None:
        self._link, self._station, self._machine, self._lock, self._log = link, station, machine, lock, log
        self.moved = False  # something that makes it fly was sent since it was armed
        self.overruled = False  # a rule took the controls: streamed commands do not count until the next take-off
        self.paused = False  # held because it is not seen: streamed commands do not count until it is
        self.refused = 0  # streamed commands that did not count
        self.delivery = Delivery()
        self.streaming = False  # the firmware follows streamed commands, not the high-level commander
        self.held = False  # the stream of commands broke off and the place is being held
        self._command_time = -math.inf  # s, of the last streamed command
        self.guard_until = 0.0  # s: a take-off or go-to is flown to its end before streamed commands count again
        self._brake: tuple[float, Callable[[], None]] | None = None  # until when to brake (s), and what comes then
        self._blind: tuple[Vector, float] | None = None  # velocity that needs no place, and until when (s)
        self._landings: list[float] = []  # s: when to repeat a landing that may not have been heard

    @property
    def state_text(self) -> str:
        """The vehicle's state, and why it is in it."""
        return f"{self._machine.state.name.lower()}: {self._machine.reason}"

    def reset(self) -> None:
        """Begin anew, with a new connection."""
        self.overruled = self.paused = self.streaming = self.held = False
        self._command_time = -math.inf
        self._blind = None
        self._landings.clear()
        self.delivery.cancel()

    def stop(self) -> None:
        """Nothing is flown any more."""
        self._brake = self._blind = None
        self.delivery.cancel()

    def command_age(self, now: float) -> float:
        """Seconds since the last streamed command; infinite before the first one."""
        return now - self._command_time

    def setpoint_age(self, now: float) -> float | None:
        """Age of the last of the streamed commands that lead it, or did until they broke off; None: none do."""
        if not (self.streaming or self.held) or self._command_time == -math.inf:
            return None
        return now - self._command_time

    # -- streams and paths ------------------------------------------------------------------------------------------
    def command(self, setpoint: Setpoint) -> bool:
        """Stream a command; False when it is not for the present state."""
        with self._lock:
            early = setpoint.stamp < self.guard_until
            if self._machine.state not in ACCEPTS_COMMANDS or self.overruled or self.paused or early:
                self.refused += 1
                return False
            if self.held:
                self._log("commands again")
            self._command_time = setpoint.stamp
            self.delivery.cancel()
            self.moved = self.streaming = True
            self.held, self._brake = False, None
            self._link.stream(setpoint)
            return True

    def fly(self, kind: str, action: Send, duration: float, now: float, *, again: bool = True) -> None:
        """An order to the high-level commander, and only then the end of the stream of setpoints.

        The other way round the high-level commander would have nothing to fly for a moment, and would stop the motors.
        Streamed commands do not count for the duration (s). `again`: the order is repeated until it is answered.
        """
        streaming, self.streaming, self.held = self.streaming, False, False
        self.guard_until = now + duration
        self._brake = None

        def run(cf: Any) -> None:
            action(cf)
            if streaming:
                end_of_stream(cf)
                if again:
                    action(cf)

        self._link.order(run)
        self.delivery.cancel()
        if again:
            self.delivery.begin(kind, run, end_of_stream if streaming else None, now)

    # -- braking and landing ----------------------------------------------------------------------------------------
    def brake_then(self, action: Callable[[], None], speed: float, now: float) -> None:
        """Slow down from a speed (m/s), then do something."""
        self.delivery.cancel()
        self._brake = (now + BRAKE_LIMIT_S, action)
        self.slow_down(speed, now)

    def slow_down(self, speed: float, now: float) -> None:
        """Go on braking, if it brakes."""
        if self._brake is None:
            return
        end, action = self._brake
        if speed < SLOW_MPS or now > end:
            self._brake = None
            action()
        else:
            self.streaming = True
            self._link.stream(velocity_world(STANDSTILL, 0.0, now))

    def land(self, height: float, way: float, duration: float, now: float) -> None:
        """Sink straight down to a height (m above the floor), over a way (m), and stop the motors."""
        seconds = landing_s(way, duration, self._station)
        self.fly(LAND, lambda cf: cf.high_level_commander.land(height, seconds, yaw=None), math.inf, now)

    def repeat_landing(self, now: float) -> None:
        """Nothing is heard of it: the landing is ordered some more times."""
        self._landings = [now + BLIND_REPEAT_S * (i + 1) for i in range(BLIND_REPEATS)]

    def end_repeats(self) -> None:
        """It is heard: no landing is repeated."""
        self._landings.clear()

    def repeat_due_landing(self, height: float, now: float) -> None:
        """Order the landing from a height (m) once more, when it is time."""
        if self._landings and now >= self._landings[0]:
            self._landings.pop(0)
            self.streaming = True  # it must end a stream that the firmware may still follow
            self.land(0.0, height, BLIND_LAND_S, now)

    # -- without a place --------------------------------------------------------------------------------------------
    @property
    def sinks_blindly(self) -> bool:
        """Whether it sinks without a place."""
        return self._blind is not None and self._blind[0][2] < 0.0

    def end_blind_flight(self) -> None:
        """Let places count again."""
        self._blind = None

    def fly_blindly(self, now: float, sink_from: float | None = None) -> None:
        """Stand still by velocity alone; `sink_from`: or sink for as long as this height (m) takes, and some more."""
        self._blind = STANDSTILL, math.inf
        if sink_from is not None:
            self._blind = (0.0, 0.0, -SINK_MPS), now + sink_from / SINK_MPS + SINK_MORE_S
        self._brake, self.held, self.streaming = None, False, True
        self.delivery.cancel()
        self._link.stream(velocity_world(self._blind[0], 0.0, now))

    def continue_blind_flight(self, in_air: bool, seen: Vector | None, now: float) -> bool:
        """Send the next packet of a stream that needs no place; the motors stop once the vehicle must be down.

        :param seen: m, world, where motion capture sees it; None: not at all.
        :returns: False: it is not steered without a place.
        """
        if self._blind is None:
            return False
        velocity, until = self._blind
        if not in_air:
            self._blind = None
        elif self.sinks_blindly and (now > until or (seen is not None and seen[2] < DOWN_M)):
            self._blind, self.streaming = None, False
            self._link.order(end_of_stream)  # with nothing to fly the end of the stream stops the motors
        else:
            self._link.stream(velocity_world(velocity, 0.0, now))
        return True
