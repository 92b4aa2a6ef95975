"""Recorded odometry beside the motion that agents reported."""

from __future__ import annotations

import numpy as np
import pytest

from dtsa_agent.ros.common.graph import names
from dtsa_bench.recordings.verify.odometry import odometry_fault

SLOT_NS = 20_000_000
SLOTS = 10
FIRST = 6  # slot of the first report
SPEED = 1.0  # m/s


def rows() -> tuple[np.ndarray, np.ndarray, list]:
    """Ten slots of an agent that flies along x, whose first reports have missed their slots' accounts."""
    times = names.TIME_ZERO_NS + np.arange(SLOTS) * SLOT_NS
    found = np.zeros((SLOTS, 3))
    found[FIRST:, 0] = 0.9 + np.arange(SLOTS - FIRST) * SPEED * SLOT_NS / 1e9
    reports = [(slot, found[slot].copy(), SPEED) for slot in range(FIRST, SLOTS)]
    return times, found, reports


def fault(found: np.ndarray, carried: np.ndarray | None = None) -> tuple[int, float, float] | None:
    times, _, reports = rows()
    return odometry_fault(times, found, np.zeros(SLOTS, bool) if carried is None else carried, reports, SLOT_NS)


def test_an_agent_stays_where_it_was_called_until_its_first_report() -> None:
    _, found, _ = rows()
    assert fault(found) is None


@pytest.mark.parametrize("slot", [2, FIRST - 1, FIRST, FIRST + 2])
def test_a_place_that_was_not_reported_is_found(slot: int) -> None:
    _, found, _ = rows()
    found[slot, 1] += 0.01
    assert fault(found) == (slot, pytest.approx(0.01, abs=0.02), pytest.approx(1e-6, abs=1e-9))


def test_a_slot_whose_report_came_too_late_keeps_the_place_before() -> None:
    _, found, _ = rows()
    late = np.arange(SLOTS) == FIRST + 1
    found[late] = found[FIRST]
    assert fault(found) is not None
    assert fault(found, late) is None
