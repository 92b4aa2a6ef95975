"""The safety rules. Pure: what is known about all vehicles goes in, what must be done comes out.

| rule | what it watches | what it does |
|---|---|---|
| geofence | a flying vehicle outside the box | land it; farther out than `geofence_hard_m`: stop its motors |
| battery | voltage below a limit for `battery_s` | warn; below the critical limit: land |
| link | age of the last log packet in flight | declare it lost, order a landing blindly |
| commands | age of the last streamed command | hold the place, then land |
| heartbeat | the ground station's heartbeat, once heard | stop all motors |
| positions | age of the last pose from motion capture in flight | hold the place, then land |
| estimate | where a flying vehicle takes itself to be, if that cannot be | stop where it is, then sink |
| distance | two flying vehicles too close | land both |
| supervisor | tumbled, crashed, locked | stop sending to it |

A rule speaks once when it begins to apply, and again only after it has ceased to. What would lead outside is refused
before it is flown (`outside_fence`).
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, check, setting

from .state import IN_AIR, OFF, State, Vector, VehicleState, outside_by, place_text, to_map

MAY_MOVE = frozenset({State.ARMED, State.FLYING, State.LANDING, State.LOST})
UNSEEN = "not seen by motion capture"
ESTIMATE_HOLD_S = 1.0  # a vehicle whose estimate is wrong stands still that long, then it sinks
ACCELERATION = 1.5  # m/s per s of silence that velocities may have changed between two packets
STUCK_M = 0.15  # a place that does not change has lost its velocity after so much of it
STANDING_M = 0.15  # so low it may stand, or be about to: there is nothing to change
APART_S = 0.3  # s, how long estimate and motion capture may differ before it counts


class Action(enum.Enum):
    """What has to be done."""

    WARN = "warn"
    HOLD = "hold"
    LAND = "land"
    LOST = "lost"
    STOP = "stop"  # this vehicle's motors
    STOP_ALL = "stop all"


@dataclass(frozen=True, slots=True)
class SafetySettings(Settings):
    """Limits of all rules."""

    geofence: bool = setting(True, "watch that no vehicle leaves the box")
    geofence_min: Vector = setting((-1.5, -2.3, -0.95), "lower corner of the box, frame map", unit="m")
    geofence_max: Vector = setting((1.5, 2.3, 0.95), "upper corner of the box, frame map", unit="m")
    geofence_tolerance_m: float = setting(0.05, "measuring error that the fence lets pass",
        unit="m", minimum=0, maximum=1)  # fmt: skip
    geofence_hard_m: float = setting(0.8, "this far outside the motors are stopped",
        unit="m", minimum=0.05, maximum=100)  # fmt: skip
    battery: bool = setting(True, "watch the batteries")
    battery_s: float = setting(1.0, "how long the voltage must be low", unit="s", minimum=0, maximum=60)
    link_age_s: float = setting(0.5, "silence that makes a flying vehicle lost; 0: never",
        unit="s", minimum=0, maximum=10)  # fmt: skip
    command_age_s: float = setting(0.25, "age of the streamed command at which the place is held; 0: never",
        unit="s", minimum=0, maximum=0.45)  # fmt: skip
    command_land_s: float = setting(3.0, "age of the streamed command at which the vehicle lands",
        unit="s", minimum=0.1, maximum=600)  # fmt: skip
    heartbeat_s: float = setting(1.0, "silence of the ground station, once heard, that stops all motors; 0: never",
        unit="s", minimum=0, maximum=60)  # fmt: skip
    min_distance_m: float = setting(0.15, "two flying vehicles closer than this land; 0: never",
        unit="m", minimum=0, maximum=10)  # fmt: skip
    position_age_s: float = setting(
        0.3, "age of the last pose from motion capture at which the place is held; 0: never",
        unit="s", minimum=0, maximum=10,
    )  # fmt: skip
    position_land_s: float = setting(1.0, "age of the last pose from motion capture at which the vehicle lands",
        unit="s", minimum=0.05, maximum=60)  # fmt: skip
    estimate_jump_m: float = setting(
        0.5, "an estimate that moves so far at once, its velocity apart, is wrong; 0: never",
        unit="m", minimum=0, maximum=100,
    )  # fmt: skip
    estimate_freeze_s: float = setting(
        0.5, "an estimate that does not change at all for so long in flight is wrong; 0: never",
        unit="s", minimum=0, maximum=60,
    )  # fmt: skip
    estimate_error_m: float = setting(
        0.4, "an estimate so far from where motion capture sees the vehicle is wrong; 0: never",
        unit="m", minimum=0, maximum=100,
    )  # fmt: skip
    emergency_watchdog: bool = setting(True, "the firmware stops the motors 1 s after it last heard the bridge")

    def __post_init__(self) -> None:
        check(self)
        for axis, low, high in zip("xyz", self.geofence_min, self.geofence_max, strict=True):
            if low >= high:
                raise ConfigError("geofence_min", list(self.geofence_min), f"below geofence_max in {axis}")


def outside_fence(place: Vector, safety: SafetySettings, origin: Vector, margin: float | None = None) -> str:
    """How a place (m, world) is outside the geofence; empty if it is not, or if there is no fence.

    :param origin: m, where the world sees the origin of `map`.
    :param margin: m, that it may be outside; None: the fence's tolerance.
    """
    here = to_map(place, origin)
    away, axis = max(outside_by(here, safety.geofence_min, safety.geofence_max))
    if not safety.geofence or away <= (safety.geofence_tolerance_m if margin is None else margin):
        return ""
    return f"{place_text(here)} is {away:.2f} m outside the geofence in {axis}"


class WatchedVehicle(NamedTuple):
    """What the rules need to know about one vehicle."""

    name: str
    state: State
    position: Vector | None  # m, map
    battery: float  # V
    battery_warning: float  # V
    battery_critical: float  # V
    log_age: float  # s; infinite before the first packet
    command_age: float | None  # s since the last streamed command; None: high-level commands are in charge
    position_age: float | None = None  # s since motion capture saw it; None: there is no motion capture
    wrong: str = ""  # what is wrong with its estimate; empty: nothing
    wrong_s: float = 0.0  # s, for how long


class RequiredAction(NamedTuple):
    """Something has to be done."""

    name: str  # the vehicle; empty: all
    action: Action
    rule: str
    reason: str


Demands = Iterator[tuple[Action, str]]  # what a rule wants done with a vehicle, and why


class SafetyMonitor:
    """Applies the rules again and again."""

    def __init__(self, settings: SafetySettings) -> None:
        self.settings = settings
        self._active: set[tuple[str, str, Action]] = set()
        self._low_since: dict[tuple[str, str], float] = {}

    def check(
        self, now: float, vehicles: Sequence[WatchedVehicle], heartbeat_age: float | None
    ) -> list[RequiredAction]:
        """Return what has to be done now.

        :param heartbeat_age: s since the ground station's last heartbeat; None: it has never been heard.
        """
        s, found = self.settings, []
        for v in vehicles:
            rules = {
                "geofence": self._fence(v), "battery": self._battery(now, v), "link": self._link(v),
                "commands": _waits(v, v.command_age, s.command_age_s, s.command_land_s, "no command"),
                "positions": _waits(v, v.position_age, s.position_age_s, s.position_land_s, UNSEEN),
                "estimate": _estimate(v),
            }  # fmt: skip
            found += [RequiredAction(v.name, action, rule, why) for rule, all_ in rules.items() for action, why in all_]
        found += [RequiredAction(name, Action.LAND, "distance", why) for name, why in self._too_close(vehicles)]
        silent = heartbeat_age if s.heartbeat_s and (heartbeat_age or 0.0) > s.heartbeat_s else None
        if silent is not None and any(v.state in MAY_MOVE for v in vehicles):
            why = f"no heartbeat of the ground station for {silent:.2f} s"
            found.append(RequiredAction("", Action.STOP_ALL, "heartbeat", why))
        fresh = [v for v in found if (v.name, v.rule, v.action) not in self._active]
        self._active = {(v.name, v.rule, v.action) for v in found}
        return fresh

    def _fence(self, v: WatchedVehicle) -> Demands:
        s = self.settings
        if not s.geofence or v.state not in IN_AIR or v.position is None:
            return
        worst, axis = max(outside_by(v.position, s.geofence_min, s.geofence_max))
        reason = f"{worst:.2f} m outside the geofence in {axis} at {place_text(v.position)}"
        if worst > s.geofence_tolerance_m and v.state != State.LANDING:
            yield Action.LAND, reason
        if worst > max(s.geofence_tolerance_m, s.geofence_hard_m):
            yield Action.STOP, reason

    def _battery(self, now: float, v: WatchedVehicle) -> Demands:
        for level, limit in (("warning", v.battery_warning), ("critical", v.battery_critical)):
            key, warns = (v.name, level), level == "warning"
            if not self.settings.battery or v.state in OFF or v.battery >= limit:
                self._low_since.pop(key, None)
                continue
            low_s = now - self._low_since.setdefault(key, now)
            if low_s >= self.settings.battery_s and (warns or v.state == State.FLYING):
                reason = f"battery {v.battery:.2f} V, {level} limit {limit:.2f} V"
                yield Action.WARN if warns else Action.LAND, reason

    def _link(self, v: WatchedVehicle) -> Demands:
        limit = self.settings.link_age_s
        if limit and v.state not in OFF and v.log_age > limit:
            yield Action.LOST, f"no log packet for {v.log_age:.2f} s (limit {limit:.2f} s)"

    def _too_close(self, vehicles: Sequence[WatchedVehicle]) -> Iterator[tuple[str, str]]:
        limit = self.settings.min_distance_m
        flying = [(v, v.position) for v in vehicles if v.state in IN_AIR and v.position is not None]
        for (a, here), (b, there) in combinations(flying if limit else (), 2):
            if (distance := math.dist(here, there)) < limit:
                for one, other in ((a, b), (b, a)):
                    if one.state == State.FLYING:
                        yield one.name, f"{distance:.2f} m from {other.name} (limit {limit:.2f} m)"


def _estimate(v: WatchedVehicle) -> Demands:
    if v.wrong and v.state in IN_AIR:
        if v.state != State.LANDING:
            yield Action.HOLD, v.wrong
        if v.state == State.LANDING or v.wrong_s > ESTIMATE_HOLD_S:
            yield Action.LAND, v.wrong


def _waits(v: WatchedVehicle, age: float | None, hold_s: float, land_s: float, what: str) -> Demands:
    """One that flies waits for something, since `age` (s; None: never): hold it (0 s: never), then land it."""
    if hold_s and age is not None and v.state == State.FLYING and age > hold_s:
        yield Action.HOLD, f"{what} for {age:.2f} s"
        if age > land_s:
            yield Action.LAND, f"{what} for {age:.2f} s"


@dataclass(slots=True)
class EstimateWatch:
    """Notices in flight when an estimate jumps, stands still, or is not where motion capture sees the vehicle.

    What was wrong once stays wrong until the vehicle stands.
    """

    settings: SafetySettings
    wrong: str = ""  # what is wrong; empty: nothing
    since: float = 0.0  # s, monotonic, from when on
    _last: tuple[VehicleState, float] | None = None
    _moved: float = 0.0  # s, monotonic, when it changed last
    _unmoved_m: float = 0.0  # m, way by its velocity since the place changed last
    _agreed: float = 0.0  # s, monotonic, when estimate and motion capture agreed last

    def update(self, state: VehicleState, now: float, seen: Vector | None, *, flying: bool) -> bool:
        """Take in a log packet; True when something is wrong that was not before.

        :param seen: m, world: where motion capture sees it now; None: not at all.
        """
        last, self._last = self._last, (state, now)
        if not flying or last is None:
            self.wrong, self._unmoved_m = "", 0.0
            self._moved = self._agreed = now
            return False
        before, dt = last[0], now - last[1]
        if state.position != before.position or state.position[2] < STANDING_M:
            self._moved, self._unmoved_m = now, 0.0
        else:
            self._unmoved_m += math.hypot(*state.velocity) * dt
            if state.velocity != before.velocity or state.orientation != before.orientation:
                self._moved = now  # the place alone may stay the same, to the millimetre, unless its velocity is large
        if seen is None or math.dist(seen, state.position) <= self.settings.estimate_error_m:
            self._agreed = now
        if self.wrong:
            return False
        self.wrong, self.since = self._what_is_wrong(state, before, dt, now, seen), now
        return bool(self.wrong)

    def _what_is_wrong(
        self, state: VehicleState, before: VehicleState, dt: float, now: float, seen: Vector | None
    ) -> str:
        limits = self.settings
        jump = math.dist(state.position, [p + v * dt for p, v in zip(before.position, before.velocity, strict=True)])
        if limits.estimate_jump_m and jump > limits.estimate_jump_m + ACCELERATION * dt:
            return f"the estimate jumps by {jump:.2f} m within {dt:.2f} s"
        if limits.estimate_freeze_s and now - self._moved > limits.estimate_freeze_s:
            return f"the estimate has not changed for {now - self._moved:.2f} s"
        if limits.estimate_freeze_s and self._unmoved_m > STUCK_M:
            return f"the estimated place has not changed, though it moved by {self._unmoved_m:.2f} m by its velocity"
        if limits.estimate_error_m and seen is not None and now - self._agreed > APART_S:
            away = math.dist(seen, state.position)
            return f"the estimate is {away:.2f} m from where motion capture sees it"
        return ""
