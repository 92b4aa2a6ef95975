"""Agents of a flight replayed from their own records, slot by slot: decisions compared, and the results."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping, Sequence
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.port import flight_ns, frame_in
from dtsa_agent.air.port import PortProperties
from dtsa_agent.air.record import ReceivedFrame, SlotRecord
from dtsa_agent.core import Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_bench.log.arrays import NEW
from dtsa_bench.log.replay import AgentReplay, AgentState, HeardBy
from dtsa_bench.runs.config import REALTIME, RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .timeline import Life

_FOREVER_S = 86_400.0
_GAP_SLOTS = 50  # an agent that says nothing for longer has fallen out
_MAX_DIFFERENCES = 5  # listed of each agent
_KEPT = ("sent_position", "sent_velocity", "sent_intent", "sent_slot", "last_turn", "in_ap")
# Of the results of other flights; the bags do not say how long frames of that port are on the air.
_NOT_MEANT = ("end", "timed_out", "loss", "channel_load", "wall_time_s", "realtime_factor")

Records = Mapping[int, Mapping[int, SlotRecord]]  # by agent and slot


@dataclass(slots=True)
class AgentBag:
    """What one agent said about itself."""

    path: Path
    agent: int  # id
    swarm: SwarmConfig
    port: PortProperties
    started_ns: int  # own clock, when its process began
    slots: list[SlotRecord] = field(default_factory=list)  # ascending, but where it took over another time
    refused: Counter[str] = field(default_factory=Counter)  # datagrams not accepted, by reason
    summary: dict[str, Any] = field(default_factory=dict)  # its own; empty: it was killed
    broken_off: bool = False  # the file was not finished
    goals_told: bool = False  # it was told goals in flight: none was known to be its last
    zero_ns: int = 0  # what its clock showed at time 0 of the bag

    @property
    def flight_ns(self) -> int:
        """From the order to send a frame to its arrival as the agents take it to be, ns."""
        return flight_ns(self.swarm, self.port)


class ProcessReplay:
    """The agent of one process, replayed from its own records."""

    def __init__(self, bag: AgentBag) -> None:
        self._config, self.agent = bag.swarm, bag.agent
        self._replay = AgentReplay(bag.swarm, [bag.agent], goals_told=bag.goals_told)
        self.swarm = self._replay.swarm
        self.equal = 0  # slots
        self.differences: list[dict[str, Any]] = []

    def step(self, record: SlotRecord) -> None:
        """One slot; the frame of an agent that was too late to send is made again."""
        presence = np.array([record.present | (NEW if record.is_first else 0)], np.uint8)
        vectors = [vector.reshape(3, 1) for vector in (record.velocity, record.command, record.goal)]
        state = AgentState(record.track[:, :, None], *vectors, presence)
        self._replay.decide(record.slot, state, self._heard(record.before))
        self._compare(record)
        self._replay.complete([0] if record.sent_ns < 0 else [], self._heard(record.heard))

    def copy_into(self, tables: Any, row: int) -> None:
        """Copy what the agent knows into a row of tables."""
        for name in _KEPT:
            getattr(tables, name)[row] = getattr(self.swarm, name)[0]

    def _heard(self, frames: Sequence[ReceivedFrame]) -> list[HeardBy]:
        return [HeardBy(heard.slot, frame_in(heard.datagram, self._config), None) for heard in frames]

    def _compare(self, record: SlotRecord) -> None:
        swarm = self.swarm
        frame = swarm.frame(0) if swarm.sends[0] else b""
        again = {"chosen": int(swarm.chosen[0]), "reason": int(swarm.reason[0]), "digest": int(swarm.digest[0])}
        again |= {"score": float(swarm.score[0]), "frame": frame.hex()}
        recorded: dict[str, Any] = {name: getattr(record, name) for name in ("chosen", "reason", "digest", "score")}
        if record.sent_ns < 0:
            record.frame, recorded["frame"] = frame, frame.hex()
        else:
            sent = frame_in(record.datagram, self._config)
            recorded["frame"] = sent[: len(sent) - (TAG_LENGTH if self._config.auth else 0)].hex()
        wrong = [name for name, value in recorded.items() if value != again[name]]
        if not wrong:
            self.equal += 1
        elif len(self.differences) < _MAX_DIFFERENCES:
            name = wrong[0]
            self.differences.append({
                "agent": self.agent, "slot": record.slot, "field": name, "recorded": recorded[name],
                "again": again[name],
            })  # fmt: skip


def all_known_after(config: SwarmConfig) -> int:
    """Slots after which each agent that is there can be known to all that hear it: (M + 2) N."""
    return (config.turn_every + 2) * config.agents


class KnownPairs:
    """Pairs of two agents that are there: which of them knew each other, and the oldest frame heard."""

    def __init__(self, config: SwarmConfig, observers: Sequence[int]) -> None:
        self._slot_ms, self._fresh = config.slot_ms, all_known_after(config)
        self._row = {agent: row for row, agent in enumerate(observers)}
        self._heard: dict[tuple[int, int], int] = {}  # slot of the newest frame, by observer and sender
        self._first = 0
        self._pairs = self._known = self._age_max = 0
        self._oldest: tuple[int, int] | None = None

    def hear(self, observer: int, record: SlotRecord) -> None:
        """Takes in what an agent heard in a slot."""
        for one in (*record.before, *record.heard):
            pair = observer, one.sender
            self._heard[pair] = max(one.slot, self._heard.get(pair, one.slot))

    def begin(self, slot: int) -> None:
        """Results count from a slot on; who was never heard is as old as they are."""
        self._first = slot

    def follow(self, slot: int, here: Sequence[int], tables: Swarm) -> None:
        """Takes in the end of a slot."""
        for observer in here:
            sent = tables.sent_slot[self._row[observer]].tolist()
            for other in here:
                if other == observer:
                    continue
                self._pairs += 1
                self._known += sent[other - 1] >= max(0, slot - self._fresh)
                age = slot - self._heard.get((observer, other), self._first - 1)
                if age > self._age_max or self._oldest is None:
                    self._age_max, self._oldest = age, (observer, other)

    def summary(self) -> dict[str, Any]:
        """Plain values; None where no two were there."""
        return {
            "pairs_known_share": self._known / self._pairs if self._pairs else None,
            "heard_age_max_slots": self._age_max if self._oldest else None,
            "heard_age_max_ms": self._age_max * self._slot_ms if self._oldest else None,
            "heard_age_max_pair": list(self._oldest) if self._oldest else None,
        }


@dataclass(frozen=True, slots=True)
class JoinedSlot:
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


def replay_flight(
    lives: Mapping[Life, AgentBag],
    replays: Mapping[Life, ProcessReplay],
    senders: Mapping[int, int],
    common_slot: int | None,
) -> Generator[JoinedSlot, None, dict[str, Any] | None]:
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
            replays[life].step(record)
            replays[life].copy_into(tables, observers.index(life[0]))
            known.hear(life[0], record)
        counts = begins is not None and begins <= slot < last
        if counts and first is None:
            counts = not any(_is_new(replays[life]) for life in by_slot[slot])
        if counts:
            if first is None:
                first = slot
                known.begin(slot)
            here = _update_track(metrics, records, slot, track)
            if len(here) > 1:
                metrics.compare_tables(slot, *_beliefs(records, here, slot, config.agents))
            count = senders.get(slot, 0)
            outcome = COLLISION if count > 1 else SUCCESS if count else IDLE
            metrics.update(slot, track, tables, outcome, [config.frame_length] * count)
            known.follow(slot, here, tables)
        if common_slot is not None and slot >= common_slot:
            tables.estimate(slot + 1)
            yield JoinedSlot(slot, tables, _positions(records, slot, config.agents), metrics.counted, counts)
        _forget_ended(tables, observers, lives, slot)
    return None if first is None else _results(metrics, first) | known.summary()


class ReplayedFlight:
    """The slots of a flight, and its results afterwards."""

    def __init__(self, flight: Generator[JoinedSlot, None, dict[str, Any] | None]) -> None:
        self._flight = flight
        self.results: dict[str, Any] | None = None

    def __iter__(self) -> Iterator[JoinedSlot]:
        self.results = yield from self._flight


def flight_results(flight: Generator[JoinedSlot, None, dict[str, Any] | None]) -> dict[str, Any] | None:
    """The results of a flight, flown to its end."""
    flown = ReplayedFlight(flight)
    for _ in flown:
        pass
    return flown.results


def _positions(records: Records, slot: int, agents: int) -> NDArray[np.float64]:
    """Where all were at the end of a slot, (3, N) m; NaN for those whose record of the next one is missing."""
    places = np.full((3, agents), np.nan)
    for agent, slots in records.items():
        if slot + 1 in slots:
            places[:, agent - 1] = slots[slot + 1].track[-1]
    return places


def _forget_ended(tables: Swarm, observers: Sequence[int], lives: Mapping[Life, AgentBag], slot: int) -> None:
    """A process that has ended knows nothing any more: what it knew last does not grow old."""
    for (agent, _), bag in lives.items():
        if bag.slots and bag.slots[-1].slot == slot:
            tables.in_ap[observers.index(agent)] = 0


def _is_new(replay: ProcessReplay) -> bool:
    """Whether an agent is on probation: it speaks at its anchors only, and hovers."""
    swarm = replay.swarm
    return swarm.config.policy_row.probation and bool(swarm.lease_status(0)["probation"])


def _update_track(metrics: FlightMetrics, records: Records, slot: int, track: Any) -> list[int]:
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


def _beliefs(records: Records, here: Sequence[int], slot: int, agents: int) -> tuple[Any, Any]:
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
