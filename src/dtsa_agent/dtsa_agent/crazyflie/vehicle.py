"""One Crazyflie as the bridge knows it: its connection, what is known of it, the orders it takes, and what it flies.

A set-point's way from the graph to the motors, and what may stop it. All the files on it: `topics`, `commands`,
`state`, `safety`, `vehicle`, `link`, `drivers`.

1. **Topic.** `commands` reads each vehicle's `cmd_*` topics (`node/topics`) in a thread of its own, and turns a message
   into a `Setpoint` in the Crazyflies' world (`state`), dated by its publication.
2. **Whether it counts now** is decided here, in :meth:`CrazyflieVehicle.command`. It does not count if it is too fast
   or leads out of the fence (`safety`), unless the vehicle is armed or flies, after a safety rule has taken the
   controls (`_overruled`, until the next take-off), while motion capture does not see the vehicle (`_paused`), or while
   a take-off or go-to is flown to its end (`_guard_until`). One that counts ends whatever else was flown: a braking, an
   order that is being repeated.
3. **The link** (`link`) gives it to cflib, whose driver (`drivers`) keeps the newest one until it can be sent.
4. **When the stream stops.** `safety` checks the command's age 50 times a second: first the vehicle holds its place
   (`hold_place`), then it lands (`land`). Both brake by a stream of zero velocity, then give an order to the firmware's
   high-level commander. The order goes out before the end of the stream, or the motors would stop for a moment.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from .commands import Setpoint, velocity_world
from .link import CrazyflieLink, Send
from .onboard import ENABLE
from .orders import GO_TO, LAND, REPEAT_S, TAKEOFF, RepeatedOrder, end_of_stream, landing_s, too_short
from .positions import PoseTracker, quantile
from .safety import EstimateWatch, WatchedVehicle, outside_fence
from .settings import GroundStationSettings, RobotSettings
from .state import HL_ACTIVE, IN_AIR, IS_FLYING, OFF, WATCHED, State, StateMachine, Vector, VehicleState, to_map, yaw_of

HOLD_S = 0.5  # s, duration of the path to the place that is held
FRESH_S = 0.3  # a log packet that was under way for longer says nothing about now
LOW_M = 0.1  # this close to the floor there is nothing left to land from
LOWEST_HOLD_M = 0.1
WINDOW_S = 1.0  # over which packets are counted
COMPLAIN_S = 5.0  # a vehicle's refused poses stand in the log this often at most
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
ACCEPTS_COMMANDS = frozenset({State.ARMED, State.FLYING})


class CrazyflieVehicle:
    """One Crazyflie. Times (`now`) are s, monotonic; places are m, world. Orders return why not, or an empty text.

    :param cache: folder for cflib's tables.
    :param on_state: called with this vehicle, its new state, and when that was measured, in a thread of cflib's.
    """

    def __init__(
        self, robot: RobotSettings, station: GroundStationSettings, cache: Path, log: Callable[[str, str], None],
        on_state: Callable[[CrazyflieVehicle, VehicleState, float], None] | None = None,
    ) -> None:  # fmt: skip
        self.robot, self.station, self.name = robot, station, robot.name
        self.lock = threading.RLock()  # protects all of it
        self.machine = StateMachine(self._changed)
        self.action = "not connected yet"  # the last action taken with it, and why
        self.guarded = False  # the firmware's emergency watchdog is running
        self.last: VehicleState | None = None  # what it has reported last
        self.refused = 0  # streamed commands that did not count
        self.longer = ""  # that the present landing takes longer than ordered, and why
        self._log, self._publish = log, on_state
        self._log_times: deque[float] = deque(maxlen=200)
        self._trusted_height = 0.0  # m, the last one before the estimate was wrong
        self._complained = -math.inf
        self.tracker = PoseTracker(station.positions, station.safety, station.room_origin_in_world)
        self._watch = EstimateWatch(station.safety)
        self.link = CrazyflieLink(robot, cache, self.tracker, self._on_state, self._on_broken, self._on_answer)
        # What it flies: a stream of commands, a path, a landing, or a velocity without a place.
        self._overruled = False  # a rule took the controls: streamed commands do not count until the next take-off
        self._paused = False  # held because it is not seen: streamed commands do not count until it is
        self._streaming = False  # the firmware follows streamed commands, not the high-level commander
        self._held = False  # the stream of commands broke off and the place is being held
        self._moved = False  # something that makes it fly was sent since it was armed
        self._command_time = -math.inf  # s, of the last streamed command
        self._guard_until = 0.0  # s: a take-off or go-to is flown to its end before streamed commands count again
        self._order: RepeatedOrder | None = None  # the last one, if it is to be repeated
        # A velocity that is streamed in place of commands, until when (s) or what, and what comes then.
        self._steady: tuple[Vector, float, Callable[[], bool], Callable[[], None]] | None = None
        self._landings: list[float] = []  # s: when to repeat a landing that may not have been heard

    @property
    def state(self) -> State:
        return self.machine.state

    @property
    def state_text(self) -> str:
        """Its state in words, and the way out of one that has no other."""
        if self.state == State.EMERGENCY:
            return f"emergency ({self.machine.reason}): switch it off and on, then call /{self.name}/reconnect"
        return self.state.name.lower()

    # -- what comes in ----------------------------------------------------------------------------------------------
    def _changed(self, before: State, state: State, reason: str) -> None:
        level = "error" if state in (State.EMERGENCY, State.LOST) else "info"
        self._log(level, f"{self.name}: {before.name.lower()} -> {state.name.lower()} ({reason})")
        self.action = reason
        self.longer = "" if before == State.LANDING else self.longer
        if before == State.LANDING and state == State.ARMED:
            self.link.order(lambda cf: cf.supervisor.send_arming_request(False))

    def _on_state(self, state: VehicleState, now: float) -> None:
        """A log packet with values that were taken at this time."""
        with self.lock:
            self.last = state
            self._log_times.append(now)
            if self.state == State.LOST and time.monotonic() - now > FRESH_S:
                return  # it delivers what it logged in the gap; what comes next is new
            if not self._watch.wrong:
                self._trusted_height = max(state.position[2], 0.0)
            if self._watch.update(state, now, self.tracker.measured_position(now), flying=bool(state.info & IS_FLYING)):
                self._log("error", f"{self.name}: {self._watch.wrong}")
            if self.state not in OFF:
                before = self.state
                self.machine.update(state.info)
                if before == State.LOST != self.state:
                    self._resume_after_gap(state)
        if self._publish is not None:
            self._publish(self, state, now)

    def _resume_after_gap(self, state: VehicleState) -> None:
        """The end of a gap: the orders that were given in it may have been lost."""
        self._landings.clear()
        if self.state != State.LANDING:
            return
        drifts = math.hypot(*state.velocity[:2]) > SLOW_MPS
        if state.position[2] < LOW_M and not state.info & HL_ACTIVE:
            self._end_stream()  # down, or about to be
        elif drifts or not self._landing_answered:
            self._log("info", f"{self.name}: heard again: brakes and lands")
            self._streaming = True
            self._brake_then(self._descend)

    def _on_answer(self, code: int, result: int) -> None:
        with self.lock:
            problem = self._order.note_answer(code, result) if self._order else ""
            if problem:
                self._order = None
                self._log("warn", f"{self.name}: the firmware {problem}")

    def _on_broken(self, reason: str) -> None:
        with self.lock:
            self.machine.note_lost_link(reason)

    def receive_pose(self, position: Vector, orientation: Sequence[float], frame: str, stamp: float) -> None:
        """Check a pose from motion capture (see `PoseTracker.receive_pose`), and pass it on to the Crazyflie."""
        tracker, now = self.tracker, time.monotonic()
        with self.lock:
            flying = self.last is not None and bool(self.last.info & IS_FLYING)
            problem = tracker.receive_pose(position, orientation, frame, stamp, now, flying=flying)
            if problem and now - self._complained > COMPLAIN_S:
                self._complained = now
                self._log("warn", f"{self.name}: a pose of motion capture is refused: {problem}")
            due = not problem and tracker.is_due(now)
        if due:
            self.link.order(tracker.send, connecting=True)  # the estimator settles by that

    # -- what is known of it ----------------------------------------------------------------------------------------
    def _why_misplaced(self) -> str:
        """Why its motors may not start: it does not know where it stands. Empty if it does."""
        problem = self.tracker.why_estimate_wrong(self.last.position, time.monotonic()) if self.last else ""
        return problem and f"{self.name} {problem}"

    def log_age(self, now: float) -> float:
        """Seconds since the last log packet; infinite before the first one."""
        return now - self._log_times[-1] if self._log_times else math.inf

    def command_age(self, now: float) -> float:
        """Seconds since the last streamed command; infinite before the first one."""
        return now - self._command_time

    def link_quality(self, now: float) -> float:
        """Share of the log packets that arrive, or of packets that the radio need not repeat, 0 to 1."""
        recent = sum(now - t <= WINDOW_S for t in self._log_times.copy())
        return min(1.0, recent / (self.robot.log_rate_hz * WINDOW_S), getattr(self.link.driver, "quality", 1.0))

    def command_rate(self, now: float) -> tuple[float, float]:
        """Return streamed commands sent per second, and the 99th percentile of their latency, s."""
        sent = self.link.setpoints.copy()
        latencies = deque(latency for _, latency in sent)
        return sum(now - t <= WINDOW_S for t, _ in sent) / WINDOW_S, quantile(latencies, 0.99)

    def watched_state(self, now: float) -> WatchedVehicle:
        with self.lock:
            battery, last, wrong = self.robot.battery, self.last, self._watch.wrong
            place = self.tracker.measured_position(now) if wrong else None if last is None else last.position
            streamed = (self._streaming or self._held) and self._command_time > -math.inf and not wrong
            return WatchedVehicle(
                self.name, self.state, None if place is None else to_map(place, self.station.room_origin_in_world),
                math.inf if last is None else last.battery, battery.flight_warning, battery.flight_landing,
                self.log_age(now), self.command_age(now) if streamed else None,
                self.tracker.age(now) if self.tracker.settings.enabled else None, wrong, now - self._watch.since,
            )  # fmt: skip

    # -- connection -------------------------------------------------------------------------------------------------
    def connect(self, *, rejoin: bool = False) -> threading.Thread:
        """Connect in a thread of its own; `rejoin`: its agent on board starts at once."""
        with self.lock:
            self.machine.enter(State.CONNECTING, f"connecting to {self.robot.uri}")
            self.guarded = self._overruled = self._paused = self._streaming = self._held = False
            self._command_time, self._steady, self._order = -math.inf, None, None
            self._landings.clear()

        def run() -> None:
            reason = self.link.connect()
            with self.lock:
                if reason:
                    self._log("error", f"{self.name}: no connection: {reason}")
                    self.machine.enter(State.DISCONNECTED, reason)
                else:
                    self.machine.enter(State.READY, "connected")
                    if self.last is not None:
                        self.machine.update(self.last.info)
            if rejoin and self.link.connected and self.link.board and (problem := self.link.start_agent()):
                self._log("error", f"{self.name}: {problem}")

        thread = threading.Thread(target=run, name=f"{self.name}-connect", daemon=True)
        thread.start()
        return thread

    # -- orders -----------------------------------------------------------------------------------------------------
    def command(self, setpoint: Setpoint) -> str:
        """Stream a command; why it is refused, if it leads out of the fence, is too fast, or not for the state."""
        with self.lock:
            fastest, outside = self.station.max_stream_mps, self._outside_fence(setpoint.place)
            early, problem = setpoint.stamp < self._guard_until, ""
            if setpoint.speed > fastest:
                limit = f"(station.max_stream_mps is {fastest:g})"
                problem = f"a command with {setpoint.speed:.2f} m/s is refused {limit}"
            elif outside:
                problem = f"a command to {outside} is refused"
            elif self.state not in ACCEPTS_COMMANDS or self._overruled or self._paused or early:
                problem = f"commands are not accepted now ({self.state.name.lower()}: {self.machine.reason})"
            if problem:
                self.refused += 1
                return problem
            if self._held:
                self._log("info", f"{self.name}: commands again")
            self._command_time = setpoint.stamp
            self._moved = self._streaming = True
            self._held, self._steady, self._order = False, None, None
            self.link.stream(setpoint)
            return ""

    def arm(self, arm: bool) -> str:
        with self.lock:
            if self.state not in (State.READY, State.ARMED):
                return f"{self.name} is {self.state_text}"
            if arm and (problem := self._why_misplaced()):
                return problem
            self.action = "arming" if arm else "disarming"
            self.machine.arming_ordered = arm
            self._moved = False
            if not self.machine.arms_itself:  # disarmed, it would arm itself again at once
                self.link.order(lambda cf: cf.supervisor.send_arming_request(arm))
            elif self.last is not None:
                self.machine.update(self.last.info)
            return ""

    def takeoff(self, height: float, duration: float) -> str:
        """Climb to a height (m above the floor) within a duration (s); one that arms itself need not be armed."""
        with self.lock:
            arms = self.state == State.READY and self.machine.arms_itself
            on_ground, last = arms or self.state == State.ARMED, self.last
            if last is None or not (arms or self.state in WATCHED):
                return f"{self.name} is {self.state_text}, not armed"
            (x, y, z), critical = last.position, self.robot.battery.voltage_critical
            low, outside = on_ground and last.battery < critical, self._outside_fence((x, y, height))
            problem = (
                self._watch.wrong
                or ("" if math.isfinite(height) else f"height {height} m is not finite")
                or (f"battery {last.battery:.2f} V (voltage_critical is {critical:g} V)" if low else "")
                or (f"the take-off to {outside}" if outside else "")
                or too_short(duration, height - max(z, 0.0), self.station.max_speed_mps)
            )
            if problem:
                return f"{self.name}: {problem}"
            if on_ground and (problem := self._why_misplaced() or (self.arm(True) if arms else "")):
                return problem
            self._overruled, self._moved = False, True
            if self.station.on_board.enabled:  # the last landing overruled the app: it has to be enabled anew
                self.link.set_parameter(ENABLE, 0)
            self.machine.note_takeoff(f"take-off to {height:.2f} m")
            self.action = self.machine.reason
            if on_ground:
                self._streaming = True  # an old stream may still be in force
                self._fly(TAKEOFF, lambda cf: cf.high_level_commander.takeoff(height, duration, yaw=None), duration)
            else:  # the firmware takes off from the ground only
                yaw = yaw_of(last.orientation)
                self._fly(GO_TO, lambda cf: cf.high_level_commander.go_to(x, y, height, yaw, duration), duration)
            return ""

    def _outside_fence(self, place: Vector | None) -> str:
        station = self.station
        return "" if place is None else outside_fence(place, station.safety, station.room_origin_in_world)

    def _why_not_steerable(self) -> str:
        """Why it takes no orders to fly somewhere; empty if it does."""
        if self.state == State.FLYING and not self._overruled:
            return ""
        return f"{self.name} is {self.state_text}" + (f" ({self.action})" if self._overruled else "")

    def enable(self, on: bool) -> str:
        """Let the agent on board steer, or take the controls back: it then hovers."""
        with self.lock:
            if on and (problem := self._why_not_steerable()):
                return problem
            if on and (left := self._guard_until - time.monotonic()) > 0.0:
                return f"{self.name} still flies its take-off or go_to, for {left:.1f} s"
            self._log("info", f"{self.name}: the agent on board {'may steer' if on else 'may not steer any more'}")
            self.link.set_parameter(ENABLE, int(on))
            return ""

    def go_to(self, place: Vector, yaw: float, duration: float, relative: bool) -> str:
        """Fly to a place (relative: by an offset) and heading (rad) within a duration (s)."""
        with self.lock:
            if problem := self._why_not_steerable():
                return problem
            if not all(map(math.isfinite, (*place, yaw, duration))):
                return f"{self.name}: the goal is not finite"
            here = STANDSTILL if self.last is None else self.last.position
            goal = (here[0] + place[0], here[1] + place[1], here[2] + place[2]) if relative else place
            if problem := self._outside_fence(goal):
                return f"{self.name}: the goal {problem}"
            if problem := too_short(duration, math.dist(goal, here), self.station.max_speed_mps):
                return f"{self.name}: {problem}"
            self.action = "go_to"
            order: Send = lambda cf: cf.high_level_commander.go_to(*place, yaw, duration, relative)  # noqa: E731
            self._fly(GO_TO, order, duration, again=not relative)
            return ""

    def hold_place(self, reason: str, *, stale: bool = False, until_seen: bool = False) -> None:
        """Stop where it is; the next streamed command takes over again.

        A vehicle whose estimate is wrong is only kept from moving, and takes no commands any more.

        :param stale: because the stream broke off: the age of the last command goes on counting.
        :param until_seen: commands do not count before motion capture sees it again.
        """
        with self.lock:
            if self.state != State.FLYING or self.last is None:
                return
            self.action = f"hold: {reason}"
            if self._watch.wrong:
                self._overruled, self._held = True, False
                self._fly_steadily(STANDSTILL, math.inf, lambda: False, lambda: None)
                return

            def stay() -> None:
                if self.last is not None:
                    (x, y, z), yaw = self.last.position, yaw_of(self.last.orientation)
                    z = max(z, LOWEST_HOLD_M)
                    self._fly(GO_TO, lambda cf: cf.high_level_commander.go_to(x, y, z, yaw, HOLD_S), 0.0)
                    self._held = stale

            self._paused, self._held = until_seen, stale
            self._brake_then(stay)

    def land(self, reason: str, height: float = 0.0, duration: float = 0.0) -> str:
        """Sink to a height (m above the floor) within a duration (s; 0: at the station's speed) and stop the motors.

        A landing is never refused for its numbers: one that would be too fast takes longer, and the log says so.
        """
        with self.lock:
            height, self.longer = height if math.isfinite(height) else 0.0, ""
            if self.state not in (*WATCHED, State.LOST):
                return f"{self.name} is {self.state_text}"
            if self.state == State.ARMED and not self._moved:
                return self.arm(False)  # a landing would start the motors
            self._overruled = True
            sinks_blindly = self._steady is not None and self._steady[0] != STANDSTILL
            if self.state == State.LANDING and (not self._watch.wrong or sinks_blindly):
                return ""
            self.action = f"land: {reason}"
            self._streaming |= self.state == State.LOST  # it must end a stream that the firmware may still follow
            self.machine.note_landing(self.action)
            if self._watch.wrong:
                seen, self._held = self.tracker.measured_position(time.monotonic()), False
                height_s = (self._trusted_height if seen is None else seen[2]) / SINK_MPS
                self._fly_steadily((0.0, 0.0, -SINK_MPS), height_s + SINK_MORE_S, self._is_down, self._end_stream)
                return ""
            way = self._height - height
            if 0.0 < duration < (seconds := landing_s(way, duration, self.station)):
                why = too_short(duration, way, self.station.max_speed_mps)
                self.longer = f"{self.name}: landing takes {seconds:.2f} s: {why}"
                self._log("warn", self.longer)
            self._brake_then(lambda: self._descend(height, duration))
            return ""

    def stop(self, reason: str) -> None:
        """Emergency stop: motors off for good."""
        with self.lock:
            if self.state in OFF:
                return
            self.action = f"emergency stop: {reason}"
            self._overruled = True
            self._steady = self._order = None
            self._landings.clear()
            for _ in range(3):  # the packet is not acknowledged, and it latches: more of them do no harm
                self.link.order(lambda cf: cf.supervisor.send_emergency_stop())
            self.machine.note_emergency_stop(self.action)

    def notify_setpoints_stop(self, remain_ms: int) -> str:
        """End the stream of setpoints and hold; the last one stays valid for `remain_ms`."""
        with self.lock:
            if self.state not in (State.ARMED, State.FLYING):
                return f"{self.name} is {self.state_text}"
            if self.state == State.FLYING:
                self.hold_place("the stream of commands was declared over")  # tells the firmware, too
            else:
                self._streaming, self._order = False, None
                self.link.order(lambda cf: cf.commander.send_notify_setpoint_stop(remain_ms))
            return ""

    # -- what it flies ----------------------------------------------------------------------------------------------
    @property
    def _height(self) -> float:
        return self.last.position[2] if self.last is not None else 1.0

    @property
    def _speed(self) -> float:
        return math.hypot(*self.last.velocity) if self.last is not None else 0.0

    @property
    def _landing_answered(self) -> bool:
        return self._order is not None and self._order.kind == LAND and self._order.answered

    def _fly(self, kind: str, action: Send, duration: float, *, again: bool = True) -> None:
        """An order to the high-level commander, and only then the end of the stream of setpoints.

        The other way round the high-level commander would have nothing to fly for a moment, and would stop the motors.
        Streamed commands do not count for the duration (s). `again`: the order is repeated until it is answered.
        """
        now, streaming = time.monotonic(), self._streaming
        self._streaming = self._held = False
        self._guard_until, self._steady = now + duration, None
        end = end_of_stream if streaming else None

        def run(cf: Any) -> None:
            action(cf)
            if end is not None:
                end(cf)
                if again:
                    action(cf)

        self.link.order(run)
        self._order = RepeatedOrder(kind, run, end, now + REPEAT_S) if again else None

    def _descend(self, height: float = 0.0, duration: float = 0.0) -> None:
        """Straight down from where it is now; parameters as of `land`."""
        seconds = landing_s(self._height - height, duration, self.station)
        self._fly(LAND, lambda cf: cf.high_level_commander.land(height, seconds, yaw=None), math.inf)

    def _brake_then(self, action: Callable[[], None]) -> None:
        if self.last is None or self.state not in IN_AIR:
            action()
        else:
            self._fly_steadily(STANDSTILL, BRAKE_LIMIT_S, lambda: self._speed < SLOW_MPS, action)

    def _fly_steadily(
        self, velocity: Vector, limit_s: float, is_over: Callable[[], bool], action: Callable[[], None]
    ) -> None:
        """Stream a velocity (m/s), which needs no place, for so long at most or until it is over; then do something."""
        now = time.monotonic()
        self._order, self._steady = None, (velocity, now + limit_s, is_over, action)
        self._go_on(now)

    def _go_on(self, now: float) -> None:
        if self._steady is None:
            return
        velocity, until, is_over, action = self._steady
        if self.state not in IN_AIR:
            self._steady = None
        elif now > until or is_over():
            self._steady = None
            action()
        else:
            self._streaming = True
            self.link.stream(velocity_world(velocity, 0.0, now))

    def _is_down(self) -> bool:
        seen = self.tracker.measured_position(time.monotonic())
        return seen is not None and seen[2] < DOWN_M

    def _end_stream(self) -> None:
        """End the stream: with nothing to fly the motors stop."""
        self._streaming, self._order = False, None
        self.link.order(end_of_stream)

    # -- called regularly -------------------------------------------------------------------------------------------
    def declare_lost(self, reason: str, now: float) -> None:
        """It is silent. Nothing may be heard, but a landing is ordered all the same, unless it is known to land."""
        with self.lock:
            was_in_air = self.state in IN_AIR
            self.machine.note_lost_link(reason)
            if not was_in_air:
                self._order = None  # a take-off that comes late would surprise
            elif self.link.connected and not self._landing_answered:
                self.land(reason)
                self._landings = [now + BLIND_REPEAT_S * (i + 1) for i in range(BLIND_REPEATS)]

    def tick(self, now: float) -> None:
        """Called 50 times a second: goes on with a stream of its own, and sends again what has not been answered."""
        with self.lock:
            self._paused &= self.tracker.age(now) > self.station.safety.position_age_s
            self._go_on(now)
            if self.state not in OFF:
                self.link.order_log(now)
            if self.state in WATCHED and self._order is not None and (order := self._order.due(now)) is not None:
                self.link.order(order)

    def feed_watchdog(self, now: float) -> None:
        """Called `WATCHDOG_HZ` times a second: sends the emergency stop watchdog, and a blind landing that is due."""
        with self.lock:
            if self._landings and now >= self._landings[0]:
                self._landings.pop(0)
                self._streaming = True  # it must end a stream that the firmware may still follow
                self._descend(0.0, BLIND_LAND_S)
            # From the first arming on: once it has begun, the firmware locks itself when it ends.
            self.guarded |= self.station.safety.emergency_watchdog and self.state in WATCHED
            self.link.guarded = self.guarded
            if self.guarded and self.state not in (*OFF, State.EMERGENCY):
                self.link.order(lambda cf: cf.supervisor.send_emergency_stop_watchdog())
