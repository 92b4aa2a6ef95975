"""Random misfortune: loss, bursts, jams, partitions, short ranges, and agents that come, go, die, restart and wake."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_channel_sim import ChannelConfig

from .experiment import Event, Experiment

NEVER = 2**62  # slot
KINDS = ("go", "stop", "go", "stop", "die", "join", "join", "restart", "leave")


@dataclass(frozen=True, slots=True)
class Misfortune:
    """What befalls one swarm."""

    config: SwarmConfig
    channel: ChannelConfig
    movers: tuple[int, ...]
    events: tuple[Event, ...]
    final: bool

    def experiment(self) -> Experiment:
        """The run to make with it; ages are not measured."""
        return Experiment(
            self.config,
            self.channel,
            movers=self.movers,
            events=self.events,
            final=self.final,
            warmup=NEVER,
        )


def format_groups(groups: list[list[int]]) -> str:
    """A partition as the channel's settings have it.

    :param groups: ids of each group.
    """
    return " | ".join(",".join(map(str, sorted(group))) for group in groups)


def random_schedule(random: np.random.Generator, agents: int, slots: int) -> list[dict[str, Any]]:
    """Jams and partitions, one after the other."""
    entries: list[dict[str, Any]] = []
    slot = 0
    while slot < slots:
        slot += int(random.integers(50, 800))
        length = int(random.integers(5, 600))
        kind = random.integers(0, 3)
        if kind == 0:
            entries.append({"slot": slot, "until": slot + length, "jam": True})
        elif kind == 1 and agents > 3:
            ids = [int(k) + 1 for k in random.permutation(agents)]
            cut = int(random.integers(1, agents))
            entries.append({"slot": slot, "until": slot + length, "partition": format_groups([ids[:cut], ids[cut:]])})
        slot += length
    return entries


def _events(random: np.random.Generator, agents: int, slots: int) -> list[Event]:
    events = []
    for agent in range(1, agents + 1):
        slot, pace = 0, (30, 200, 800, 2000)[random.integers(0, 4)]
        while slot < slots:
            slot += int(random.integers(1, pace))
            events.append(Event(slot, KINDS[random.integers(0, len(KINDS))], agent))
    return events


def random_misfortune(seed: int, slots: int, most_agents: int = 16, **settings: Any) -> Misfortune:
    """Everything that can go wrong, at random.

    :param seed: seed of all of it.
    :param slots: slots that the run lasts for which it is meant.
    :param most_agents: upper bound of the swarm's size.
    :param settings: of the swarm, on top of the random ones.
    """
    random = np.random.default_rng(seed)
    agents = int(random.integers(2, most_agents + 1))
    config = SwarmConfig(
        agents=agents, policy="lease", avoider="none", seed=seed, anchor_every=int(random.integers(1, 8)),
        depth_rate=float(random.choice([0.1, 1.0, 5.0])), lease_share=float(random.choice([0.75, 1.0])), **settings,
    )  # fmt: skip
    loss = float(random.choice([0.0, 0.05, 0.2, 0.5]))
    matrix: tuple[tuple[float, ...], ...] = ()
    if random.random() < 0.3:
        links = random.uniform(0.0, 0.6, (agents, agents))
        np.fill_diagonal(links, 0.0)
        matrix = tuple(tuple(float(x) for x in row) for row in links)
    channel = ChannelConfig(
        agents=agents, slot_ns=config.slot_ns, seed=seed, loss=loss, loss_matrix=matrix,
        burst_length=float(random.choice([0.0, 10.0, 20.0])) if loss else 0.0,
        range_m=float(random.choice([0.0, 0.0, 8.0])), schedule=tuple(random_schedule(random, agents, slots)),
    )  # fmt: skip
    movers = tuple(k for k in range(1, agents + 1) if random.random() < 0.5)
    return Misfortune(config, channel, movers, tuple(_events(random, agents, slots)), bool(random.random() < 0.5))
