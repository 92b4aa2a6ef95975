"""Poses of one Crazyflie from motion capture: plausibility checks, and agreement with the onboard estimate.

A refused pose is counted by its cause and never sent.
Times (`now`) are s, monotonic; stamps are s, Unix time, 0: not known.
"""

from __future__ import annotations

import math
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from dtsa_agent.core.settings.declaration import Settings, setting

from .safety import SafetySettings, outside_fence
from .state import Quaternion, Vector, place_text, to_world

NONE, POSE, NAMED_POSES = "none", "pose", "named_poses"
EXTPOS, EXTPOSE = "extpos", "extpose"
MAX_SPEED_MPS = 3.0  # of a vehicle, carried or flying, between two poses
NORM_TOLERANCE = 0.05  # of a quaternion's length
MAX_TURN_RAD, MAX_TURN_RADPS = 0.5, 15.0  # between two poses: a fixed part, and one that grows with time
MAX_TILT_RAD = 1.2  # from level, in flight
MAX_DRIFT = 1e-3  # s/s, of two clocks against each other
POSES_AFTER_JUMP = 20  # that agree: then the vehicle was carried on the ground, or a clock was set
FRESH_POSE_S = 0.3  # an older pose no longer tells where the vehicle is
ROOM_MARGIN_M = 0.3  # by which a pose or an estimate may lie outside the geofence
SETTLED_SAMPLES, SETTLED_SPREAD_M = 5, 0.05  # a settled estimate moves less than this over so many samples


@dataclass(frozen=True, slots=True)
class PositionSettings(Settings):
    """Positions from motion capture."""

    source: str = setting(
        NONE,
        "what measures positions: decks on the Crazyflies (none), geometry_msgs/PoseStamped of each, or "
        "motion_capture_tracking_interfaces/NamedPoseArray",
        choices=(NONE, POSE, NAMED_POSES),
    )
    topic: str = setting("", "topic of the poses; {name} is the Crazyflie's; empty: /{name}/pose, or /poses if named")
    send: str = setting(EXTPOSE, "what the bridge sends to the Crazyflies: places, or places with attitudes",
        choices=(EXTPOS, EXTPOSE))  # fmt: skip
    max_rate_hz: float = setting(
        100.0, "sent at most this often, each to its own Crazyflie; counts in the radio budget",
        unit="Hz", minimum=1, maximum=200,
    )  # fmt: skip
    agree_m: float = setting(
        0.1, "largest distance from the estimate to motion capture with which a vehicle is ready, armed, and takes off",
        unit="m", minimum=0.005, maximum=1,
    )  # fmt: skip
    jump_m: float = setting(0.3, f"a pose farther than this, and {MAX_SPEED_MPS:g} m/s, from the one before is refused",
        unit="m", minimum=0.01, maximum=10)  # fmt: skip
    late_s: float = setting(
        0.06, "a pose that takes so much longer than the fastest one is refused: the vehicle has moved on",
        unit="s", minimum=0.005, maximum=10,
    )  # fmt: skip

    @property
    def enabled(self) -> bool:
        return self.source != NONE

    def topic_of(self, name: str) -> str:
        return (self.topic or ("/{name}/pose" if self.source == POSE else "/poses")).replace("{name}", name)


class MeasuredPose(NamedTuple):
    """A pose of motion capture that passed the checks."""

    position: Vector  # m, world
    orientation: Quaternion | None  # None: not known
    stamp: float
    time: float  # arrival, s, monotonic


class RefusedPose(Exception):
    """A pose fails a check; its arguments are the cause, by which refusals are counted, and the reason."""


@dataclass(slots=True)
class PoseTracker:
    """Checks the poses of one Crazyflie, keeps the last accepted one, and compares its estimates with it.

    :param origin: m, of frame `map` in the Crazyflies' world.
    """

    settings: PositionSettings
    safety: SafetySettings
    origin: Vector
    last: MeasuredPose | None = None
    refused: Counter[str] = field(default_factory=Counter)
    reason: str = ""  # why the last pose was refused; empty: it was accepted
    sent: int = 0  # poses sent to the Crazyflie
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=500))  # s, from the stamp to the packet
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=512))  # arrivals of accepted poses
    _after_jump: tuple[MeasuredPose, int] | None = None  # last of consecutive refused poses that agree; their number
    _min_delay: float = math.inf  # s, from stamp to arrival, of the fastest pose; any size: there are two clocks
    _next_send: float = -math.inf

    def receive_pose(
        self, position: Vector, orientation: Sequence[float], frame: str, stamp: float, now: float, *, flying: bool
    ) -> str:
        """Check a pose (m, in `frame`: `world`, also empty, or `map`); return why it is refused, empty if it is not.

        In flight a pose that jumps is always refused, and so is an exact copy of the pose before.
        """
        try:
            pose = self._check_alone(position, orientation, frame, stamp, now, flying=flying)
            try:
                self._check_follows(pose, flying=flying)
            except RefusedPose:
                confirmed = self._confirm_jump(pose)
                if flying or not confirmed:
                    raise
                self._min_delay = math.inf  # perhaps the clock was set
        except RefusedPose as problem:
            cause, self.reason = problem.args
            self.refused[cause] += 1
            return self.reason
        if stamp:
            waited = 0.0 if self.last is None else now - self.last.time
            self._min_delay = min(self._min_delay + MAX_DRIFT * waited, now - stamp)
        self.last, self.reason, self._after_jump = pose, "", None
        self._times.append(now)
        return ""

    def _check_alone(
        self, position: Vector, orientation: Sequence[float], frame: str, stamp: float, now: float, *, flying: bool
    ) -> MeasuredPose:
        """Check what a pose says by itself: frame, room, attitude; RefusedPose: it is impossible."""
        if frame not in ("", "world", "map"):
            raise RefusedPose("frame", f"frame_id {frame!r:.40} is neither world nor map")
        if not all(map(math.isfinite, (*position, *orientation))):
            raise RefusedPose("not finite", "the pose is not finite")
        place = to_world(position, self.origin) if frame == "map" else position
        if outside := outside_fence(place, self.safety, self.origin, ROOM_MARGIN_M):
            raise RefusedPose("outside", outside)
        if self.settings.send != EXTPOSE:
            return MeasuredPose(place, None, stamp, now)
        norm = math.hypot(*orientation)
        if abs(norm - 1.0) > NORM_TOLERANCE:
            raise RefusedPose("quaternion", f"the quaternion has length {norm:.3g}, not 1 (send: extpos needs none)")
        x, y, z, w = (c / norm for c in orientation)
        tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))
        if flying and tilt > MAX_TILT_RAD:
            raise RefusedPose("attitude", f"it is tilted by {math.degrees(tilt):.0f} degrees in flight")
        return MeasuredPose(place, (x, y, z, w), stamp, now)

    def _check_follows(self, pose: MeasuredPose, *, flying: bool) -> None:
        """Check a pose against the last one: order, delay, speed; RefusedPose: it cannot follow."""
        if (last := self.last) is None:
            return
        passed = pose.time - last.time
        if pose.stamp and last.stamp and pose.stamp <= last.stamp:
            raise RefusedPose("stamp", f"its stamp is {last.stamp - pose.stamp:.3f} s before that of the last one")
        late = pose.time - pose.stamp - self._min_delay
        if pose.stamp and late > self.settings.late_s + MAX_DRIFT * passed:
            raise RefusedPose("late", f"it comes {late * 1000:.0f} ms later than the fastest one")
        if flying and (pose.position, pose.orientation) == (last.position, last.orientation):
            raise RefusedPose("repeated", f"the same pose again, {passed:.2f} s later: motion capture stands still")
        jump = math.dist(pose.position, last.position)
        if jump > self.settings.jump_m + MAX_SPEED_MPS * passed:
            raise RefusedPose("jump", f"it jumps by {jump:.2f} m within {passed:.2f} s")
        if pose.orientation is not None and last.orientation is not None:
            same = abs(sum(a * b for a, b in zip(pose.orientation, last.orientation, strict=True)))
            turn = 2.0 * math.acos(min(1.0, same))
            if turn > MAX_TURN_RAD + MAX_TURN_RADPS * passed:
                raise RefusedPose("attitude", f"it turns by {math.degrees(turn):.0f} degrees within {passed:.2f} s")

    def _confirm_jump(self, pose: MeasuredPose) -> bool:
        """Whether enough consecutive poses agree on a place, or a time, that the last accepted pose does not have."""
        before, count = self._after_jump or (pose, 0)
        agrees = math.dist(before.position, pose.position) <= self.settings.jump_m
        if count and (not agrees or (pose.stamp and pose.stamp <= before.stamp)):
            count = 0
        self._after_jump = pose, count + 1
        return count + 1 >= POSES_AFTER_JUMP

    def is_due(self, now: float) -> bool:
        """Whether the last pose may be sent now, at `max_rate_hz` at most."""
        if now < self._next_send:
            return False
        # Almost a period of credit: poses at exactly this rate arrive with jitter, and all of them shall be sent.
        period = 1.0 / self.settings.max_rate_hz
        self._next_send = max(self._next_send, now - 0.9 * period) + period
        return True

    def send(self, cf: Any) -> None:
        """Send the last accepted pose to its Crazyflie, cflib's."""
        pose = self.last
        assert pose is not None
        if pose.orientation is None:
            cf.loc.send_extpos(pose.position)
        else:
            cf.loc.send_extpose(pose.position, pose.orientation)
        self.sent += 1
        if pose.stamp:
            self.latencies.append(time.time() - pose.stamp)

    def age(self, now: float) -> float:
        """Return the time since the last accepted pose, s; infinite before the first."""
        return math.inf if self.last is None else now - self.last.time

    def rate_hz(self, now: float) -> float:
        return float(sum(now - t <= 1.0 for t in self._times.copy()))

    def measured_position(self, now: float) -> Vector | None:
        """Return the vehicle's measured position (m, world); None if there is no fresh pose."""
        return None if self.last is None or self.age(now) > FRESH_POSE_S else self.last.position

    def why_estimate_wrong(self, estimate: Vector, now: float) -> str:
        """Return why a vehicle with this estimate of its position (m, world) may not start; empty if it may."""
        if not self.settings.enabled:
            return ""
        measured = self.measured_position(now)
        if measured is None:
            return f"is not seen by motion capture ({self.reason or 'no pose comes'})"
        error, limit = math.dist(measured, estimate), self.settings.agree_m
        where = f"{error:.2f} m from where it believes to be (limit {limit:g} m)"
        return "" if error <= limit else f"is seen {where}: reconnect it"

    def why_not_settled(self, places: Sequence[Vector], variance: float, limit: float, now: float) -> str:
        """Return why an estimator has not settled after a restart; empty if it has: steady, inside the room, accurate.

        With motion capture the estimate must agree with the measured position; without, its variances must be small.

        :param places: m, world, the last estimates.
        :param variance: the largest one, m^2, and its limit.
        """
        place, measured, agree_m = places[-1], self.measured_position(now), self.settings.agree_m
        where = place_text(place)
        if not all(map(math.isfinite, (*place, variance))):
            return f"its estimate is not finite {where}"
        if self.settings.enabled:
            if measured is None:
                return "motion capture does not see it"
            if (error := math.dist(place, measured)) > agree_m:
                at = place_text(measured)
                return f"it believes to be at {where}, motion capture sees it {error:.2f} m away at {at}"
        elif variance > limit:
            return f"variance {variance:.3g} m^2, limit {limit:g} m^2, at {where}"
        if outside := outside_fence(place, self.safety, self.origin, ROOM_MARGIN_M):
            return f"it believes to be outside: {outside}"
        last = places[-SETTLED_SAMPLES:]
        spread = max(math.dist(place, p) for p in last)
        if len(last) < SETTLED_SAMPLES or spread > SETTLED_SPREAD_M:
            return f"its place moves by {spread:.2f} m, at {where}"
        return ""


def quantile(values: deque[float], share: float) -> float:
    """Return a quantile of what other threads may add to; 0: there is nothing."""
    ordered = sorted(values.copy())
    return ordered[int(share * (len(ordered) - 1))] if ordered else 0.0
