"""Where motion capture sees one Crazyflie: what may be believed of it, and whether the Crazyflie knows it, too. Pure.

Poses, stamps and clocks come in as arguments. A pose that is not believed is counted by its reason and never sent.
Times (`now`) are s, monotonic; stamps are s, Unix time, 0: not known.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field

from dtsa_agent.core.settings.declaration import Settings, setting

from .state import Quaternion, Vector, outside_by, place_text, to_map, to_world

NONE, POSE, NAMED_POSES = "none", "pose", "named_poses"
EXTPOS, EXTPOSE = "extpos", "extpose"
FASTEST_MPS = 3.0  # no vehicle is carried or flies faster from one pose to the next
NORM_TOLERANCE = 0.05  # of a quaternion's length
TURN_RAD, FASTEST_RADPS = 0.5, 15.0  # no vehicle turns further at once, and faster
TILT_RAD = 1.2  # no vehicle flies so far from level
DRIFT = 1e-3  # s/s, by which two clocks may drift apart
MOVED_AGAIN = 20  # poses in a row that agree with each other: on the ground it was carried, or a clock was set
FRESH_S = 0.3  # a pose that is not older is where the vehicle is
ROOM_MARGIN_M = 0.3  # outside the geofence a pose or an estimate may be this far and still be meant
SAMPLES, STEADY_M = 5, 0.05  # of a settled estimator: its place moves less than that over so many samples

Room = tuple[Vector, Vector]  # lower and upper corner, m, frame map


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
    jump_m: float = setting(0.3, f"a pose farther than this, and {FASTEST_MPS:g} m/s, from the one before is refused",
        unit="m", minimum=0.01, maximum=10)  # fmt: skip
    late_s: float = setting(
        0.06, "a pose that takes so much longer than the fastest one is refused: the vehicle has moved on",
        unit="s", minimum=0.005, maximum=10,
    )  # fmt: skip

    @property
    def on(self) -> bool:
        """Whether there is motion capture."""
        return self.source != NONE

    def topic_of(self, name: str) -> str:
        """Topic on which the poses of a Crazyflie come."""
        return (self.topic or ("/{name}/pose" if self.source == POSE else "/poses")).replace("{name}", name)


@dataclass(frozen=True, slots=True)
class MeasuredPose:
    """A pose of motion capture that is believed."""

    position: Vector  # m, world
    orientation: Quaternion | None  # None: not known
    stamp: float
    time: float  # of its arrival


class RefusedPose(Exception):
    """A pose is not believed: the kind, and why."""

    def __init__(self, kind: str, reason: str) -> None:
        super().__init__(reason)
        self.kind = kind


@dataclass(slots=True)
class PoseTracker:
    """Poses of one Crazyflie.

    :param origin: m, where the Crazyflies' world sees the origin of `map`.
    :param room: corners of the box (m, map) outside of which no pose is believed, but for a margin; None: no limits.
    """

    settings: PositionSettings
    origin: Vector
    room: Room | None
    last: MeasuredPose | None = None
    refused: Counter[str] = field(default_factory=Counter)
    reason: str = ""  # why the last one was refused; empty: it was not
    sent: int = 0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=500))  # s, from the stamp to the packet
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=512))
    _elsewhere: tuple[MeasuredPose, int] | None = None  # the last of poses that were refused but agree; their number
    _least_lag: float = math.inf  # s, from the stamp to the arrival, of the fastest one; two clocks: of any size
    _next_send: float = -math.inf

    def offer(
        self, position: Vector, orientation: Quaternion, frame: str, stamp: float, now: float, *, flying: bool
    ) -> str:
        """Check a pose (m, in `frame`: `world`, also empty, or `map`); why it is not believed, or an empty text.

        In flight nothing that has jumped is believed again, and nothing that repeats the pose before to the last bit.
        """
        try:
            seen = self._plausible(position, orientation, frame, stamp, now, flying=flying)
            if self.last is not None:
                try:
                    self._check_follows(self.last, seen, flying=flying)
                except RefusedPose:
                    agrees = self._agrees_elsewhere(seen)
                    if flying or not agrees:
                        raise
                    self._least_lag = math.inf  # perhaps the clock was set
        except RefusedPose as problem:
            self.refused[problem.kind] += 1
            self.reason = str(problem)
            return self.reason
        if stamp:
            waited = 0.0 if self.last is None else now - self.last.time
            self._least_lag = min(self._least_lag + DRIFT * waited, now - stamp)
        self.last, self.reason, self._elsewhere = seen, "", None
        self._times.append(now)
        return ""

    def _plausible(
        self, position: Vector, orientation: Quaternion, frame: str, stamp: float, now: float, *, flying: bool
    ) -> MeasuredPose:
        if frame not in ("", "world", "map"):
            raise RefusedPose("frame", f"frame_id {frame!r:.40} is neither world nor map")
        if not all(math.isfinite(v) for v in (*position, *orientation)):
            raise RefusedPose("not finite", "the pose is not finite")
        place = to_world(position, self.origin) if frame == "map" else position
        if outside := outside_room(place, self.origin, self.room):
            raise RefusedPose("outside", outside)
        norm = math.sqrt(sum(c * c for c in orientation))
        if self.settings.send != EXTPOSE:
            return MeasuredPose(place, None, stamp, now)
        if abs(norm - 1.0) > NORM_TOLERANCE:
            raise RefusedPose("quaternion", f"the quaternion has length {norm:.3g}, not 1 (send: extpos needs none)")
        x, y, z, w = (c / norm for c in orientation)
        tilt = math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y))))
        if flying and tilt > TILT_RAD:
            raise RefusedPose("attitude", f"it is tilted by {math.degrees(tilt):.0f} degrees in flight")
        return MeasuredPose(place, (x, y, z, w), stamp, now)

    def _check_follows(self, last: MeasuredPose, seen: MeasuredPose, *, flying: bool) -> None:
        """Whether a pose can follow the one before; RefusedPose: it cannot."""
        passed = seen.time - last.time
        if seen.stamp and last.stamp and seen.stamp <= last.stamp:
            raise RefusedPose("stamp", f"its stamp is {last.stamp - seen.stamp:.3f} s before that of the last one")
        late = seen.time - seen.stamp - self._least_lag
        if seen.stamp and late > self.settings.late_s + DRIFT * passed:
            raise RefusedPose("late", f"it comes {late * 1000:.0f} ms later than the fastest one")
        if flying and (seen.position, seen.orientation) == (last.position, last.orientation):
            raise RefusedPose("repeated", f"the same pose again, {passed:.2f} s later: motion capture stands still")
        jump = math.dist(seen.position, last.position)
        if jump > self.settings.jump_m + FASTEST_MPS * passed:
            raise RefusedPose("jump", f"it jumps by {jump:.2f} m within {passed:.2f} s")
        if seen.orientation is not None and last.orientation is not None:
            same = abs(sum(a * b for a, b in zip(seen.orientation, last.orientation, strict=True)))
            turn = 2.0 * math.acos(min(1.0, same))
            if turn > TURN_RAD + FASTEST_RADPS * passed:
                raise RefusedPose("attitude", f"it turns by {math.degrees(turn):.0f} degrees within {passed:.2f} s")

    def _agrees_elsewhere(self, seen: MeasuredPose) -> bool:
        """Whether enough poses agree on another place, or another time, than the last one that was believed."""
        before, count = self._elsewhere or (seen, 0)
        agrees = math.dist(before.position, seen.position) <= self.settings.jump_m
        if count and (not agrees or (seen.stamp and seen.stamp <= before.stamp)):
            count = 0
        self._elsewhere = seen, count + 1
        return count + 1 >= MOVED_AGAIN

    def due(self, now: float) -> bool:
        """Whether the last pose may be sent, at the rate that is allowed."""
        if now < self._next_send:
            return False
        # Almost a period of credit: poses at exactly this rate come early and late, and shall all be sent.
        period = 1.0 / self.settings.max_rate_hz
        self._next_send = max(self._next_send, now - 0.9 * period) + period
        return True

    def count_sent(self, seen: MeasuredPose, wall: float) -> None:
        """A pose has gone to its Crazyflie at a Unix time (s)."""
        self.sent += 1
        if seen.stamp:
            self.latencies.append(wall - seen.stamp)

    def age(self, now: float) -> float:
        """Seconds since the last pose that was believed; infinite before the first."""
        return math.inf if self.last is None else now - self.last.time

    def rate(self, now: float) -> float:
        """Poses that were believed in the last second."""
        return float(sum(1 for t in self._times.copy() if now - t <= 1.0))

    def latency(self, share: float) -> float:
        """Latency (s) that this share of the last poses kept; 0: unknown."""
        delays = sorted(self.latencies.copy())
        return delays[int(share * (len(delays) - 1))] if delays else 0.0

    def place(self, now: float) -> Vector | None:
        """Where the vehicle is (m, world); None: it is not seen, or not any more."""
        return None if self.last is None or self.age(now) > FRESH_S else self.last.position

    def disagrees(self, believed: Vector, now: float) -> str:
        """Why a vehicle may not start that believes to be there (m, world); empty if it may."""
        seen = self.place(now)
        if seen is None:
            return f"is not seen by motion capture ({self.reason or 'no pose comes'})"
        away = math.dist(seen, believed)
        if away <= self.settings.agree_m:
            return ""
        return f"is seen {away:.2f} m from where it believes to be (limit {self.settings.agree_m:g} m): reconnect it"


def outside_room(place: Vector, origin: Vector, room: Room | None) -> str:
    """How a place (m, world) is outside a room (m, map; None: no limits), with a margin; empty if it is not."""
    for away, axis in outside_by(to_map(place, origin), *room) if room is not None else ():
        if away > ROOM_MARGIN_M:
            return f"{place_text(place)} in the world is {away:.2f} m outside the room in {axis}"
    return ""


@dataclass(slots=True)
class SettlingCheck:
    """Decides when the estimator of a Crazyflie has settled after it was restarted.

    With motion capture: when its place agrees with where the vehicle is seen. Without: when its variances are small.
    In both cases the place must be steady, and inside the room.

    :param variance_limit: m^2.
    :param agree_m: m, largest distance from where it is seen; None: there is no motion capture.
    """

    variance_limit: float
    origin: Vector
    room: Room | None
    agree_m: float | None
    problem: str = "nothing is known about it"
    _places: deque[Vector] = field(default_factory=lambda: deque(maxlen=SAMPLES))

    def restart(self) -> None:
        """The filter was restarted: what was logged before does not count."""
        self.problem = "the firmware logs nothing about it"
        self._places.clear()

    def sample(self, place: Vector, variances: Vector, seen: Vector | None) -> bool:
        """Take in what the firmware logs (m, world; m^2), and where it is seen; True once it has settled."""
        self._places.append(place)
        self.problem = self._what_is_wrong(place, variances, seen)
        return not self.problem

    def _what_is_wrong(self, place: Vector, variances: Vector, seen: Vector | None) -> str:
        where = place_text(place)
        if not all(math.isfinite(v) for v in (*place, *variances)):
            return f"its estimate is not finite {where}"
        if self.agree_m is not None:
            if seen is None:
                return "motion capture does not see it"
            away = math.dist(place, seen)
            if away > self.agree_m:
                return f"it believes to be at {where}, motion capture sees it {away:.2f} m away at {place_text(seen)}"
        elif max(variances) > self.variance_limit:
            return f"variance {max(variances):.3g} m^2, limit {self.variance_limit:g} m^2, at {where}"
        if outside := outside_room(place, self.origin, self.room):
            return f"it believes to be outside: {outside}"
        spread = max(math.dist(place, p) for p in self._places)
        if len(self._places) < SAMPLES or spread > STEADY_M:
            return f"its place moves by {spread:.2f} m, at {where}"
        return ""
