"""Priority values and selection against golden values and their own symmetries; test_reference.py has the formula."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from kernel_parts import priority, select

from dtsa_agent.core import REASONS

CASES = json.loads((Path(__file__).parents[1] / "golden" / "priority.json").read_text())["cases"]


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"n{c['n']}")
def test_golden_values(case: dict) -> None:
    g = priority(case["position_m"], case["velocity_mps"], case["slot_s"])
    np.testing.assert_allclose(g, case["priority"], rtol=1e-12, atol=1e-12)
    index, candidates, reason = select(g, case["counter"], case["in_ap"], case["epsilon"])
    assert index == case["selected_index"]
    assert np.flatnonzero(candidates).tolist() == case["candidates"]
    assert REASONS[reason] == ("tie" if len(case["candidates"]) > 1 else "priority")


@pytest.mark.parametrize("angle", np.linspace(0, np.pi, 33))
def test_the_angle_counts_over_its_whole_range(angle: float) -> None:
    """Agent 1 at rest in the origin, agent 2 at 2 m flies at 1 m/s at an angle to the line of sight."""
    g = priority([[0, 0, 0], [2, 0, 0]], [[0, 0, 0], [-math.cos(angle), math.sin(angle), 0]], 0.1)
    assert g[0] == 0.0
    assert g[1] == pytest.approx(0.1 / 2 * (math.pi - angle) / math.pi, abs=1e-9)


def test_equal_velocities_and_equal_places_add_nothing() -> None:
    assert priority([[0, 0, 0], [1, 0, 0]], [[1, 2, 3], [1, 2, 3]], 0.01).tolist() == [0, 0]
    assert priority([[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [-1, 0, 0]], 0.01).tolist() == [0, 0]
    assert priority([[5, 5, 5]], [[1, 0, 0]], 0.01).tolist() == [0]


def test_order_of_ids_does_not_matter_to_the_default_reading() -> None:
    random = np.random.default_rng(3)
    for _ in range(200):
        g, h = random.random(9), random.permutation(9)
        order = random.permutation(9)
        a, _, _ = select(g, h, np.ones(9))
        b, _, _ = select(g[order], h[order], np.ones(9))
        assert order[b] == a


def test_the_literal_reading_depends_on_the_order_of_ids() -> None:
    """Why it is not the default: three values, each within epsilon of the next, are not transitive."""
    g, h = np.array([1.0, 0.6, 0.31]), np.array([0, 1, 2])
    winners = set()
    for order in ([0, 1, 2], [2, 1, 0]):
        index, _, _ = select(g[order], h[order], np.ones(3), 0.5, "pairwise")
        winners.add(order[index])
    assert len(winners) == 2


def test_special_cases_of_the_selection() -> None:
    everyone = np.ones(3)
    assert select([0, 0, 0], [1, 5, 5], everyone)[0::2] == (1, REASONS.index("oldest"))
    assert select([3, 2, 1], [0, 0, 0], np.zeros(3))[0::2] == (-1, REASONS.index("nobody"))
    assert select([9, 1, 1], [0, 9, 9], everyone)[0::2] == (0, REASONS.index("priority"))
    assert select([9, 8, 1], [0, 9, 9], everyone)[0::2] == (1, REASONS.index("tie"))
    assert select([9, 8, 1], [0, 9, 9], np.array([0, 0, 1]))[0] == 2
    assert select([9, 8, 1], [5, 5, 5], everyone)[0] == 0
