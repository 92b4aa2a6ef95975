"""Whole flights on the compiled core and on the specification: equal in every frame, decision, digest and position."""

from __future__ import annotations

import dataclasses

import pytest

from dtsa_agent.core.reference.lease import issue, memory
from dtsa_bench.oracle import Differs, fly_both, random_setting

SAMPLE = 12


@pytest.mark.parametrize("seed", range(1, SAMPLE + 1))
def test_flights_are_equal(seed: int) -> None:
    setting = random_setting(seed)
    assert fly_both(setting)["slots"] == setting.slots


def test_a_rule_that_differs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The oracle itself: one rule of the specification changed by a hair."""
    setting = dataclasses.replace(random_setting(2, policy="lease"), faults=())
    fly_both(setting)
    monkeypatch.setattr(issue, "RELAY_IDS", 7)
    monkeypatch.setattr(memory, "MISSED", 3)
    with pytest.raises(Differs, match="slot"):
        fly_both(setting)
