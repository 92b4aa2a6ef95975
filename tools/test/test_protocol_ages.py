"""Integration: ages of slot protocols without flight: `lease` beside TDMA and DTSA (docs/evidence/robustness.md)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from dtsa_dev.protocol.experiment import Experiment, FlightEvent, Outcome

from dtsa_agent.core import SwarmConfig
from dtsa_channel_sim import ChannelConfig

# Columns: settings of the swarm by name.
PROTOCOLS: dict[str, dict[str, Any]] = {
    "tdma": {"policy": "tdma"}, "tdma+gossip": {"policy": "tdma", "frame": "extended"}, "dtsa": {"policy": "dtsa"},
    "genie (age)": {"policy": "genie-age", "frame": "extended"},
    "genie (error)": {"policy": "genie-error", "frame": "extended"},
    "lease S=0": {"policy": "lease", "open_every": 0, "adoption": False}, "lease": {"policy": "lease"},
}  # fmt: skip
FLYING = 1000  # slots, mean time of flight between two pauses


def run(protocol: str, agents: int, movers: int, seed: int, slots: int, warmup: int, **more: Any) -> Outcome:
    """A run in which some agents move all the time, or, with ``pause``, all fly and rest for so many slots in turn."""
    pick = np.random.default_rng([seed, 4])
    ids = [int(k) + 1 for k in pick.permutation(agents)]
    pause = more.pop("pause", 0)
    moving, events = _stop_and_go(ids, pause, slots, pick) if pause else (ids[:movers], [])
    config = SwarmConfig(agents=agents, moving=0, avoider="none", seed=seed, **PROTOCOLS[protocol])
    channel = ChannelConfig(agents=agents, slot_ns=config.slot_ns, seed=seed, **more)
    # With plain DTSA all compute the same from one table where nothing is lost.
    shared = protocol == "dtsa" and not more.get("loss")
    experiment = Experiment(
        config, channel, movers=moving, events=events, final=not pause, warmup=warmup, shared=shared
    )  # fmt: skip
    return experiment.run(slots)


def _stop_and_go(
    ids: list[int], pause: int, slots: int, pick: np.random.Generator
) -> tuple[list[int], list[FlightEvent]]:
    movers: list[int] = []
    events: list[FlightEvent] = []
    for agent in ids:
        slot, flies = -int(pick.integers(0, FLYING + pause)), True
        while slot < slots:
            length = int(pick.uniform(0.6, 1.4) * (FLYING if flies else pause))
            if slot > 0:
                events.append(FlightEvent(slot, "go" if flies else "stop", agent))
            elif flies and slot + length > 0:
                movers.append(agent)
            slot, flies = slot + length, not flies
    return movers, events


def test_all_moving_without_loss_is_exactly_tdma() -> None:
    ages = {name: run(name, 12, 12, 1, 2000, 600).age for name in PROTOCOLS}
    by_content = {name: ages.pop(name) for name in ("dtsa", "genie (error)")}
    assert ages == dict.fromkeys(ages, 5.5)
    assert all(age > 5.5 for age in by_content.values())


@pytest.mark.parametrize(("agents", "movers", "warmup", "more", "ceiling"), [
    (12, 6, 600, {}, 0.56), (12, 6, 600, {"loss": 0.3}, 0.4), (12, 2, 600, {}, 0.15), (12, 2, 600, {"loss": 0.1}, 0.2),
    (12, 12, 600, {"loss": 0.1}, 0.9), (70, 35, 700, {"loss": 0.1}, 0.64), (70, 0, 2000, {"pause": 3000}, 0.8),
    (70, 0, 2000, {"pause": 1000}, 1.02), (70, 0, 2000, {"pause": 300, "loss": 0.1}, 1.02),
])  # fmt: skip
def test_lease_is_younger_than_tdma(agents, movers, warmup, more, ceiling):
    slots = 8000 if "pause" in more else 4000
    lease, tdma = (run(name, agents, movers, 7, slots, warmup, **more) for name in ("lease", "tdma"))
    assert lease.age < ceiling * tdma.age
    flown = [lease]
    if "pause" in more:  # a handful in a flight: their share takes several
        flown += [run("lease", agents, movers, seed, slots, warmup, **more) for seed in (8, 9)]
    for out in flown:
        assert out.ledger is not None
        assert out.ledger.broken == []
        assert out.collisions == out.ledger.collisions["open"] + out.ledger.collisions["adopted"]
    assert sum(out.collisions for out in flown) <= 0.002 * sum(out.slots for out in flown)


def test_plain_dtsa_falls_apart_with_the_first_losses() -> None:
    dtsa, tdma, lease = (run(name, 12, 6, 3, 4000, 600, loss=0.1) for name in ("dtsa", "tdma", "lease"))
    assert dtsa.collisions > 100
    assert dtsa.age > tdma.age > lease.age
