"""A flight of agents on a network, replayed slot by slot from its merged log: decisions, ages, results, rules."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_bench.runs.config import REALTIME, RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .arrays import FlightArrays
from .bag.errors import UnusableBag
from .replay import AgentReplay, MeanAges, ObservedPairs
from .rules import RuleChecker

_FOREVER_S = 86_400.0
_GAP_SLOTS = 50  # an agent that says nothing for longer has fallen out
_KEPT = ("sent_position", "sent_velocity", "sent_intent", "sent_slot", "last_turn", "in_ap")
# Of the results of other flights; the bags do not say how long frames of that port are on the air.
_NOT_MEANT = ("end", "timed_out", "loss", "channel_load", "wall_time_s", "realtime_factor")


def run_of(config: SwarmConfig) -> RunConfig:
    """A merged flight's configuration; its channel stands for a network of which nothing is known."""
    limits = RunLimits(timeout_s=_FOREVER_S, stop_on_crash=False)
    return RunConfig(config, ChannelConfig(**from_swarm(config)), limits, REALTIME)


def slots_until_all_known(config: SwarmConfig) -> int:
    """Slots after which each agent that is there can be known to all that hear it: (M + 2) N."""
    return (config.turn_every + 2) * config.agents


class PairKnowledge:
    """Pairs of two agents that are there: how many knew each other, and the oldest frame heard."""

    def __init__(self, config: SwarmConfig, observers: Sequence[int]) -> None:
        self._slot_ms, self._fresh = config.slot_ms, slots_until_all_known(config)
        self._row = {agent: row for row, agent in enumerate(observers)}
        self._heard: dict[tuple[int, int], int] = {}  # slot of the newest frame, by observer and sender
        self._first = 0
        self._pairs = self._known = self._age_max = 0
        self._oldest: tuple[int, int] | None = None

    def add_received(self, log: FlightArrays, row: int) -> None:
        """Count what agents heard in a slot."""
        if log.heard is None:
            return
        for k in range(log.heard_ends[row], log.heard_ends[row + 1]):
            for column in np.flatnonzero(log.heard.receivers[k]).tolist():
                pair, slot = (column + 1, int(log.heard.sender[k])), int(log.heard.slot[k])
                self._heard[pair] = max(slot, self._heard.get(pair, slot))

    def start(self, slot: int) -> None:
        """Count from a slot on; an agent that was never heard is as old as the results."""
        self._first = slot

    def add_slot(self, slot: int, here: Sequence[int], tables: Swarm) -> None:
        """Count the end of a slot."""
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
class MergedSlot:
    """The end of a slot."""

    row: int  # of the log
    slot: int  # as the agents count
    tables: Swarm  # what the agents know, a row for each that has a bag
    position: NDArray[np.float64]  # m, (3, N), frame map, true; NaN where it is not known
    counted: NDArray[np.bool_]  # (N,) agents whose ages and errors the results take
    results: bool  # whether the results count the slot

    def pairs(self) -> tuple[Any, Any, Any]:
        """(V, N): whether an observer expects an agent to move, age (slots) and error (m; NaN: not known)."""
        tables = self.tables
        counted = (tables.in_ap != 0) & (tables.sent_slot >= 0)
        counted[np.arange(len(counted)), tables.observer] = False
        gap = np.sqrt(((tables.estimate_position - self.position) ** 2).sum(axis=1))
        return counted, self.slot - tables.sent_slot, gap


class _Process:
    """A process of an agent, between the first and the last slot that it recorded."""

    def __init__(self, config: SwarmConfig, about: Mapping[str, Any], compares: bool) -> None:
        self.agent, self.first, self.last = (int(about[name]) for name in ("agent", "first", "last"))
        self.has_ended, self.is_broken_off = bool(about["ended_in_order"]), bool(about["broken_off"])
        if not 1 <= self.agent <= config.agents:
            raise ValueError(f"agent {self.agent}")
        self.replay = AgentReplay(config, [self.agent], goals_told=bool(about["goals_told"]), compares=compares)


class MergedReplay:
    """All agents of a merged flight; iterating replays them, and gives the slots from the common one on.

    :param compares: what they decide with the log; otherwise only what they know is followed.
    :raises UnusableBag: if what the log was merged from does not fit it.
    """

    def __init__(self, log: FlightArrays, compares: bool = True) -> None:
        assert log.merged is not None
        self._log, self._config = log, log.config.swarm
        try:
            self.processes = [_Process(self._config, about, compares) for about in log.merged["processes"]]
        except (KeyError, ValueError, TypeError) as error:
            raise UnusableBag(log.file or log.name, f"its records do not fit together ({error})") from None
        #: The results from when all can have become known, (M + 2) N slots after the common one, and from when no agent
        #: is new any more (until then they hover), until the first of them ends in order; None: there are none.
        self.results: dict[str, Any] | None = None

    @property
    def equal(self) -> int:
        """Decisions that are as recorded."""
        return sum(process.replay.equal for process in self.processes)

    @property
    def differences(self) -> list[dict[str, Any]]:
        """The first decisions of each process that are not, as plain values."""
        return [
            {
                "agent": one.agent, "slot": one.slot, "field": one.field,
                **{name: value.hex() if isinstance(value, bytes) else value
                   for name, value in (("recorded", one.recorded), ("again", one.expected))},
            }
            for process in self.processes
            for one in process.replay.differences
        ]  # fmt: skip

    @property
    def unsent(self) -> dict[tuple[int, int], bytes]:
        """Frames that were made and not sent, by slot and agent."""
        return {key: data for process in self.processes for key, data in process.replay.unsent.items()}

    def run(self) -> MergedReplay:
        """Replay all slots."""
        for _ in self:
            pass
        return self

    def __iter__(self) -> Iterator[MergedSlot]:
        log, config, scenario = self._log, self._config, make_scenario(self._config)
        parts, agents = log.parts, log.agents
        first = parts[0].first_slot
        known = np.concatenate([part.known for part in parts])
        observers = sorted({process.agent for process in self.processes})
        if not observers:
            return
        common = log.first_slot
        begins = common + slots_until_all_known(config)
        metrics, pairs = FlightMetrics(run_of(config), scenario), PairKnowledge(config, observers)
        tables = make_swarm(config, scenario, local=[], observers=observers)
        track = np.repeat(scenario.start[None], config.steps, axis=0)
        last = min((process.last for process in self.processes if process.has_ended), default=first + len(known) - 1)
        for agent in set(range(1, agents + 1)) - set(observers):
            metrics.lose(agent, hovers=False)
        start: int | None = None  # of the results
        for part, row in ((part, row) for part in parts for row in range(len(part))):
            slot, index = part.first_slot + row, part.first_slot + row - first
            active = [
                process
                for process in self.processes
                if process.first <= slot <= process.last and known[index, process.agent - 1]
            ]
            if not active:
                continue
            for process in active:
                process.replay.step(part, row)
                for name in _KEPT:
                    getattr(tables, name)[observers.index(process.agent)] = getattr(process.replay.swarm, name)[0]
            pairs.add_received(part, row)
            counts = begins <= slot < last
            if counts and start is None:
                counts = not any(_is_new(process.replay.swarm) for process in active)
            if counts:
                if start is None:
                    start = slot
                    pairs.start(slot)
                here = _update_track(metrics, observers, known[index:], part.track[row + 1], track)
                if len(here) > 1:
                    metrics.compare_tables(slot, *_beliefs(part, row, here))
                count = int(part.sent[row].sum())
                outcome = COLLISION if count > 1 else SUCCESS if count else IDLE
                metrics.update(slot, track, tables, outcome, [config.frame_length] * count)
                pairs.add_slot(slot, here, tables)
            if part is log:
                tables.estimate(slot + 1)
                yield MergedSlot(row, slot, tables, part.track[row + 1, -1], metrics.counted, counts)
            for process in active:
                if process.last == slot:  # it has ended: what it knew last does not grow old
                    tables.in_ap[observers.index(process.agent)] = 0
        self.results = None if start is None else _results(metrics, start) | pairs.summary()


def _is_new(swarm: Swarm) -> bool:
    """Whether an agent is on probation: it sends at its anchors only, and hovers."""
    return swarm.config.policy_row.probation and bool(swarm.lease_status(0)["probation"])


def _update_track(
    metrics: FlightMetrics, observers: Sequence[int], known: NDArray[np.bool_], after: Any, track: Any
) -> list[int]:
    """Where all were during a slot, as their accounts of the next one say; an agent that has fallen out is lost.

    :param known: (S, N) of this slot and those that follow.
    :param after: positions that belong to the next one.
    :returns: ids of the agents that were there.
    """
    here = []
    for agent in observers:
        column = agent - 1
        if len(known) > 1 and known[1, column]:
            track[:, :, column] = after[:, :, column]
            if agent in metrics.lost:
                metrics.regain(agent)
            if known[0, column]:
                here.append(agent)
        elif agent not in metrics.lost and not known[2:_GAP_SLOTS, column].any():
            metrics.lose(agent, hovers=False)
    return here


def _beliefs(log: FlightArrays, row: int, here: Sequence[int]) -> tuple[Any, Any]:
    """Digests and choices of those that are here; of the others, those of the first one: they have no say."""
    columns, first = np.array(here) - 1, here[0] - 1
    found = []
    for values in (log.digest[row], log.chosen[row]):
        beliefs = np.full_like(values, values[first])
        beliefs[columns] = values[columns]
        found.append(beliefs)
    return found[0], found[1]


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


# -- what the log must hold ------------------------------------------------------------------------------------------
def check_rules(log: FlightArrays, unsent: Mapping[tuple[int, int], bytes]) -> RuleChecker:
    """Whether the frames that were sent, or heard, keep to the rules, from when on all counted alike.

    :param unsent: frames that were made and not sent, by slot and agent.
    """
    rules, by_slot = RuleChecker(log.config.swarm), dict[int, dict[int, bytes]]()
    for (slot, agent), data in unsent.items():
        by_slot.setdefault(slot, {})[agent] = data
    for row in range(len(log)):
        slot, frames = log.first_slot + row, log.frames_in(row)
        if frames or slot in by_slot:
            rules.check_slot(slot, frames, by_slot.get(slot))
    return rules


def count_unmatched_frames(log: FlightArrays) -> int:
    """How many frames were heard that their sender's bag does not have, or has otherwise."""
    about, processes = log.merged or {}, MergedReplay(log).processes
    whole: set[int] = set()  # agents of whom all that they sent is there
    if not about["nothing_written"] and not about["not_on_the_time_line"]:
        whole = {process.agent for process in processes} - {p.agent for p in processes if p.is_broken_off}
    gave_up = set(about.get("agents_that_gave_up_a_time", ()))
    recorded = {key: data for part in log.parts for key, data in _recorded_frames(part)}
    heard = Counter(
        (slot, sender, data)
        for part in log.parts
        if part.heard is not None
        for slot, sender, data in zip(part.heard.slot.tolist(), part.heard.sender.tolist(), part.heard.data, strict=True)
    )
    return sum(
        count
        for (slot, sender, data), count in heard.items()
        if sender not in gave_up
        and (data != recorded[slot, sender] if (slot, sender) in recorded else sender in whole)
    )


def _recorded_frames(log: FlightArrays) -> Iterator[tuple[tuple[int, int], bytes]]:
    """Frames that their senders have recorded, by slot and sender."""
    frames = log.sent_frames
    for row, sender, data in zip(frames.row.tolist(), frames.sender.tolist(), frames.data, strict=True):
        if log.known[row, sender - 1]:
            yield (log.first_slot + row, sender), data


# -- what the agents knew --------------------------------------------------------------------------------------------
def follow_merged(log: FlightArrays) -> tuple[MeanAges, dict[str, Any], list[str]]:
    """What the agents of a merged flight knew, and its results, by replaying all of them."""
    ages, replay = MeanAges.empty(len(log), log.agents), MergedReplay(log, compares=False)
    for slot in replay:
        counted, age, error = slot.pairs()
        ages.results[slot.row] = slot.results
        ages.set_means(slot.row, counted & slot.counted, age, error)
    return ages, replay.results or {}, _notes(log.merged or {}, np.flatnonzero(ages.results))


def observed_merged(log: FlightArrays) -> Iterator[ObservedPairs]:
    """What each observer of a merged flight knew, slot by slot; only those of which there is a record."""
    for slot in MergedReplay(log, compares=False):
        tables = slot.tables
        expected, age, error = slot.pairs()
        known = (tables.sent_slot >= 0) & log.known[slot.row][tables.observer][:, None]
        known[np.arange(len(known)), tables.observer] = False
        at, column = np.nonzero(known)
        counted = expected & slot.counted & slot.results
        observers = tables.observer[at] + 1
        yield ObservedPairs(slot.row, observers, column + 1, age[at, column], error[at, column], counted[at, column])


def _notes(about: Mapping[str, Any], results: Any) -> list[str]:
    """What to know of a merged flight."""
    residual = about["residual_us"]
    notes = [
        f"Merged from {len(about['processes'])} agents' bags. Slot 0 is slot {about['common_slot']} of the agents, the "
        f"first that all counted alike. Half of the frames fit the common time line within {residual['p50']:.0f} us, "
        f"99 % within {residual['p99']:.0f} us. A network does not say why a frame was not received: it counts as lost."
    ]
    for key, text in (
        ("missing", "There is no bag of {}: what they did, and where they were, is not known."),
        ("broken_off", "The bags of {} break off: what they did afterwards is not known."),
        ("not_on_the_time_line", "Left out because frames do not go both ways between them and the others: {}."),
        ("nothing_written", "Nothing was written in {}."),
    ):
        if about.get(key):
            notes.append(text.format(", ".join(f"cf{one}" if isinstance(one, int) else str(one) for one in about[key])))
    if len(results):
        notes.append(
            f"Results are those of slots {results[0]} to {results[-1]}: from when no agent was on probation until "
            "the first agent ended. Completion time counts from there."
        )
    else:
        notes.append("There are no results: at no time had all agents been heard, and none was on probation.")
    return notes
