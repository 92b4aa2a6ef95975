"""One Crazyflie as the bridge knows it: link, state machine, orders, and the age of everything.

A set-point's way from the graph to the motors, and who may stop it:

1. **Topic.** `node/inputs.py` subscribes to each vehicle's `cmd_*` topics, in a thread of their own (`command_thread`).
   It turns a message into a :class:`Setpoint` in the world's frame, dated by its publication, and refuses one that is
   too fast or leads out of the fence (`motion/limits.py`).
2. **Whether it counts now** is decided here, in :meth:`Vehicle.command`, under the vehicle's lock. It does not count
   unless the state machine says armed or flying, after a rule of `safety` has taken the controls (`_overruled`, until
   the next take-off), while motion capture does not see the vehicle (`_paused`), or while a take-off or go-to is flown
   to its end (`controls.guard_until`). One that does not count is counted in `refused`.
3. **The stream.** `motion/controls.py` notes its time, ends whatever else was flown (a braking, an order that is being
   repeated), and lays it into the link's outbox (`links/outbox.py`): one place, so a newer one replaces it.
4. **The link's worker** (`links/link.py`) sends orders first, then the newest set-point, then positions, by cflib.
5. **When the stream stops.** `safety/rules.py` looks at the command's age 50 times a second: :meth:`Vehicle.hold` comes
   first, then :meth:`Vehicle.land`. Both brake by a stream of zero velocity, then give an order to the firmware's
   high-level commander. The order goes out before the end of the stream, or the motors would stop for a moment.

Orders (take-off, go-to, landing) take the same way from step 2 on, by :meth:`Vehicle.fly`.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dtsa_agent.crazyflie.link import Link
from dtsa_agent.crazyflie.motion.controls import GO_TO, SLOW_MPS, TAKEOFF, Controls, end_of_stream
from dtsa_agent.crazyflie.motion.limits import landing_s, outside_fence, too_short
from dtsa_agent.crazyflie.onboard import ENABLE
from dtsa_agent.crazyflie.settings import RobotSettings, StationSettings
from dtsa_agent.crazyflie.state.conversions import Quaternion, Setpoint, Vector, VehicleState, yaw_of
from dtsa_agent.crazyflie.state.state_machine import HL_ACTIVE, IN_AIR, State, StateMachine

from .known_state import KnownState
from .onboard import Onboard

HOLD_S = 0.5  # s, duration of the path to the place that is held
FRESH_S = 0.3  # a log packet that was under way for longer says nothing about now
LOW_M = 0.1  # this close to the floor there is nothing left to land from
WATCHED_OVER = frozenset({State.ARMED, State.FLYING, State.LANDING})
ACCEPTS_COMMANDS = frozenset({State.ARMED, State.FLYING})


class Vehicle:
    """One Crazyflie. Times (`now`) are s, monotonic; places are m, world. Orders return why not, or an empty text.

    :param cache: folder for cflib's tables.
    :param on_state: called with this vehicle and each new state of it, in a thread of cflib's.
    """

    def __init__(
        self,
        robot: RobotSettings,
        station: StationSettings,
        cache: Path,
        log: Callable[[str, str], None],
        on_state: Callable[[Vehicle, VehicleState], None] | None = None,
    ) -> None:
        self.robot = robot
        self.station = station
        self.name = robot.name
        self.lock = threading.RLock()
        self.machine = StateMachine(self._changed)
        self.action = "not connected yet"  # the last action taken with it, and why
        self.refused = 0
        self.guarded = False  # the firmware's emergency watchdog is running
        self._log = log
        self._publish = on_state
        self._moved = False  # something that makes it fly was sent since it was armed
        self._overruled = False  # a rule took the controls: streamed commands do not count until the next take-off
        self._paused = False  # held because it is not seen: streamed commands do not count until it is
        self.known = KnownState(robot, station, log)
        self.link = Link(
            robot,
            cache,
            self._received,
            self._broken,
            self._answered,
            self.known.settling,
            lambda: self.known.seen_at(time.monotonic()),
        )
        self.controls = Controls(self.link, station)
        self.onboard = Onboard(self.link)

    # -- what comes in ----------------------------------------------------------------------------------------------
    def _changed(self, before: State, state: State, reason: str) -> None:
        level = "error" if state in (State.EMERGENCY, State.LOST) else "info"
        self._log(level, f"{self.name}: {before.name.lower()} -> {state.name.lower()} ({reason})")
        self.action = reason
        if before == State.LANDING and state == State.ARMED:
            self.link.order(lambda cf: cf.supervisor.send_arming_request(False))

    def _received(self, state: VehicleState, now: float) -> None:
        with self.lock:
            self.known.note(state, now)
            if self.machine.state == State.LOST and time.monotonic() - now > FRESH_S:
                return  # it delivers what it logged in the gap; what comes next is new
            self.known.judge(state, now)
            if self.machine.state not in (State.DISCONNECTED, State.CONNECTING):
                before = self.machine.state
                self.machine.observe(state.info)
                if before == State.LOST != self.machine.state:
                    self._heard_again(state)
        if self._publish is not None:
            self._publish(self, state)

    def _heard_again(self, state: VehicleState) -> None:
        """The end of a gap: the orders that were given in it may have been lost."""
        self.controls.end_repeats()
        if self.guarded:  # its watchdog has not much time left
            self.link.order(lambda cf: cf.supervisor.send_emergency_stop_watchdog())
        if self.state != State.LANDING:
            return
        drifts = math.hypot(*state.velocity[:2]) > SLOW_MPS
        if state.position[2] < LOW_M and not state.info & HL_ACTIVE:
            # Down, or about to be: with nothing to fly the end of the stream stops the motors.
            self.controls.delivery.cancel()
            self.link.order(end_of_stream)
        elif drifts or not self.controls.delivery.landing:
            self._log("info", f"{self.name}: heard again: brakes and lands")
            self.controls.streaming = True
            self._brake_then(self._come_down)

    def _answered(self, code: int, result: int) -> None:
        with self.lock:
            problem = self.controls.delivery.answered(code, result)
        if problem:
            self._log("warn", f"{self.name}: {problem}")

    def _broken(self, reason: str) -> None:
        with self.lock:
            self.machine.silent(reason)

    def see(self, position: Vector, orientation: Quaternion, frame: str, stamp: float) -> None:
        """A pose from motion capture (see `Tracker.offer`): checked, and passed on to the Crazyflie."""
        with self.lock:
            packet = self.known.see(position, orientation, frame, stamp)
        if packet is not None:
            self.link.send_position(packet)

    # -- connection -------------------------------------------------------------------------------------------------
    def connect(self, done: Callable[[], None]) -> None:
        """Connect in a thread of its own; `done` is called when it has worked out or not."""
        with self.lock:
            self.machine.go(State.CONNECTING, f"connecting to {self.robot.uri}")
            self._overruled = self._paused = self.guarded = False
            self.controls.reset()

        def run() -> None:
            try:
                reason = self.link.connect()
                with self.lock:
                    if reason:
                        self._log("error", f"{self.name}: no connection: {reason}")
                        self.machine.go(State.DISCONNECTED, reason)
                    else:
                        self.machine.go(State.READY, "connected")
                        if self.last is not None:
                            self.machine.observe(self.last.info)
            finally:
                done()

        threading.Thread(target=run, name=f"{self.name}-connect", daemon=True).start()

    @property
    def last(self) -> VehicleState | None:
        """What it has reported last; None: nothing yet."""
        return self.known.last

    @property
    def state(self) -> State:
        """Where the state machine stands."""
        return self.machine.state

    @property
    def standing(self) -> str:
        """Its state in words, and the way out of one that has no other."""
        if self.state == State.EMERGENCY:
            return f"emergency ({self.machine.reason}): switch it off and on, then call /{self.name}/reconnect"
        return self.state.name.lower()

    def log_age(self, now: float) -> float:
        """Seconds since the last log packet; infinite before the first one."""
        return self.known.log_age(now)

    # -- orders -----------------------------------------------------------------------------------------------------
    def command(self, setpoint: Setpoint) -> bool:
        """Stream a command; False when it is not for the present state."""
        with self.lock:
            early = setpoint.stamp < self.controls.guard_until
            if self.state not in ACCEPTS_COMMANDS or self._overruled or self._paused or early:
                self.refused += 1
                return False
            self._moved = True
            if self.controls.held:
                self._log("info", f"{self.name}: commands again")
            self.controls.stream(setpoint)
            return True

    def not_led(self) -> str:
        """Why it takes no orders to fly somewhere; empty if it does."""
        if self.state == State.FLYING and not self._overruled:
            return ""
        return f"{self.name} is {self.standing}" + (f" ({self.action})" if self._overruled else "")

    def fly(self, kind: str, action: Callable[[Any], None], duration: float, *, again: bool = True) -> None:
        """Give an order to the high-level commander; parameters as of `Controls.fly`. The lock is held."""
        self.controls.fly(kind, action, duration, time.monotonic(), again=again)

    def arm(self, arm: bool) -> str:
        """Let the motors run, or lock them."""
        with self.lock:
            if self.state not in (State.READY, State.ARMED):
                return f"{self.name} is {self.standing}"
            if arm and (problem := self.known.misplaced()):
                return problem
            self.action = "arming" if arm else "disarming"
            self.machine.arm(arm)
            self._moved = False
            if not self.machine.arms_itself:  # disarmed, it would arm itself again at once
                self.link.order(lambda cf: cf.supervisor.send_arming_request(arm))
            return ""

    def takeoff(self, height: float, duration: float, *, arm: bool = False) -> str:
        """Climb to a height (m above the floor) within a duration (s); `arm`: one that arms itself is armed, too."""
        with self.lock:
            if arm and self.state == State.READY and self.machine.arms_itself and self.last is not None:
                if problem := self.arm(True):
                    return problem
                self.machine.observe(self.last.info)
            if self.state not in (State.ARMED, State.FLYING, State.LANDING):
                return f"{self.name} is {self.standing}, not armed"
            critical = self.robot.battery.voltage_critical
            if self.state == State.ARMED and self.last is not None and self.last.battery < critical:
                return f"{self.name}: battery {self.last.battery:.2f} V (voltage_critical is {critical:g} V)"
            if problem := self.known.wrong and f"{self.name}: {self.known.wrong}":
                return problem
            if self.state == State.ARMED and (problem := self.known.misplaced()):
                return problem
            if not math.isfinite(height):
                return f"{self.name}: height {height} m is not finite"
            x, y, _ = (0.0, 0.0, 0.0) if self.last is None else self.last.position
            if self.last is not None and (problem := outside_fence((x, y, height), self.station)):
                return f"{self.name}: the take-off to {problem}"
            z = 0.0 if self.last is None else max(self.last.position[2], 0.0)
            if problem := too_short(duration, height - z, self.station.max_speed_mps):
                return f"{self.name}: {problem}"
            self._overruled, self._moved = False, True
            if self.station.on_board.on:  # the app had been overruled by the last landing: it has to be enabled anew
                self.onboard.set_parameter(ENABLE, 0)
            self.controls.see_again()
            on_ground = self.state == State.ARMED
            self.machine.takeoff(f"take-off to {height:.2f} m")
            self.action = self.machine.reason
            if on_ground or self.last is None:
                self.controls.streaming = True  # the zero setpoint that closed the link before may still be in force
                self.fly(TAKEOFF, lambda cf: cf.high_level_commander.takeoff(height, duration, yaw=None), duration)
            else:  # the firmware takes off from the ground only
                x, y, _ = self.last.position
                yaw = yaw_of(self.last.orientation)
                self.fly(GO_TO, lambda cf: cf.high_level_commander.go_to(x, y, height, yaw, duration), duration)
            return ""

    def enable(self, on: bool) -> str:
        """Let the agent on board steer, or take the controls back: it then hovers."""
        with self.lock:
            if on and (problem := self.not_led()):
                return problem
            if on and (left := self.controls.guard_until - time.monotonic()) > 0.0:
                return f"{self.name} still flies its take-off or go_to, for {left:.1f} s"
            self._log("info", f"{self.name}: the agent on board {'may steer' if on else 'may not steer any more'}")
            self.onboard.set_parameter(ENABLE, int(on))
            return ""

    def go_to(self, place: tuple[float, float, float], yaw: float, duration: float, relative: bool) -> str:
        """Fly to a place (relative: by an offset) and heading (rad) within a duration (s)."""
        with self.lock:
            if problem := self.not_led():
                return problem
            here = (0.0, 0.0, 0.0) if relative or self.last is None else self.last.position
            goal = place
            if relative and self.last is not None:
                a, b = self.last.position, place
                goal = (a[0] + b[0], a[1] + b[1], a[2] + b[2])
            if problem := outside_fence(goal, self.station):
                return f"{self.name}: the goal {problem}"
            if problem := too_short(duration, math.dist(place, here), self.station.max_speed_mps):
                return f"{self.name}: {problem}"
            self.action = "go_to"
            x, y, z = place
            self.fly(
                GO_TO,
                lambda cf: cf.high_level_commander.go_to(x, y, z, yaw, duration, relative),
                duration,
                again=not relative,
            )
            return ""

    def hold(self, reason: str, *, stale: bool = False, until_seen: bool = False) -> None:
        """Stop where it is; the next streamed command takes over again.

        A vehicle whose estimate is wrong is only kept from moving, and takes no commands any more.

        :param stale: because the stream broke off: the age of the last command goes on counting.
        :param until_seen: commands do not count before motion capture sees it again.
        """
        with self.lock:
            if self.state != State.FLYING or self.last is None:
                return
            self.action = f"hold: {reason}"
            if self.known.wrong:
                self._overruled = True
                self.controls.stand_blindly(time.monotonic())
                return
            self._paused = until_seen

            def stay() -> None:
                if self.last is None:
                    return
                x, y, z = self.last.position
                z, yaw = max(z, 0.1), yaw_of(self.last.orientation)
                self.fly(GO_TO, lambda cf: cf.high_level_commander.go_to(x, y, z, yaw, HOLD_S), 0.0)
                self.controls.held = stale

            self.controls.held = stale
            self._brake_then(stay)

    def _brake_then(self, action: Callable[[], None]) -> None:
        """Slow down, then do something."""
        if self.last is None or self.state not in (State.FLYING, State.LANDING):
            action()
        else:
            self.controls.brake_then(action, self.known.speed, time.monotonic())

    def land(
        self, reason: str, height: float = 0.0, duration: float = 0.0, note: Callable[[str], None] | None = None
    ) -> str:
        """Sink to a height (m above the floor) within a duration (s; 0: at the station's speed) and stop the motors.

        A landing is never refused for its numbers: one that would be too fast takes longer, and `note` is told.
        """
        with self.lock:
            height = height if math.isfinite(height) else 0.0
            if self.state not in (State.ARMED, State.FLYING, State.LANDING, State.LOST):
                return f"{self.name} is {self.standing}"
            if self.state == State.ARMED and not self._moved:
                return self.arm(False)  # a landing would start the motors
            self._overruled = True
            if self.state == State.LANDING and (not self.known.wrong or self.controls.sinks_blindly):
                return ""
            self.action = f"land: {reason}"
            if self.known.wrong:
                self.machine.land(self.action)
                now = time.monotonic()
                self.controls.sink_blindly(self.known.sinking_height(now), now)
                return ""
            # A blind landing must end a stream that the firmware may still follow.
            self.controls.streaming |= self.state == State.LOST
            self.machine.land(f"land: {reason}")
            way = self.known.height - height
            if 0.0 < duration < (seconds := landing_s(way, duration, self.station)):
                why = too_short(duration, way, self.station.max_speed_mps)
                longer = f"{self.name}: landing takes {seconds:.2f} s: {why}"
                self._log("warn", longer)
                if note is not None:
                    note(longer)
            self._brake_then(lambda: self._come_down(height, duration))
            return ""

    def _come_down(self, height: float = 0.0, duration: float = 0.0) -> None:
        """Straight down from where it is now; parameters as of `land`."""
        self.controls.land(height, self.known.height - height, duration, time.monotonic())

    def stop(self, reason: str) -> None:
        """Emergency stop: motors off for good."""
        with self.lock:
            if self.state in (State.DISCONNECTED, State.CONNECTING):
                return
            self.action = f"emergency stop: {reason}"
            self._overruled = True
            self.controls.stop()

            def run(cf: Any) -> None:
                for _ in range(3):  # the packet is not acknowledged, and it latches: more of them do no harm
                    cf.supervisor.send_emergency_stop()

            self.link.order(run)
            self.machine.emergency(self.action)

    def notify_setpoints_stop(self, remain_ms: int) -> str:
        """End the stream of setpoints and hold; the last one stays valid for `remain_ms`."""
        with self.lock:
            if self.state not in ACCEPTS_COMMANDS:
                return f"{self.name} is {self.standing}"
            if self.state == State.FLYING:
                self.hold("the stream of commands was declared over")  # tells the firmware, too
            else:
                self.controls.streaming = False
                self.controls.delivery.cancel()
                self.link.order(lambda cf: cf.commander.send_notify_setpoint_stop(remain_ms))
            return ""

    def lose(self, reason: str, now: float) -> None:
        """It is silent. Nothing may be heard, but a landing is ordered all the same, unless it is known to land."""
        with self.lock:
            was_in_air = self.state in IN_AIR
            self.machine.silent(reason)
            if not was_in_air:
                self.controls.delivery.cancel()  # a take-off that comes late takes nobody by surprise
            elif self.link.connected and not self.controls.delivery.landing:
                self.land(reason)
                self.controls.repeat_landing(now)

    def tick(self, now: float) -> None:
        """Called 50 times a second: goes on braking, and sends again what has not been answered."""
        with self.lock:
            if self._paused and (unseen := self.known.unseen_s(now)) is not None:
                self._paused = unseen > self.station.safety.position_age_s
            if self.controls.blind:
                self.controls.go_on_blindly(self.state in IN_AIR, self.known.seen_at(now), now)
            elif self.last is not None:
                self.controls.slow_down(self.known.speed, now)
            if self.state not in (State.DISCONNECTED, State.CONNECTING):
                self.link.order_log(now)
            if self.state in WATCHED_OVER and (order := self.controls.delivery.due(now)) is not None:
                self.link.order(order)

    def keep_alive(self, now: float, watchdog: bool) -> None:
        """What has to be sent regularly: the emergency stop watchdog, and blind landings."""
        with self.lock:
            self.controls.land_again(self.known.height, now)
            # From the first arming on: once it has begun, the firmware locks itself when it ends.
            self.guarded |= watchdog and self.state in WATCHED_OVER
            self.link.guarded = self.guarded
            if self.guarded and self.state not in (State.DISCONNECTED, State.CONNECTING, State.EMERGENCY):
                self.link.order(lambda cf: cf.supervisor.send_emergency_stop_watchdog())
