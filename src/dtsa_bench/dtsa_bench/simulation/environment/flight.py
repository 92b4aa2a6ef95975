"""One flight, slot by slot, whose senders are told from outside; its arrays lie in those of a batch."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AbstractSwarm, ConfigError, SwarmConfig, make_scenario
from dtsa_agent.core.plugins.entry_points import PluginSwarm
from dtsa_agent.core.plugins.table import Table
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, REASONS
from dtsa_agent.core.settings.flight_models import AVOIDERS
from dtsa_agent.core.settings.scenario import Scenario
from dtsa_agent.core.swarms.swarm import Swarm
from dtsa_agent.keys import with_key
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_channel_sim import Channel

from ..slotted import SlottedTraffic

POLICY = "actions"  # what the setting `policy` says in an environment
_REASON = REASONS.index("plugin")


class Actions:
    """The policy of agents in an environment: the kernel counts for them what it counts for a plug-in.

    :param config: the swarm's settings.
    :param agent: id.
    """

    may_join = True

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        del config, agent

    def choose(self, table: Table, slot: int) -> int:
        """Nobody asks: the environment says who sends.

        :raises ConfigError: outside of one.
        """
        del table, slot
        raise ConfigError("policy", POLICY, "another one: this one flies in dtsa.env only")


def acted(run: RunConfig) -> RunConfig:
    """The same run with senders told from outside.

    :param run: the run; its policy does not count.
    :raises ConfigError: if its agents are not bound to slots.
    """
    if POLICY not in POLICIES.registered:
        POLICIES.register(POLICY, Actions)
    return replace(run, swarm=replace(run.swarm, policy=POLICY))


def seeded(run: RunConfig, seed: int) -> RunConfig:
    """The same run with another seed of swarm and channel.

    :param run: the run.
    :param seed: the seed, which has been checked: to check all settings again takes as long as a hundred slots.
    """
    swarm, channel, other = copy(run.swarm), copy(run.air), copy(run)
    for settings, name, value in (
        (swarm, "seed", seed), (channel, "seed", seed), (other, "swarm", swarm), (other, "channel", channel),
    ):  # fmt: skip
        object.__setattr__(settings, name, value)
    return other


class Memory:
    """Arrays of all flights of a batch: each flight's swarm has its row of them.

    :param flights: number of flights B.
    """

    NAMES = (
        "sent_position", "sent_velocity", "sent_slot", "last_turn", "in_ap", "table_hash",
        "position", "velocity", "goal", "present", "chosen", "sends",
    )  # fmt: skip
    sent_position: NDArray[np.float64]
    sent_velocity: NDArray[np.float64]
    sent_slot: NDArray[np.int64]
    last_turn: NDArray[np.int64]
    in_ap: NDArray[np.uint8]
    table_hash: NDArray[np.uint32]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    goal: NDArray[np.float64]
    present: NDArray[np.uint8]
    chosen: NDArray[np.uint16]
    sends: NDArray[np.uint8]

    def __init__(self, flights: int) -> None:
        self._flights = flights

    def place(self, swarm: Swarm, row: int) -> None:
        """Moves those arrays of a swarm that it has so far.

        :param swarm: a swarm that is being made.
        :param row: number of its flight.
        """
        for name in self.NAMES:
            own = getattr(swarm, name, None)
            if own is None:
                continue
            if not hasattr(self, name):
                setattr(self, name, np.zeros((self._flights, *own.shape), dtype=own.dtype))
            window = getattr(self, name)[row]
            window[...] = own
            setattr(swarm, name, window)


class PlacedSwarm(Swarm):
    """A swarm some of whose arrays are rows of larger ones.

    :param config: the settings.
    :param scenario: starts and goals.
    :param memory: the larger arrays.
    :param row: which row.
    """

    def __init__(self, config: SwarmConfig, scenario: Scenario, memory: Memory, row: int) -> None:
        self._place = memory, row
        super().__init__(config, scenario)

    def _make_agents(self, count: int, steps: int) -> None:
        super()._make_agents(count, steps)
        memory, row = self._place
        memory.place(self, row)

    def fly_again(self, config: SwarmConfig, scenario: Scenario) -> None:
        """Begins another flight, without the cost of a new swarm.

        :param config: the same settings with another seed.
        :param scenario: its starts and goals.
        """
        self.config, self.scenario = config, scenario
        self._start[...], self._target[...] = scenario.start, scenario.target
        self.course = scenario.course(self.local)
        self.reset()


class ActedFlight:
    """A flight in which each slot's senders are said from outside.

    :param run: the run, as :func:`acted` gives it.
    :param memory: arrays of the batch.
    :param row: which row is this flight's.
    :param last: the flight that was in this row, which is over; its swarm flies again where it can.
    """

    def __init__(self, run: RunConfig, memory: Memory, row: int, last: ActedFlight | None = None) -> None:
        self.run, self.scenario = run, make_scenario(run.swarm)
        if last is not None and isinstance(last.swarm, PlacedSwarm):
            self.swarm: AbstractSwarm = last.swarm
            last.swarm.fly_again(run.swarm, self.scenario)
        else:
            self.swarm = _new_swarm(run.swarm, self.scenario, memory, row)
        self.metrics = FlightMetrics(run, self.scenario)
        self.slot = 0  # the one that begins
        self.senders: tuple[int, ...] = ()  # ids, of the last slot
        self.outcome = 0  # of the last slot
        self._carry = SlottedTraffic(self.swarm, Channel(run.air)).slot
        self._advance = self.scenario.advance
        self._advance(0, self.swarm)

    def step(self, torn: bool, split: bool) -> str:
        """Flies a slot whose senders are those with ``sends`` set.

        :param torn: whether two agents take different ones for its sender.
        :param split: whether two of their tables differ.
        :returns: why the flight is over now, or "" if it goes on.
        """
        slot, swarm = self.slot, self.swarm
        senders = swarm.emit(slot)
        self.metrics.compared(slot, torn, split)
        verdict, lengths = self._carry(slot, senders)
        self.senders, self.outcome = verdict.senders, verdict.outcome
        over = self.metrics.update(slot, swarm.track, swarm, verdict.outcome, lengths)
        self.slot = slot + 1
        if not over:
            self._advance(slot + 1, swarm)
        return over

    def summary(self, wall_time_s: float | None = None) -> dict[str, Any]:
        """The results, with the keys of ``summary.json``.

        :param wall_time_s: s, what the flight took.
        """
        result = self.metrics.summary(wall_time_s)
        result["malformed"], result["foreign"] = self.swarm.malformed, self.swarm.foreign
        return result


def _new_swarm(config: SwarmConfig, scenario: Scenario, memory: Memory, row: int) -> AbstractSwarm:
    swarm: AbstractSwarm = PlacedSwarm(config, scenario, memory, row)
    if config.estimator not in ESTIMATORS.rows or config.avoider not in AVOIDERS.rows:
        swarm = PluginSwarm(swarm)
    swarm.reason[:] = _REASON
    return with_key(swarm)
