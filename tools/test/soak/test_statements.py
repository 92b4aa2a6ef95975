"""Integration: random flights are equal on the compiled core and on the specification, in every frame and decision."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import pytest
from dtsa_dev.proofs.both_statements import fly_both, random_setting

pytestmark = [pytest.mark.soak, pytest.mark.timeout(900)]


@pytest.mark.parametrize("seed", range(1, 201))
def test_flight_is_equal(seed: int, record: list[dict[str, Any]]) -> None:
    setting = random_setting(seed)
    figures: Mapping[str, Any] = fly_both(setting)
    decisions = setting.slots * setting.swarm.agents
    record.append({**figures, "policy": setting.swarm.policy, "decisions": decisions, "faults": len(setting.faults)})


def summarise(found: list[dict[str, Any]]) -> tuple[list[str], list[list[object]]]:
    heads = ("slots", "decisions", "frames", "heard", "collisions", "faults")
    flights = Counter(row["policy"] for row in found)
    rows: list[list[object]] = [
        [policy, count, *(f"{sum(row[head] for row in found if row['policy'] == policy):,}" for head in heads)]
        for policy, count in sorted(flights.items())
    ]
    return ["policy", "flights", *heads], rows
