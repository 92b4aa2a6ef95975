"""Integration: 20,000,000 agent-seconds of live agents on virtual time, under faults from seeds, violate nothing."""

from __future__ import annotations

from typing import Any

import pytest
from plain_stations import compare_statements

from dtsa_bench.simulation.live import bound_ns, draw_flight, fly, report_failure

pytestmark = [pytest.mark.soak, pytest.mark.timeout(900)]
SEEDS = 600  # of a share: about 100,000 agent-seconds, in about 10 s
SHARES = [pytest.param(share, marks=[pytest.mark.sample, pytest.mark.slow] * (share < 2)) for share in range(200)]


@pytest.mark.parametrize("share", SHARES)
def test_nothing_is_violated(share: int, record: list[dict[str, Any]]) -> None:
    agent_s, slowest = 0.0, 0.0
    for seed in range(share * SEEDS, (share + 1) * SEEDS):
        flight = draw_flight(seed)
        result = fly(flight)
        assert not result.violation, report_failure(seed)
        assert result.together_ns is not None
        agent_s += result.agent_s
        slowest = max(slowest, result.together_ns / bound_ns(flight))
    assert agent_s > 80_000
    record.append({"agent_s": agent_s, "slowest": slowest})


@pytest.mark.parametrize("seed", range(1, 101))
def test_both_statements_are_equal(seed: int, record: list[dict[str, Any]]) -> None:
    calls = compare_statements(draw_flight(seed))
    assert calls > 500
    record.append({"calls": calls})


def summarise(found: list[dict[str, Any]]) -> tuple[list[str], list[list[object]]]:
    shares, both = ([row for row in found if name in row] for name in ("agent_s", "calls"))
    agent_s, slowest = sum(row["agent_s"] for row in shares), max((row["slowest"] for row in shares), default=0.0)
    flown = [f"{len(shares) * SEEDS:,}", f"{agent_s:,.0f}", f"{slowest:.0%}"]
    rows: list[list[object]] = [
        ["in C", *flown, ""],
        ["in C and Python", len(both), "", "", sum(r["calls"] for r in both)],
    ]
    return ["stations", "flights", "agent-seconds", "together after, of the bound, at most", "equal calls"], rows
