"""What is known of one Crazyflie: by its own log, and by motion capture. The vehicle's lock protects it."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from dtsa_agent.crazyflie.positions.estimates import EstimateWatch, Settling
from dtsa_agent.crazyflie.positions.motion_capture import EXTPOSE, Room, Seen, Tracker
from dtsa_agent.crazyflie.settings import RobotSettings, StationSettings
from dtsa_agent.crazyflie.state.conversions import Quaternion, Vector, VehicleState
from dtsa_agent.crazyflie.state.state_machine import IS_FLYING

QUALITY_WINDOW_S = 1.0
COMPLAIN_S = 5.0  # a vehicle's refused poses stand in the log this often at most


class KnownState:
    """State of one Crazyflie as far as it is known, and whether that can be true. Times (`now`) are s, monotonic."""

    def __init__(self, robot: RobotSettings, station: StationSettings, log: Callable[[str, str], None]) -> None:
        self._robot, self._log = robot, log
        self.last: VehicleState | None = None
        self._log_times: deque[float] = deque(maxlen=200)
        self._trusted_height = 0.0  # m, the last one before the estimate was wrong
        safety, positions, origin = station.safety, station.positions, station.room_origin_in_world
        room: Room | None = (safety.geofence_min, safety.geofence_max) if safety.geofence else None
        self.tracker = Tracker(positions, origin, room) if positions.on else None  # None: there is no motion capture
        self._complained = -math.inf
        self._watch = EstimateWatch(safety.estimate_jump_m, safety.estimate_freeze_s, safety.estimate_error_m)
        agree_m = positions.agree_m if positions.on else None
        self.settling = Settling(robot.estimator_variance_m2, origin, room, agree_m)

    # -- its own log ------------------------------------------------------------------------------------------------
    def note(self, state: VehicleState, now: float) -> None:
        """A log packet with values that were taken at this time."""
        self.last = state
        self._log_times.append(now)

    def judge(self, state: VehicleState, now: float) -> None:
        """Whether the estimate in a log packet can be true; if it cannot, it is logged once."""
        if not self._watch.wrong:
            self._trusted_height = max(state.position[2], 0.0)
        if self._watch.update(state, now, self.seen_at(now), flying=bool(state.info & IS_FLYING)):
            self._log("error", f"{self._robot.name}: {self._watch.wrong}")

    @property
    def wrong(self) -> str:
        """What is wrong with the estimate; empty: nothing."""
        return self._watch.wrong

    def wrong_s(self, now: float) -> float:
        """For how long it has been wrong, s."""
        return now - self._watch.since

    @property
    def speed(self) -> float:
        """Last known speed, m/s."""
        return 0.0 if self.last is None else math.hypot(*self.last.velocity)

    @property
    def height(self) -> float:
        """Last known height above the floor, m."""
        return self.last.position[2] if self.last is not None else 1.0

    def log_age(self, now: float) -> float:
        """Seconds since the last log packet; infinite before the first one."""
        return now - self._log_times[-1] if self._log_times else math.inf

    def logged(self, now: float) -> float:
        """Share of the last second's expected log packets that came, 0..1."""
        recent = sum(1 for t in self._log_times if now - t <= QUALITY_WINDOW_S)
        return min(1.0, recent / (self._robot.log_rate_hz * QUALITY_WINDOW_S))

    # -- motion capture ---------------------------------------------------------------------------------------------
    def see(self, position: Vector, orientation: Quaternion, frame: str, stamp: float) -> Callable[[Any], None] | None:
        """A pose from motion capture (see `Tracker.offer`); what the Crazyflie is to be told, None: nothing."""
        tracker, now = self.tracker, time.monotonic()
        if tracker is None:
            return None
        flying = self.last is not None and bool(self.last.info & IS_FLYING)
        if problem := tracker.offer(position, orientation, frame, stamp, now, flying=flying):
            if now - self._complained > COMPLAIN_S:
                self._complained = now
                self._log("warn", f"{self._robot.name}: a pose of motion capture is refused: {problem}")
            return None
        assert tracker.last is not None
        return _packet(tracker, tracker.last) if tracker.due(now) else None

    def seen_at(self, now: float) -> Vector | None:
        """Where motion capture sees it (m, world); None: not at all, or not any more."""
        return None if self.tracker is None else self.tracker.place(now)

    def unseen_s(self, now: float) -> float | None:
        """Seconds since motion capture saw it; None: there is no motion capture."""
        return None if self.tracker is None else self.tracker.age(now)

    def misplaced(self) -> str:
        """Why its motors may not start: it does not know where it stands. Empty if it does."""
        if self.tracker is None or self.last is None:
            return ""
        problem = self.tracker.disagrees(self.last.position, time.monotonic())
        return f"{self._robot.name} {problem}" if problem else ""

    def sinking_height(self, now: float) -> float:
        """Height (m) from which it sinks when its estimate is wrong."""
        seen = self.seen_at(now)
        return self._trusted_height if seen is None else seen[2]


def _packet(tracker: Tracker, seen: Seen) -> Callable[[Any], None]:
    def send(cf: Any) -> None:
        if tracker.settings.send == EXTPOSE and seen.orientation is not None:
            cf.loc.send_extpose(seen.position, seen.orientation)
        else:
            cf.loc.send_extpos(seen.position)
        tracker.was_sent(seen, time.time())

    return send
