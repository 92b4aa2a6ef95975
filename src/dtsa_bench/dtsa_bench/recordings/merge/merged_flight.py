"""A flight of several agents' bags, slot by slot: all fly again, and the results are those of any other flight."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.record import SlotRecord
from dtsa_agent.core import Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_bench.runs.config import REALTIME, RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .agent_bag import AgentBag
from .known_pairs import KnownPairs, all_known_after
from .replay import Replay
from .timeline import Life

_FOREVER_S = 86_400.0
_GAP_SLOTS = 50  # an agent that says nothing for longer has fallen out
# Of the results of other flights; the bags do not say how long frames of that port are on the air.
_NOT_MEANT = ("end", "timed_out", "loss", "channel_load", "wall_time_s", "realtime_factor")

Records = Mapping[int, Mapping[int, SlotRecord]]  # by agent and slot


@dataclass(frozen=True, slots=True)
class Moment:
    """The end of a slot."""

    slot: int
    tables: Swarm  # what the agents know, a row for each that has a bag
    position: NDArray[np.float64]  # m, (3, N), frame map, true; NaN where it is not known
    counted: NDArray[np.bool_]  # (N,) agents whose ages and errors the results take
    results: bool  # whether the results count the slot


def run_of(config: SwarmConfig) -> RunConfig:
    """A merged flight's configuration; its channel stands for a network of which nothing is known."""
    limits = RunLimits(timeout_s=_FOREVER_S, stop_on_crash=False)
    return RunConfig(config, ChannelConfig(**from_swarm(config)), limits, REALTIME)


def fly(
    lives: Mapping[Life, AgentBag],
    replays: Mapping[Life, Replay],
    senders: Mapping[int, int],
    common_slot: int | None,
) -> Generator[Moment, None, dict[str, Any] | None]:
    """Replays all agents slot by slot; gives the slots from the common one on.

    :param common_slot: from which all counted alike; None: never.
    :returns: the results of the flight from when all can have become known, (M + 2) N slots after that,
        and from when nobody is new any more (until then they hover), until the first of them ends in order; None:
        there are none.
    """
    if not lives:
        return None
    config = next(iter(lives.values())).swarm
    begins = None if common_slot is None else common_slot + all_known_after(config)
    by_slot: dict[int, dict[Life, SlotRecord]] = {}
    records: dict[int, dict[int, SlotRecord]] = {agent: {} for agent, _ in lives}
    for life, bag in lives.items():
        for record in bag.slots:
            by_slot.setdefault(record.slot, {})[life] = record
            records[life[0]][record.slot] = record
    scenario = make_scenario(config)
    metrics, observers = FlightMetrics(run_of(config), scenario), list(records)
    tables = make_swarm(config, scenario, local=[], observers=observers)
    track = np.repeat(scenario.start[None], config.steps, axis=0)
    last = min((bag.slots[-1].slot for bag in lives.values() if bag.summary and bag.slots), default=max(by_slot))
    for agent in range(1, config.agents + 1):
        if agent not in records:
            metrics.lose(agent, hovers=False)
    first, known = None, KnownPairs(config, observers)
    for slot in sorted(by_slot):
        for life, record in by_slot[slot].items():
            replays[life].fly(record)
            replays[life].lay(tables, observers.index(life[0]))
            known.hear(life[0], record)
        counts = begins is not None and begins <= slot < last
        if counts and first is None:
            counts = not any(_new(replays[life]) for life in by_slot[slot])
        if counts:
            if first is None:
                first = slot
                known.begin(slot)
            here = _follow(metrics, records, slot, track)
            if len(here) > 1:
                metrics.compare_tables(slot, *_believed(records, here, slot, config.agents))
            count = senders.get(slot, 0)
            outcome = COLLISION if count > 1 else SUCCESS if count else IDLE
            metrics.update(slot, track, tables, outcome, [config.frame_length] * count)
            known.follow(slot, here, tables)
        if common_slot is not None and slot >= common_slot:
            tables.estimate(slot + 1)
            yield Moment(slot, tables, _places(records, slot, config.agents), metrics.counted, counts)
        _forget(tables, observers, lives, slot)
    return None if first is None else _results(metrics, first) | known.summary()


class Flown:
    """The slots of a flight, and its results afterwards."""

    def __init__(self, flight: Generator[Moment, None, dict[str, Any] | None]) -> None:
        self._flight = flight
        self.results: dict[str, Any] | None = None

    def __iter__(self) -> Iterator[Moment]:
        self.results = yield from self._flight


def ended(flight: Generator[Moment, None, dict[str, Any] | None]) -> dict[str, Any] | None:
    """The results of a flight, flown to its end."""
    flown = Flown(flight)
    for _ in flown:
        pass
    return flown.results


def _places(records: Records, slot: int, agents: int) -> NDArray[np.float64]:
    """Where all were at the end of a slot, (3, N) m; NaN for those whose record of the next one is missing."""
    places = np.full((3, agents), np.nan)
    for agent, slots in records.items():
        if slot + 1 in slots:
            places[:, agent - 1] = slots[slot + 1].track[-1]
    return places


def _forget(tables: Swarm, observers: Sequence[int], lives: Mapping[Life, AgentBag], slot: int) -> None:
    """A process that has ended knows nothing any more: what it knew last does not grow old."""
    for (agent, _), bag in lives.items():
        if bag.slots and bag.slots[-1].slot == slot:
            tables.in_ap[observers.index(agent)] = 0


def _new(replay: Replay) -> bool:
    """Whether an agent is on probation: it speaks at its anchors only, and hovers."""
    swarm = replay.swarm
    return swarm.config.policy_row.probation and bool(swarm.lease_status(0)["probation"])


def _follow(metrics: FlightMetrics, records: Records, slot: int, track: Any) -> list[int]:
    """Where all were during a slot, as their records of the next one say; who has fallen out is lost."""
    here = []
    for agent, slots in records.items():
        following = slots.get(slot + 1)
        if following is not None:
            track[:, :, agent - 1] = following.track
            if agent in metrics.lost:
                metrics.regain(agent)
            if slot in slots:
                here.append(agent)
        elif agent not in metrics.lost and not any(slot + ahead in slots for ahead in range(2, _GAP_SLOTS)):
            metrics.lose(agent, hovers=False)
    return here


def _believed(records: Records, here: Sequence[int], slot: int, agents: int) -> tuple[Any, Any]:
    """Digests and choices of those that are here; of the others, those of the first one: they have no say."""
    first = records[here[0]][slot]
    digests = np.full(agents, first.digest, dtype=np.uint32)
    chosen = np.full(agents, first.chosen, dtype=np.uint16)
    for agent in here:
        digests[agent - 1], chosen[agent - 1] = records[agent][slot].digest, records[agent][slot].chosen
    return digests, chosen


def _results(metrics: FlightMetrics, first: int) -> dict[str, Any]:
    """The results of the flight, with slots and times counted from its first slot."""
    found = {name: value for name, value in metrics.summary().items() if name not in _NOT_MEANT}
    slot_s, flown = metrics.run.swarm.slot_s, metrics.slots - first
    found["slots"]["total"] = flown
    for name in ("min_distance_time_s", "completion_time_s"):
        if found[name] is not None:
            found[name] -= first * slot_s
    for name in ("frames_per_s", "bytes_per_s"):
        if found[name] is not None:
            found[name] *= metrics.slots / flown
    found["flight_time_s"] = flown * slot_s
    if found["first_divergence_slot"] is not None:
        found["first_divergence_slot"] -= first
    return found
