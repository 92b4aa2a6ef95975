"""Integration: whole flights on both statements: equal in every frame, decision, digest and position."""

from __future__ import annotations

import pytest
from dtsa_dev.proofs.both_statements import CheckedFlight, Differs, fly_both, random_setting

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.reference import lease, lease_issue
from dtsa_channel_sim import ChannelConfig

SAMPLE = 10  # settings; `dtsa soak statements` has 200


@pytest.mark.parametrize("seed", range(1, SAMPLE + 1))
def test_flights_are_equal(seed: int) -> None:
    setting = random_setting(seed, lasts=False)
    assert fly_both(setting)["slots"] == setting.slots


@pytest.mark.parametrize("seed", [11, 36])
def test_flights_are_equal_in_which_the_dead_are_adopted_and_some_come_back(seed: int) -> None:
    figures = fly_both(random_setting(seed, "lease", lasts=True))
    assert figures["reasons"]["adopted"] > 100
    assert {"own", "anchor", "leased", "absent", "open"} <= set(figures["reasons"])


@pytest.mark.parametrize("moving", [2, 3])
def test_flights_are_equal_in_which_few_of_many_move(moving: int) -> None:
    swarm = SwarmConfig(agents=12, moving=moving, policy="lease", avoider="none", axis_x_m=20.0, seed=3)
    figures = fly_both(CheckedFlight(swarm, ChannelConfig(agents=12, seed=3), 300))
    assert {"own", "anchor", "leased", "open"} <= set(figures["reasons"])


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [(lease_issue, "MISSED", 1), (lease_issue, "RELAY_IDS", 1), (lease, "DEAF", 0), (lease_issue, "NEED", 1.0)],
)
def test_a_rule_that_differs_is_found(monkeypatch: pytest.MonkeyPatch, module: object, name: str, value: float) -> None:
    """The oracle itself: one constant of the specification changed."""
    monkeypatch.setattr(module, name, value)
    with pytest.raises(Differs, match="slot"):
        fly_both(random_setting(36, "lease", lasts=True))
