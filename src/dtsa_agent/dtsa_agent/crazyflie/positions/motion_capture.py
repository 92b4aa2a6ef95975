"""Where motion capture sees one Crazyflie: what may be believed of it, how old it is, and how fast it comes.

Pure: poses, stamps and clocks come in as arguments. What is refused is counted by its reason and never sent.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import dataclass, field

from dtsa_agent.core.settings.declaration import Settings, setting
from dtsa_agent.crazyflie.state.conversions import Quaternion, Vector, outside_by, place_text, to_map, to_world

NONE, POSE, NAMED_POSES = "none", "pose", "named_poses"
EXTPOS, EXTPOSE = "extpos", "extpose"
FASTEST_MPS = 3.0  # no vehicle is carried or flies faster from one pose to the next
NORM_TOLERANCE = 0.05  # of a quaternion's length
DRIFT = 1e-3  # s/s, by which two clocks may drift apart
MOVED_AGAIN = 20  # poses in a row that agree with each other: on the ground it was carried, or a clock was set
WINDOW_S = 1.0  # over which the rate is counted
FRESH_S = 0.3  # a pose that is not older is where the vehicle is
ROOM_MARGIN_M = 0.3  # outside the geofence a pose or an estimate may be this far and still be meant

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
    send: str = setting(
        EXTPOSE, "what the bridge sends to the Crazyflies: places, or places with attitudes", choices=(EXTPOS, EXTPOSE)
    )
    max_rate_hz: float = setting(
        100.0, "sent at most this often, each to its own Crazyflie; counts in the radio budget",
        unit="Hz", minimum=1, maximum=200,
    )  # fmt: skip
    agree_m: float = setting(
        0.1, "largest distance from the estimate to motion capture with which a vehicle is ready, armed, and takes off",
        unit="m", minimum=0.005, maximum=1,
    )  # fmt: skip
    jump_m: float = setting(
        0.3, f"a pose farther than this, and {FASTEST_MPS:g} m/s, from the one before is refused",
        unit="m", minimum=0.01, maximum=10,
    )  # fmt: skip
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
class Seen:
    """A pose of motion capture that is believed."""

    position: Vector  # m, world
    orientation: Quaternion | None  # None: not known
    stamp: float  # s, Unix time of the measurement; 0: not said
    time: float  # s, monotonic, of its arrival


@dataclass(frozen=True, slots=True)
class PositionNumbers:
    """What came from motion capture, for those who watch."""

    rate: float  # Hz, believed
    latency_p50: float  # s, from the measurement to the packet to the Crazyflie; 0: unknown
    latency_p99: float
    age: float  # s; infinite: never seen
    sent: int
    refused: dict[str, int]  # by reason
    reason: str  # why the last one was refused


@dataclass(slots=True)
class _Candidate:
    """Poses that were refused as a jump, but agree with each other."""

    position: Vector
    stamp: float
    count: int = 1


@dataclass(slots=True)
class Tracker:
    """Poses of one Crazyflie. Times (`now`) are s, monotonic; stamps are s, Unix time, 0: not known.

    :param settings: what is believed.
    :param origin: m, where the Crazyflies' world sees the origin of `map`.
    :param room: nobody is outside of it (m, map), but for a margin; None: no limits.
    """

    settings: PositionSettings
    origin: Vector
    room: Room | None
    last: Seen | None = None
    refused: Counter[str] = field(default_factory=Counter)
    reason: str = ""  # why the last one was refused; empty: it was not
    sent: int = 0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=500))  # s
    _times: deque[float] = field(default_factory=lambda: deque(maxlen=512))
    _candidate: _Candidate | None = None
    _least_lag: float = math.inf  # s, from the stamp to the arrival, of the fastest one; two clocks: of any size
    _next_send: float = -math.inf

    def offer(
        self, position: Vector, orientation: Quaternion, frame: str, stamp: float, now: float, *, flying: bool
    ) -> str:
        """Check a pose (m, in `frame`: `world`, also empty, or `map`); why it is not believed, or an empty text.

        In flight nothing that has jumped is believed again.
        """
        found = self._check(position, orientation, frame, stamp, now, flying=flying)
        if isinstance(found, Seen):
            waited = 0.0 if self.last is None else now - self.last.time
            if stamp:
                self._least_lag = min(self._least_lag + DRIFT * waited, now - stamp)
            self.last, self.reason, self._candidate = found, "", None
            self._times.append(now)
        else:
            kind, self.reason = found
            self.refused[kind] += 1
        return self.reason

    def _check(
        self, position: Vector, orientation: Quaternion, frame: str, stamp: float, now: float, *, flying: bool
    ) -> Seen | tuple[str, str]:
        """The pose, or the kind and the text of what is wrong with it."""
        if frame not in ("", "world", "map"):
            return "frame", f"frame_id {frame!r:.40} is neither world nor map"
        if not all(math.isfinite(v) for v in (*position, *orientation)):
            return "not finite", "the pose is not finite"
        place = to_world(position, self.origin) if frame == "map" else position
        if outside := outside_room(place, self.origin, self.room):
            return "outside", outside
        attitude: Quaternion | None = None
        norm = math.sqrt(sum(c * c for c in orientation))
        if abs(norm - 1.0) <= NORM_TOLERANCE:
            x, y, z, w = (c / norm for c in orientation)
            attitude = (x, y, z, w)
        elif self.settings.send == EXTPOSE:
            return "quaternion", f"the quaternion has length {norm:.3g}, not 1 (send: extpos needs none)"
        seen = Seen(place, attitude, stamp, now)
        if self.last is None:
            return seen
        problem = self._follows(self.last, seen)
        if problem is None:
            return seen
        if not self._settled_elsewhere(seen, flying=flying):
            return problem
        self._least_lag = math.inf  # perhaps the clock was set
        return seen

    def _follows(self, last: Seen, seen: Seen) -> tuple[str, str] | None:
        """What keeps a pose from following the one before."""
        if seen.stamp and last.stamp and seen.stamp <= last.stamp:
            return "stamp", f"its stamp is {last.stamp - seen.stamp:.3f} s before that of the last one"
        late = seen.time - seen.stamp - self._least_lag
        if seen.stamp and late > self.settings.late_s + DRIFT * (seen.time - last.time):
            return "late", f"it comes {late * 1000:.0f} ms later than the fastest one"
        jump = math.dist(seen.position, last.position)
        if jump > self.settings.jump_m + FASTEST_MPS * (seen.time - last.time):
            return "jump", f"it jumps by {jump:.2f} m within {seen.time - last.time:.2f} s"
        return None

    def _settled_elsewhere(self, seen: Seen, *, flying: bool) -> bool:
        """Whether enough poses agree on another place, or another time, than the last one that was believed."""
        before = self._candidate
        if (
            before is None
            or math.dist(before.position, seen.position) > self.settings.jump_m
            or (seen.stamp and seen.stamp <= before.stamp)
        ):
            self._candidate = _Candidate(seen.position, seen.stamp)
            return False
        before.position, before.stamp = seen.position, seen.stamp
        before.count += 1
        return before.count >= MOVED_AGAIN and not flying

    def due(self, now: float) -> bool:
        """Whether the last pose may be sent, at the rate that is allowed."""
        if now < self._next_send:
            return False
        # Almost a period of credit: poses at exactly this rate come early and late, and shall all be sent.
        period = 1.0 / self.settings.max_rate_hz
        self._next_send = max(self._next_send, now - 0.9 * period) + period
        return True

    def was_sent(self, seen: Seen, wall: float) -> None:
        """A pose has gone to its Crazyflie at a Unix time (s)."""
        self.sent += 1
        if seen.stamp:
            self.latencies.append(wall - seen.stamp)

    def age(self, now: float) -> float:
        """Seconds since the last pose that was believed; infinite before the first."""
        return math.inf if self.last is None else now - self.last.time

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

    def numbers(self, now: float) -> PositionNumbers:
        """Everything for the diagnostics."""
        recent = sum(1 for t in self._times.copy() if now - t <= WINDOW_S)
        delays = sorted(self.latencies.copy())
        return PositionNumbers(
            recent / WINDOW_S,
            delays[len(delays) // 2] if delays else 0.0,
            delays[int(0.99 * (len(delays) - 1))] if delays else 0.0,
            self.age(now),
            self.sent,
            dict(self.refused),
            self.reason,
        )


def outside_room(place: Vector, origin: Vector, room: Room | None) -> str:
    """How a place (m, world) is outside a room (m, map; None: no limits), with a margin; empty if it is not."""
    if room is None:
        return ""
    for away, axis in outside_by(to_map(place, origin), *room):
        if away > ROOM_MARGIN_M:
            return f"{place_text(place)} in the world is {away:.2f} m outside the room in {axis}"
    return ""
