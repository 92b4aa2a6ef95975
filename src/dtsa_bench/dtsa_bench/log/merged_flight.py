"""A flight of agents on a network, replayed slot by slot from its merged log: decisions, ages, results, rules."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.plugins import make_swarm
from dtsa_bench.runs.config import REALTIME, RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .arrays import FlightArrays
from .bag.errors import UnusableBag
from .replay import AgentReplay
from .rules import RuleChecker

_FOREVER_S = 86_400.0
_GAP_SLOTS = 50  # an agent that says nothing for longer has fallen out
_KEPT = ("sent_position", "sent_velocity", "sent_intent", "sent_slot", "last_turn", "in_ap")
_MERGED = (
    "Merged from {count} agents' bags. Slot 0 is slot {common_slot} of the agents, the first that all counted alike. "
    "Half of the frames fit the common time line within {p50:.0f} us, 99 % within {p99:.0f} us. A network does not say "
    "why a frame was not received: it counts as lost."
)
_LEFT_OUT = {
    "missing": "There is no bag of {}: what they did, and where they were, is not known.",
    "broken_off": "The bags of {} break off: what they did afterwards is not known.",
    "not_on_the_time_line": "Left out because frames do not go both ways between them and the others: {}.",
    "nothing_written": "Nothing was written in {}.",
}
_RESULTS = (
    "Results are those of slots {} to {}: from when no agent was on probation until the first agent ended. Completion "
    "time counts from there."
)
_NO_RESULTS = "There are no results: at no time had all agents been heard, and none was on probation."
# Of the results of other flights; the bags do not say how long frames of that port are on the air.
_NOT_MEANT = ("end", "timed_out", "loss", "channel_load", "wall_time_s", "realtime_factor")


def run_of(config: SwarmConfig) -> RunConfig:
    """A merged flight's configuration; its channel stands for a network of which nothing is known."""
    limits = RunLimits(timeout_s=_FOREVER_S, stop_on_crash=False)
    return RunConfig(config, ChannelConfig(**from_swarm(config)), limits, REALTIME)


def slots_until_all_known(config: SwarmConfig) -> int:
    """Slots after which each agent that is there can be known to all that hear it: (M + 2) N."""
    return (config.turn_every + 2) * config.agents


class _PairAges:
    """Pairs of two agents that are there: how many knew each other, and the oldest frame heard."""

    def __init__(self, log: FlightArrays) -> None:
        self._log, config = log, log.config.swarm
        self._slot_ms, self._fresh = config.slot_ms, slots_until_all_known(config)
        self._newest = np.full((log.agents, log.agents), -1)  # slot of the newest frame that each heard of each
        self._pairs = self._known = 0
        self._oldest, self._pair = -1, (0, 0)

    def add_received(self, row: int) -> None:
        """Count what agents heard in a slot."""
        heard = self._log.heard
        for k in range(self._log.heard_ends[row], self._log.heard_ends[row + 1]) if heard is not None else ():
            if 0 < heard.sender[k] <= self._log.agents:
                newest = self._newest[:, heard.sender[k] - 1]
                np.maximum(newest, heard.slot[k], out=newest, where=heard.receivers[k])

    def add_slot(self, slot: int, first: int, here: Sequence[int], tables: Swarm) -> None:
        """Count the end of a slot.

        :param first: of the slots that count: an agent that was never heard is as old as they are.
        """
        column = np.array(here, np.int64) - 1
        newest, others = self._newest[np.ix_(column, column)], column[:, None] != column
        sent = tables.sent_slot[np.ix_(np.searchsorted(tables.observer, column), column)]
        age = np.where(others, slot - np.where(newest < 0, first - 1, newest), -1)
        self._pairs += int(others.sum())
        self._known += int((sent >= max(0, slot - self._fresh))[others].sum())
        if age.max(initial=-1) > self._oldest:
            observer, sender = np.unravel_index(age.argmax(), age.shape)
            self._oldest, self._pair = int(age.max()), (here[observer], here[sender])

    def summary(self) -> dict[str, Any]:
        """Plain values; None where no two were there."""
        some = self._oldest >= 0
        return {
            "pairs_known_share": self._known / self._pairs if self._pairs else None,
            "heard_age_max_slots": self._oldest if some else None,
            "heard_age_max_ms": self._oldest * self._slot_ms if some else None,
            "heard_age_max_pair": list(self._pair) if some else None,
        }


@dataclass(frozen=True, slots=True)
class KnownSlot:
    """The end of a slot, and what the agents know then."""

    row: int  # of the log
    slot: int  # as the agents count
    tables: Swarm  # what the agents know, with the estimates for this time
    position: NDArray[np.float64]  # m, (3, N), frame map, true; NaN where it is not known
    counted: NDArray[np.bool_]  # (N,) agents whose ages and errors the results take
    results: bool  # whether the results count the slot

    def pairs(self) -> tuple[Any, Any, Any]:
        """(V, N): whether an observer expects an agent to move, age (slots) and error (m; NaN: not known)."""
        tables = self.tables
        counted = (tables.in_ap != 0) & (tables.sent_slot >= 0)
        if tables.observer[0] >= 0:
            counted[np.arange(len(counted)), tables.observer] = False
        gap = np.sqrt(((tables.estimate_position - self.position) ** 2).sum(axis=1))
        return counted, self.slot - tables.sent_slot, gap


class _Process:
    """A process of an agent, between the first and the last slot that it recorded."""

    def __init__(self, log: FlightArrays, about: Mapping[str, Any], compares: bool) -> None:
        self.agent, self.first, self.last = (int(about[name]) for name in ("agent", "first", "last"))
        self.has_ended, self.is_broken_off = bool(about["ended_in_order"]), bool(about["broken_off"])
        if not 1 <= self.agent <= log.agents:
            raise ValueError(f"agent {self.agent}")
        self.replay = AgentReplay(log, [self.agent], goals_told=bool(about["goals_told"]), compares=compares)


class MergedReplay:
    """All agents of a merged flight; iterating replays them, and gives the slots from the common one on.

    The results are from when all can have become known, (M + 2) N slots after the common one, and from when no agent is
    new any more (until then they hover), until the first of them ends in order.

    :param compares: what they decide with the log; otherwise only what they know is followed.
    :raises UnusableBag: if what the log was merged from does not fit it.
    """

    is_shared = False

    def __init__(self, log: FlightArrays, compares: bool = True) -> None:
        assert log.merged is not None
        self._log, self._whole, self._config = log, log.whole or log, log.config.swarm
        try:
            if len(self._whole) and self._whole.track.shape[1] != self._config.steps:
                raise ValueError(f"{self._whole.track.shape[1]} control instants a slot, not {self._config.steps}")
            self.processes = [_Process(self._whole, about, compares) for about in log.merged["processes"]]
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            raise UnusableBag(log.file or log.name, f"its records do not fit together ({error})") from None
        self.results: dict[str, Any] | None = None  # None: there are none
        self._counted: tuple[int, int] | None = None  # first and last row of the log that they count

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

    def count_unmatched_frames(self) -> int:
        """How many frames were heard that their sender's bag does not have, or has otherwise."""
        about, whole = self._log.merged or {}, self._whole
        if whole.heard is None:
            return 0
        complete: set[int] = set()  # agents of whom all that they sent is there
        if not about["nothing_written"] and not about["not_on_the_time_line"]:
            complete = {process.agent for process in self.processes}
            complete -= {process.agent for process in self.processes if process.is_broken_off}
        count, gave_up = 0, about.get("agents_that_gave_up_a_time", ())
        columns = whole.heard.slot.tolist(), whole.heard.sender.tolist(), whole.heard.data
        for slot, sender, data in zip(*columns, strict=True):
            row = slot - whole.first_slot
            is_recorded = 0 <= row < len(whole) and 0 < sender <= whole.agents and whole.known[row, sender - 1]
            sent = whole.frame(row, sender) if is_recorded else b""
            count += (sent != data if sent else sender in complete) and sender not in gave_up
        return count

    def run(self) -> MergedReplay:
        """Replay all slots."""
        for _ in self:
            pass
        return self

    def __iter__(self) -> Iterator[KnownSlot]:
        log, config, scenario = self._whole, self._config, make_scenario(self._config)
        observers = np.unique([process.agent for process in self.processes]).astype(np.int64)
        if not len(observers):
            return
        metrics, pairs = FlightMetrics(run_of(config), scenario), _PairAges(log)
        tables = make_swarm(config, scenario, local=[], observers=observers.tolist())
        copied = [
            [(getattr(tables, name)[np.searchsorted(observers, process.agent)], getattr(process.replay.swarm, name)[0])
             for name in _KEPT]
            for process in self.processes
        ]  # fmt: skip
        track = np.repeat(scenario.start[None], config.steps, axis=0)
        common = self._log.first_slot - log.first_slot
        begins = common + slots_until_all_known(config)
        ends = [process.last - log.first_slot for process in self.processes if process.has_ended]
        last = min(ends, default=len(log) - 1)
        for agent in set(range(1, log.agents + 1)) - set(observers.tolist()):
            metrics.lose(agent, hovers=False)
        start: int | None = None  # of the results, row
        for row in range(len(log)):
            slot = log.first_slot + row
            active = [
                k for k, process in enumerate(self.processes)
                if process.first <= slot <= process.last and log.known[row, process.agent - 1]
            ]  # fmt: skip
            if not active:
                continue
            for k in active:
                self.processes[k].replay.step(row)
                for table, own in copied[k]:
                    table[:] = own
            pairs.add_received(row)
            counts = begins <= row < last
            if counts and start is None and config.policy_row.probation:
                counts = not any(self.processes[k].replay.swarm.lease_status(0)["probation"] for k in active)
            if counts:
                start = row if start is None else start
                here = _update_track(metrics, observers.tolist(), log.known[row:], log.track[row + 1], track)
                if len(here) > 1:
                    # Those that are not there have no say: they count as the first one that is.
                    say, first = np.isin(np.arange(1, log.agents + 1), here), here[0] - 1
                    beliefs = (np.where(say, one[row], one[row, first]) for one in (log.digest, log.chosen))
                    metrics.compare_tables(slot, *beliefs)
                count = int(log.sent[row].sum())
                outcome = COLLISION if count > 1 else SUCCESS if count else IDLE
                metrics.update(slot, track, tables, outcome, [config.frame_length] * count)
                pairs.add_slot(slot, log.first_slot + start, here, tables)
                self._counted = start - common, row - common
            if row >= common:
                tables.estimate(slot + 1)
                yield KnownSlot(row - common, slot, tables, log.track[row + 1, -1], metrics.counted, counts)
            for k in active:
                if self.processes[k].last == slot:  # it has ended: what it knew last does not grow old
                    tables.in_ap[np.searchsorted(observers, self.processes[k].agent)] = 0
        self.results = (
            None if start is None else _results(metrics, self._log.first_slot, start - common) | pairs.summary()
        )

    @property
    def notes(self) -> list[str]:
        """What to know of the flight, once it has been replayed."""
        about = self._log.merged or {}
        numbers = {name: about["residual_us"][name] for name in ("p50", "p99")}
        notes = [_MERGED.format(count=len(about["processes"]), common_slot=about["common_slot"], **numbers)]
        for key, text in _LEFT_OUT.items():
            if about.get(key):
                named = ", ".join(f"cf{one}" if isinstance(one, int) else str(one) for one in about[key])
                notes.append(text.format(named))
        return [*notes, _NO_RESULTS if self._counted is None else _RESULTS.format(*self._counted)]


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


def _results(metrics: FlightMetrics, zero: int, first: int) -> dict[str, Any]:
    """The results of the flight, with slots and times counted from slot 0 of its log, the completion from their first.

    :param zero: number that the agents gave slot 0.
    :param first: slot of the log with which the results begin.
    """
    found = {name: value for name, value in metrics.summary().items() if name not in _NOT_MEANT}
    slot_s, flown = metrics.run.swarm.slot_s, metrics.slots - zero - first
    found["slots"]["total"] = flown
    for name, since in (("min_distance_time_s", zero * slot_s), ("completion_time_s", (zero + first) * slot_s)):
        if found[name] is not None:
            found[name] -= since
    for name in ("frames_per_s", "bytes_per_s"):
        if found[name] is not None:
            found[name] *= metrics.slots / flown
    found["flight_time_s"] = flown * slot_s
    if found["first_divergence_slot"] is not None:
        found["first_divergence_slot"] -= zero
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
