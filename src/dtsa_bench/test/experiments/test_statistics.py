"""Intervals: against published values, and by whether they hold the truth as often as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dtsa_bench.experiments import statistics
from dtsa_bench.experiments.statistics import bootstrap_mean, wilson


@pytest.mark.parametrize(
    ("count", "total", "low", "high"),
    # Newcombe (1998), table I, method 3.
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_as_published(count: int, total: int, low: float, high: float) -> None:
    share = wilson(count, total)
    assert (share.low, share.high) == (pytest.approx(low, abs=6e-5), pytest.approx(high, abs=6e-5))
    assert str(share) == f"{count}/{total}"


@given(st.integers(1, 500), st.data())
def test_wilson_holds_the_share_and_is_symmetric(total: int, data: st.DataObject) -> None:
    count = data.draw(st.integers(0, total))
    share, other = wilson(count, total), wilson(total - count, total)
    assert 0.0 <= share.low <= share.value <= share.high <= 1.0
    assert (share.low, share.high) == (pytest.approx(1 - other.high), pytest.approx(1 - other.low))
    assert wilson(count, total, 0.5).high <= share.high


def test_no_runs_say_nothing_and_what_is_no_number_is_left_out() -> None:
    assert (wilson(0, 0).low, wilson(0, 0).high) == (0.0, 1.0)
    assert math.isnan(wilson(0, 0).value)
    for count, total, level in ((-1, 3, 0.95), (4, 3, 0.95), (1, 3, 1.0)):
        with pytest.raises(ValueError, match="allowed"):
            wilson(count, total, level)
    values = [1.0, 2.0, math.nan, 4.0, math.inf]
    first, second = bootstrap_mean(values), bootstrap_mean([1.0, 2.0, 4.0])
    assert first == second
    assert first.count == 3
    assert first.value == pytest.approx(7 / 3)
    assert first.low < first.value < first.high
    assert bootstrap_mean([]).count == 0
    assert math.isnan(bootstrap_mean([]).value)
    assert bootstrap_mean([3.0]).value == 3.0
    assert math.isnan(bootstrap_mean([3.0]).low)  # one value says nothing of how far off it is
    assert bootstrap_mean([0.0, 0.0, 9.0]).low == 0.0


def test_many_seeds_take_no_more_memory_and_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(2).normal(5.0, 1.0, 31)
    whole = bootstrap_mean(values)
    monkeypatch.setattr(statistics, "_AT_ONCE", 100)
    assert bootstrap_mean(values) == whole


@pytest.mark.parametrize(("draw", "count"), [("exponential", 30), ("normal", 30), ("normal", 5), ("normal", 3)])
def test_the_bootstrap_holds_the_true_mean_about_as_often_as_it_says(draw: str, count: int) -> None:
    random = np.random.default_rng(1)
    hits = 0
    for _ in range(300):
        values = random.exponential(2.0, count) if draw == "exponential" else random.normal(2.0, 1.0, count)
        mean = bootstrap_mean(values, resamples=500)
        hits += mean.low <= 2.0 <= mean.high
    assert 0.9 <= hits / 300 <= 0.99
