"""One Crazyflie as the bridge knows it: its connection, its states, what is known of it, and the orders it takes."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .controls import GO_TO, SLOW_MPS, TAKEOFF, Controls, end_of_stream, landing_s, too_short
from .link import CrazyflieLink, Send
from .onboard import ENABLE
from .positions import EXTPOSE, PoseTracker, SettlingCheck
from .safety import EstimateWatch, WatchedVehicle, outside_fence
from .settings import GroundStationSettings, RobotSettings
from .state import HL_ACTIVE, IN_AIR, IS_FLYING, Quaternion, State, StateMachine, Vector, VehicleState, to_map, yaw_of

HOLD_S = 0.5  # s, duration of the path to the place that is held
FRESH_S = 0.3  # a log packet that was under way for longer says nothing about now
LOW_M = 0.1  # this close to the floor there is nothing left to land from
LOWEST_HOLD_M = 0.1
WINDOW_S = 1.0  # over which packets are counted
COMPLAIN_S = 5.0  # a vehicle's refused poses stand in the log this often at most
OFF = frozenset({State.DISCONNECTED, State.CONNECTING})
WATCHED_OVER = frozenset({State.ARMED, State.FLYING, State.LANDING})


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of one vehicle for status and diagnostics."""

    name: str
    state: State
    reason: str
    vehicle: VehicleState | None
    log_age: float  # s; infinite before the first packet
    command_age: float  # s; infinite before the first command
    link_quality: float  # 0..1
    rssi: int
    sent: int
    received: int
    refused: int  # streamed commands that were not for this state
    latency_p99: float  # s; 0 before the first command
    command_hz: float
    tracker: PoseTracker | None = None  # None: there is no motion capture


class CrazyflieVehicle:
    """One Crazyflie. Times (`now`) are s, monotonic; places are m, world. Orders return why not, or an empty text.

    :param cache: folder for cflib's tables.
    :param on_state: called with this vehicle and each new state of it, in a thread of cflib's.
    """

    def __init__(
        self,
        robot: RobotSettings,
        station: GroundStationSettings,
        cache: Path,
        log: Callable[[str, str], None],
        on_state: Callable[[CrazyflieVehicle, VehicleState], None] | None = None,
    ) -> None:
        self.robot, self.station, self.name = robot, station, robot.name
        self.lock = threading.RLock()
        self.machine = StateMachine(self._changed)
        self.action = "not connected yet"  # the last action taken with it, and why
        self.guarded = False  # the firmware's emergency watchdog is running
        self.last: VehicleState | None = None  # what it has reported last
        self._log, self._publish = log, on_state
        self._log_times: deque[float] = deque(maxlen=200)
        self._trusted_height = 0.0  # m, the last one before the estimate was wrong
        self._complained = -math.inf
        safety, positions, origin = station.safety, station.positions, station.room_origin_in_world
        room = (safety.geofence_min, safety.geofence_max) if safety.geofence else None
        self.tracker = (
            PoseTracker(positions, origin, room) if positions.enabled else None
        )  # None: there is no motion capture
        self._watch = EstimateWatch(safety.estimate_jump_m, safety.estimate_freeze_s, safety.estimate_error_m)
        settling = SettlingCheck(
            robot.estimator_variance_m2, origin, room, positions.agree_m if positions.enabled else None
        )
        measured = lambda: self._measured_place(time.monotonic())  # noqa: E731
        self.link = CrazyflieLink(robot, cache, self._on_state, self._on_broken, self._on_answer, settling, measured)
        self.controls = Controls(self.link, station, self.machine, self.lock, self._log_info)

    @property
    def state(self) -> State:
        """Where the state machine stands."""
        return self.machine.state

    @property
    def state_text(self) -> str:
        """Its state in words, and the way out of one that has no other."""
        if self.state == State.EMERGENCY:
            return f"emergency ({self.machine.reason}): switch it off and on, then call /{self.name}/reconnect"
        return self.state.name.lower()

    # -- what comes in ----------------------------------------------------------------------------------------------
    def _log_info(self, text: str) -> None:
        self._log("info", f"{self.name}: {text}")

    def _changed(self, before: State, state: State, reason: str) -> None:
        level = "error" if state in (State.EMERGENCY, State.LOST) else "info"
        self._log(level, f"{self.name}: {before.name.lower()} -> {state.name.lower()} ({reason})")
        self.action = reason
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
            if self._watch.update(state, now, self._measured_place(now), flying=bool(state.info & IS_FLYING)):
                self._log("error", f"{self.name}: {self._watch.wrong}")
            if self.state not in OFF:
                before = self.state
                self.machine.update(state.info)
                if before == State.LOST != self.state:
                    self._resume_after_gap(state)
        if self._publish is not None:
            self._publish(self, state)

    def _resume_after_gap(self, state: VehicleState) -> None:
        """The end of a gap: the orders that were given in it may have been lost."""
        self.controls.end_repeats()
        if self.state != State.LANDING:
            return
        drifts = math.hypot(*state.velocity[:2]) > SLOW_MPS
        if state.position[2] < LOW_M and not state.info & HL_ACTIVE:
            # Down, or about to be: with nothing to fly the end of the stream stops the motors.
            self.controls.delivery.cancel()
            self.link.order(end_of_stream)
        elif drifts or not self.controls.delivery.landing:
            self._log_info("heard again: brakes and lands")
            self.controls.streaming = True
            self._brake_then(self._descend)

    def _on_answer(self, code: int, result: int) -> None:
        with self.lock:
            problem = self.controls.delivery.answered(code, result)
        if problem:
            self._log("warn", f"{self.name}: {problem}")

    def _on_broken(self, reason: str) -> None:
        with self.lock:
            self.machine.note_lost_link(reason)

    def receive_pose(self, position: Vector, orientation: Quaternion, frame: str, stamp: float) -> None:
        """Check a pose from motion capture (see `PoseTracker.receive_pose`), and pass it on to the Crazyflie."""
        tracker, now = self.tracker, time.monotonic()
        if tracker is None:
            return
        with self.lock:
            flying = self.last is not None and bool(self.last.info & IS_FLYING)
            problem = tracker.receive_pose(position, orientation, frame, stamp, now, flying=flying)
            if problem and now - self._complained > COMPLAIN_S:
                self._complained = now
                self._log("warn", f"{self.name}: a pose of motion capture is refused: {problem}")
            due = not problem and tracker.is_due(now)
        if due:
            self.link.send_position(position_order(tracker))

    # -- what is known of it ----------------------------------------------------------------------------------------
    def _measured_place(self, now: float) -> Vector | None:
        """Return the position that motion capture measures (m, world); None if there is no fresh pose."""
        return None if self.tracker is None else self.tracker.measured_position(now)

    def _why_misplaced(self) -> str:
        """Why its motors may not start: it does not know where it stands. Empty if it does."""
        if self.tracker is None or self.last is None:
            return ""
        problem = self.tracker.why_estimate_wrong(self.last.position, time.monotonic())
        return f"{self.name} {problem}" if problem else ""

    @property
    def _speed(self) -> float:
        return 0.0 if self.last is None else math.hypot(*self.last.velocity)

    @property
    def _height(self) -> float:
        return self.last.position[2] if self.last is not None else 1.0

    def log_age(self, now: float) -> float:
        """Seconds since the last log packet; infinite before the first one."""
        return now - self._log_times[-1] if self._log_times else math.inf

    def watched_state(self, now: float) -> WatchedVehicle:
        """What the safety rules need."""
        with self.lock:
            battery, last, wrong = self.robot.battery, self.last, self._watch.wrong
            place = self._measured_place(now) if wrong else None if last is None else last.position
            return WatchedVehicle(
                self.name, self.state, None if place is None else to_map(place, self.station.room_origin_in_world),
                math.inf if last is None else last.battery, battery.flight_warning, battery.flight_landing,
                self.log_age(now), None if wrong else self.controls.setpoint_age(now),
                None if self.tracker is None else self.tracker.age(now), wrong, now - self._watch.since,
            )  # fmt: skip

    def snapshot(self, now: float) -> Snapshot:
        """Everything for the status."""
        with self.lock:
            link = self.link
            recent = sum(1 for t in self._log_times if now - t <= WINDOW_S)
            quality = min(1.0, recent / (self.robot.log_rate_hz * WINDOW_S), link.counters.quality)
            delays = sorted(link.latencies.copy())
            sends = sum(1 for t in link.send_times.copy() if now - t <= WINDOW_S)
            return Snapshot(
                self.name, self.state, self.action, self.last, self.log_age(now), self.controls.command_age(now),
                quality, link.counters.rssi, link.counters.sent, link.received, self.controls.refused,
                delays[int(0.99 * (len(delays) - 1))] if delays else 0.0, sends / WINDOW_S, self.tracker,
            )  # fmt: skip

    # -- connection -------------------------------------------------------------------------------------------------
    def connect(self, done: Callable[[], None]) -> None:
        """Connect in a thread of its own; `done` is called when it has worked out or not."""
        with self.lock:
            self.machine.enter(State.CONNECTING, f"connecting to {self.robot.uri}")
            self.guarded = False
            self.controls.reset()

        def run() -> None:
            try:
                reason = self.link.connect()
                with self.lock:
                    if reason:
                        self._log("error", f"{self.name}: no connection: {reason}")
                        self.machine.enter(State.DISCONNECTED, reason)
                    else:
                        self.machine.enter(State.READY, "connected")
                        if self.last is not None:
                            self.machine.update(self.last.info)
            finally:
                done()

        threading.Thread(target=run, name=f"{self.name}-connect", daemon=True).start()

    # -- orders -----------------------------------------------------------------------------------------------------
    def _why_not_steerable(self) -> str:
        """Why it takes no orders to fly somewhere; empty if it does."""
        if self.state == State.FLYING and not self.controls.overruled:
            return ""
        return f"{self.name} is {self.state_text}" + (f" ({self.action})" if self.controls.overruled else "")

    def _order_flight(self, kind: str, action: Send, duration: float, *, again: bool = True) -> None:
        self.controls.fly(kind, action, duration, time.monotonic(), again=again)

    def arm(self, arm: bool) -> str:
        """Let the motors run, or lock them."""
        with self.lock:
            if self.state not in (State.READY, State.ARMED):
                return f"{self.name} is {self.state_text}"
            if arm and (problem := self._why_misplaced()):
                return problem
            self.action = "arming" if arm else "disarming"
            self.machine.note_arming(arm)
            self.controls.moved = False
            if not self.machine.arms_itself:  # disarmed, it would arm itself again at once
                self.link.order(lambda cf: cf.supervisor.send_arming_request(arm))
            elif self.last is not None:
                self.machine.update(self.last.info)
            return ""

    def takeoff(self, height: float, duration: float) -> str:
        """Climb to a height (m above the floor) within a duration (s); one that arms itself need not be armed."""
        with self.lock:
            arms = self.state == State.READY and self.machine.arms_itself
            if not arms and self.state not in WATCHED_OVER:
                return f"{self.name} is {self.state_text}, not armed"
            if self._watch.wrong:
                return f"{self.name}: {self._watch.wrong}"
            if not math.isfinite(height):
                return f"{self.name}: height {height} m is not finite"
            on_ground, last = arms or self.state == State.ARMED, self.last
            critical = self.robot.battery.voltage_critical
            if on_ground and last is not None and last.battery < critical:
                return f"{self.name}: battery {last.battery:.2f} V (voltage_critical is {critical:g} V)"
            if on_ground and (problem := self._why_misplaced()):
                return problem
            x, y, z = (0.0, 0.0, 0.0) if last is None else last.position
            safety, origin = self.station.safety, self.station.room_origin_in_world
            if last is not None and (problem := outside_fence((x, y, height), safety, origin)):
                return f"{self.name}: the take-off to {problem}"
            if problem := too_short(duration, height - max(z, 0.0), self.station.max_speed_mps):
                return f"{self.name}: {problem}"
            if arms and (problem := self.arm(True)):
                return problem
            self.controls.overruled, self.controls.moved = False, True
            if (
                self.station.on_board.enabled
            ):  # the app had been overruled by the last landing: it has to be enabled anew
                self.link.set_parameter(ENABLE, 0)
            self.controls.end_blind_flight()
            self.machine.note_takeoff(f"take-off to {height:.2f} m")
            self.action = self.machine.reason
            if on_ground or last is None:
                self.controls.streaming = True  # an old stream may still be in force
                self._order_flight(
                    TAKEOFF, lambda cf: cf.high_level_commander.takeoff(height, duration, yaw=None), duration
                )
            else:  # the firmware takes off from the ground only
                yaw = yaw_of(last.orientation)
                self._order_flight(
                    GO_TO, lambda cf: cf.high_level_commander.go_to(x, y, height, yaw, duration), duration
                )
            return ""

    def enable(self, on: bool) -> str:
        """Let the agent on board steer, or take the controls back: it then hovers."""
        with self.lock:
            if on and (problem := self._why_not_steerable()):
                return problem
            if on and (left := self.controls.guard_until - time.monotonic()) > 0.0:
                return f"{self.name} still flies its take-off or go_to, for {left:.1f} s"
            self._log_info(f"the agent on board {'may steer' if on else 'may not steer any more'}")
            self.link.set_parameter(ENABLE, int(on))
            return ""

    def go_to(self, place: Vector, yaw: float, duration: float, relative: bool) -> str:
        """Fly to a place (relative: by an offset) and heading (rad) within a duration (s)."""
        with self.lock:
            if problem := self._why_not_steerable():
                return problem
            if not all(map(math.isfinite, (*place, yaw, duration))):
                return f"{self.name}: the goal is not finite"
            here = (0.0, 0.0, 0.0) if self.last is None else self.last.position
            goal = (here[0] + place[0], here[1] + place[1], here[2] + place[2]) if relative else place
            if problem := outside_fence(goal, self.station.safety, self.station.room_origin_in_world):
                return f"{self.name}: the goal {problem}"
            if problem := too_short(duration, math.dist(goal, here), self.station.max_speed_mps):
                return f"{self.name}: {problem}"
            self.action = "go_to"

            def order(cf: Any) -> None:
                cf.high_level_commander.go_to(*place, yaw, duration, relative)

            self._order_flight(GO_TO, order, duration, again=not relative)
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
                self.controls.overruled = True
                self.controls.fly_blindly(time.monotonic())
                return
            self.controls.paused = until_seen

            def stay() -> None:
                if self.last is None:
                    return
                (x, y, z), yaw = self.last.position, yaw_of(self.last.orientation)
                z = max(z, LOWEST_HOLD_M)
                self._order_flight(GO_TO, lambda cf: cf.high_level_commander.go_to(x, y, z, yaw, HOLD_S), 0.0)
                self.controls.held = stale

            self.controls.held = stale
            self._brake_then(stay)

    def _brake_then(self, action: Callable[[], None]) -> None:
        """Slow down, then do something."""
        if self.last is None or self.state not in IN_AIR:
            action()
        else:
            self.controls.brake_then(action, self._speed, time.monotonic())

    def land(
        self, reason: str, height: float = 0.0, duration: float = 0.0, note: Callable[[str], None] | None = None
    ) -> str:
        """Sink to a height (m above the floor) within a duration (s; 0: at the station's speed) and stop the motors.

        A landing is never refused for its numbers: one that would be too fast takes longer, and `note` is told.
        """
        with self.lock:
            controls, height = self.controls, height if math.isfinite(height) else 0.0
            if self.state not in (*WATCHED_OVER, State.LOST):
                return f"{self.name} is {self.state_text}"
            if self.state == State.ARMED and not controls.moved:
                return self.arm(False)  # a landing would start the motors
            controls.overruled = True
            if self.state == State.LANDING and (not self._watch.wrong or controls.sinks_blindly):
                return ""
            self.action = f"land: {reason}"
            # A blind landing must end a stream that the firmware may still follow.
            controls.streaming |= self.state == State.LOST
            self.machine.note_landing(self.action)
            if self._watch.wrong:
                now = time.monotonic()
                seen = self._measured_place(now)
                controls.fly_blindly(now, self._trusted_height if seen is None else seen[2])
                return ""
            way = self._height - height
            if 0.0 < duration < (seconds := landing_s(way, duration, self.station)):
                why = too_short(duration, way, self.station.max_speed_mps)
                longer = f"{self.name}: landing takes {seconds:.2f} s: {why}"
                self._log("warn", longer)
                if note is not None:
                    note(longer)
            self._brake_then(lambda: self._descend(height, duration))
            return ""

    def _descend(self, height: float = 0.0, duration: float = 0.0) -> None:
        """Straight down from where it is now; parameters as of `land`."""
        self.controls.land(height, self._height - height, duration, time.monotonic())

    def stop(self, reason: str) -> None:
        """Emergency stop: motors off for good."""
        with self.lock:
            if self.state in OFF:
                return
            self.action = f"emergency stop: {reason}"
            self.controls.overruled = True
            self.controls.stop()
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
                self.controls.streaming = False
                self.controls.delivery.cancel()
                self.link.order(lambda cf: cf.commander.send_notify_setpoint_stop(remain_ms))
            return ""

    # -- called regularly -------------------------------------------------------------------------------------------
    def declare_lost(self, reason: str, now: float) -> None:
        """It is silent. Nothing may be heard, but a landing is ordered all the same, unless it is known to land."""
        with self.lock:
            was_in_air = self.state in IN_AIR
            self.machine.note_lost_link(reason)
            if not was_in_air:
                self.controls.delivery.cancel()  # a take-off that comes late would surprise
            elif self.link.connected and not self.controls.delivery.landing:
                self.land(reason)
                self.controls.repeat_landing(now)

    def tick(self, now: float) -> None:
        """Called 50 times a second: goes on braking, and sends again what has not been answered."""
        with self.lock:
            if self.controls.paused and self.tracker is not None:
                self.controls.paused = self.tracker.age(now) > self.station.safety.position_age_s
            blind = self.controls.continue_blind_flight(self.state in IN_AIR, self._measured_place(now), now)
            if not blind and self.last is not None:
                self.controls.slow_down(self._speed, now)
            if self.state not in OFF:
                self.link.order_log(now)
            if self.state in WATCHED_OVER and (order := self.controls.delivery.due(now)) is not None:
                self.link.order(order)

    def feed_watchdog(self, now: float, watchdog: bool) -> None:
        """What has to be sent regularly: the emergency stop watchdog, and blind landings."""
        with self.lock:
            self.controls.repeat_due_landing(self._height, now)
            # From the first arming on: once it has begun, the firmware locks itself when it ends.
            self.guarded |= watchdog and self.state in WATCHED_OVER
            self.link.guarded = self.guarded
            if self.guarded and self.state not in (*OFF, State.EMERGENCY):
                self.link.order(lambda cf: cf.supervisor.send_emergency_stop_watchdog())


def position_order(tracker: PoseTracker) -> Send:
    """Return an order that sends a Crazyflie the last accepted pose."""
    pose = tracker.last
    assert pose is not None

    def send(cf: Any) -> None:
        if tracker.settings.send == EXTPOSE and pose.orientation is not None:
            cf.loc.send_extpose(pose.position, pose.orientation)
        else:
            cf.loc.send_extpos(pose.position)
        tracker.count_sent(pose, time.time())

    return send
