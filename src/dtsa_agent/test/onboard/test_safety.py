"""Integration: the rules by which an agent on board may steer, in C, against whatever there is to see."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest
from cffi import FFI
from hypothesis import given, settings
from hypothesis import strategies as st

import dtsa_agent

ONBOARD = Path(dtsa_agent.__file__).parent / "onboard"
RULES = FFI()
RULES.cdef("\n".join(line for line in (ONBOARD / "safety.h").read_text().splitlines() if not line.startswith("#")))
OFF, FLY, HOVER, LAND = range(4)
WELL, DISABLED, GROUND, CANNOT_FLY, ORDERED, BATTERY, OUTSIDE, UNHEARD, OLD_NEWS, NEWCOMER = range(10)
STEP_S = 0.01
LIMITS = {"news_s": 1.0, "rests_s": 3.0, "unheard_s": 0.5, "land_s": 2.0, "well_s": 0.2, "battery_v": 3.2, "sag_s": 0.3}


GOOD: dict[str, Any] = {
    "enabled": 1, "ordered": 0, "ground": 0, "can_fly": 1, "in_air": 1, "newcomer": 0, "battery_v": 3.8,
    "position": (0.0, 0.0, 1.0), "oldest_s": 0.1, "rests_s": 2.0, "unheard_s": 0.01,
}  # fmt: skip


class Guard:
    def __init__(self, library: Any) -> None:
        self._library, self.state = library, RULES.new("safety *")
        box = {"low": (-2.0, -2.0, 0.2), "high": (2.0, 2.0, 2.0)}
        self._settings = RULES.new("safety_settings *", LIMITS | box)

    def step(self, seconds: float = STEP_S, **changed: Any) -> int:
        view = RULES.new("safety_view *", GOOD | changed)
        for _ in range(round(seconds / STEP_S)):
            self._library.safety_step(self.state, self._settings, view, STEP_S)
        return int(self.state.mode)


@pytest.fixture(scope="module", name="library")
def _library(tmp_path_factory: pytest.TempPathFactory) -> Any:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    out = tmp_path_factory.mktemp("safety") / "safety.so"
    words = [compiler, "-std=gnu11", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-O2", "-shared", "-fPIC"]
    subprocess.run([*words, "-o", out, ONBOARD / "safety.c"], check=True, timeout=60)
    return RULES.dlopen(str(out))


def test_it_flies_when_all_has_been_well_for_a_while(library: Any) -> None:
    guard = Guard(library)
    assert guard.step(0.1) == OFF
    assert guard.step(0.2) == FLY


@pytest.mark.parametrize(("seen", "mode", "reason"), [
    ({"oldest_s": 1.1}, HOVER, OLD_NEWS), ({"oldest_s": -1.0}, HOVER, OLD_NEWS),
    ({"oldest_s": float("nan")}, HOVER, OLD_NEWS), ({"rests_s": 3.1}, HOVER, OLD_NEWS),
    ({"rests_s": float("nan")}, HOVER, OLD_NEWS), ({"unheard_s": 0.6}, HOVER, UNHEARD),
    ({"unheard_s": -1.0}, HOVER, UNHEARD), ({"newcomer": 1}, HOVER, NEWCOMER), ({"ordered": 1}, LAND, ORDERED),
    ({"battery_v": 3.0}, LAND, BATTERY), ({"battery_v": float("nan")}, LAND, BATTERY),
    ({"position": (0.0, 2.1, 1.0)}, LAND, OUTSIDE), ({"position": (0.0, float("nan"), 1.0)}, LAND, OUTSIDE),
    ({"enabled": 0}, OFF, DISABLED), ({"ground": 1}, OFF, GROUND), ({"can_fly": 0}, OFF, CANNOT_FLY),
    ({"in_air": 0}, OFF, CANNOT_FLY),
])  # fmt: skip
def test_each_trouble_has_its_reaction(library: Any, seen: dict[str, Any], mode: int, reason: int) -> None:
    guard = Guard(library)
    assert guard.step(0.5) == FLY
    guard.step(**seen)
    before = guard.state.reason
    assert guard.step(0.5, **seen) == mode
    assert before in (reason, WELL)  # at once, or after the time in which it may be an error
    assert guard.state.reason == reason


def test_a_voltage_that_sags_for_a_moment_lands_nobody(library: Any) -> None:
    guard = Guard(library)
    guard.step(0.5)
    for _ in range(5):
        assert guard.step(0.25, battery_v=3.0) == FLY
        assert guard.step(0.05) == FLY


def test_a_hover_ends_in_flight_or_on_the_ground(library: Any) -> None:
    guard = Guard(library)
    guard.step(0.5)
    assert guard.step(1.5, unheard_s=1.0) == HOVER
    assert guard.step(0.1) == HOVER
    assert guard.step(0.2) == FLY
    assert guard.step(2.2, unheard_s=1.0) == LAND
    assert guard.step(5.0) == LAND  # whatever is heard now
    assert guard.step(in_air=0) == OFF
    assert guard.step(5.0) == OFF  # until the ground has disabled it
    guard.step(enabled=0)
    assert guard.step(0.5) == FLY


def test_the_ground_wins_until_it_enables_anew(library: Any) -> None:
    guard = Guard(library)
    guard.step(0.5)
    assert guard.step(ground=1) == OFF
    assert guard.step(5.0) == OFF
    guard.step(enabled=0)
    assert guard.step(0.5) == FLY


_ANY = st.floats(allow_nan=True, width=32)
_SEEN = st.fixed_dictionaries({}, optional={
    **{name: st.integers(0, 1) for name in ("enabled", "ordered", "ground", "can_fly", "in_air", "newcomer")},
    "battery_v": st.floats(2.5, 4.25, width=32) | _ANY, "oldest_s": st.floats(-1.0, 3.0, width=32) | _ANY,
    "unheard_s": st.floats(-1.0, 3.0, width=32) | _ANY,
    "position": st.tuples(_ANY, _ANY, _ANY) | st.just((0.0, 0.0, 1.0)),
})  # fmt: skip


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(_SEEN, st.sampled_from((0.01, 0.3, 2.5))), max_size=30))
def test_it_steers_only_where_it_may(library: Any, flight: list[tuple[dict[str, Any], float]]) -> None:
    guard = Guard(library)
    for changed, seconds in flight:
        before = guard.state.mode
        mode, seen = guard.step(seconds, **changed), GOOD | changed
        allowed = seen["enabled"] and seen["can_fly"] and seen["in_air"] and not seen["ground"]
        assert allowed or mode == OFF
        if mode == FLY:
            assert not seen["ordered"]
            assert not seen["newcomer"]
            assert 0.0 <= seen["oldest_s"] <= 1.0
            assert 0.0 <= seen["unheard_s"] <= 0.5
        if before == LAND:
            assert mode in (LAND, OFF)
        if mode == HOVER:
            assert guard.state.since_s <= LIMITS["land_s"] + 2 * STEP_S
