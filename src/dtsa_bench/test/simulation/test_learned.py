"""Integration: the example of a learned policy, its training and its flights."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import dtsa
from dtsa_agent.core import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.simulation.simulate import simulate

EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "dtsa_learned"
TINY = {"agents": 6, "moving": 3, "loss": 0.2}


@pytest.fixture(scope="module")
def train() -> Iterator[ModuleType]:
    """The script, with its package."""
    sys.path.insert(0, str(EXAMPLE))
    import dtsa_learned
    import train

    POLICIES.register("learned", dtsa_learned.Learned)
    yield train
    sys.path.remove(str(EXAMPLE))
    POLICIES.registered.discard("learned")
    for name in ("train", "dtsa_learned", "dtsa_learned.rules", "dtsa_learned.turns"):
        sys.modules.pop(name, None)


def test_the_same_seed_gives_the_same_weights(train: ModuleType, tmp_path: Path) -> None:
    budget = {"population": 4, "flights": 1, "kinds": [TINY]}
    first, second = (train.train(3, 2, **budget, every=1, out=tmp_path / "weights.json") for _ in range(2))
    assert first == second
    assert (tmp_path / "weights.json").read_text(encoding="utf-8") == train.json.dumps(first, indent=1) + "\n"


@pytest.mark.parametrize(
    "settings", [TINY, {"agents": 9, "scenario": "waypoints", "loss": 0.1}], ids=["few move", "all move"]
)
def test_what_was_trained_is_what_flies(train: ModuleType, settings: dict[str, object]) -> None:
    from dtsa_learned.rules import learned_rules

    swarm, record = train.Swarm(settings, 1), []
    agents = int(str(settings["agents"]))
    swarm.fly([learned_rules(agents)], [7], record)
    run = dtsa.run_config(policy="learned", seed=7, **{**train.COMMON, **settings})
    trace = simulate(run, trace=True).trace
    assert trace is not None
    senders = [tuple(int(k) + 1 for k in np.flatnonzero(sends[0])) for sends in record]
    count = min(len(senders), len(trace.senders))
    assert count > 100
    assert senders[:count] == list(trace.senders[:count])


def test_tables_stay_alike_where_frames_are_lost(train: ModuleType) -> None:
    settings = {**train.COMMON, "agents": 12, "moving": 4, "loss": 0.2, "seed": 5}
    flown = {name: dtsa.simulate(policy=name, **settings).summary for name in ("learned", "tdma")}
    slots = flown["learned"]["slots"]
    assert slots["collision"] < 0.05 * slots["total"]
    assert flown["learned"]["waking_age_mean_slots"] < 0.5 * flown["tdma"]["waking_age_mean_slots"]


def test_rules_are_the_same_whole_numbers_on_every_machine(train: ModuleType) -> None:
    from dtsa_learned import rules

    content = train.json.loads((EXAMPLE / "dtsa_learned" / "weights.json").read_text(encoding="utf-8"))
    for agents, digest in content["rules"].items():
        learned = rules.learned_rules(int(agents))
        assert learned.rates.dtype == np.int64
        assert learned.rates.min() >= 1
        assert rules.digest_of(learned) == digest


def test_an_agent_that_comes_late_keeps_to_turns_of_owners(train: ModuleType) -> None:
    from dtsa_learned.rules import learned_rules
    from dtsa_learned.turns import Turns

    rules = learned_rules(4)
    turns = Turns([rules], 4, [2], quiet_until=1000)
    never, unknown = np.full((1, 1, 4), -1), np.zeros((1, 1, 4), dtype=np.bool_)
    sends = [slot for slot in range(500, 1000) if turns(slot, never, unknown)[0, 0]]
    assert sends
    assert all((slot + 1) % rules.every == 0 and slot // rules.every % 4 == 1 for slot in sends)


def test_it_refuses_frames_without_gossip(train: ModuleType) -> None:
    with pytest.raises(ConfigError, match="frame: got 'paper'; allowed: extended, with policy learned"):
        dtsa.simulate(policy="learned", agents=4, frame="paper")
