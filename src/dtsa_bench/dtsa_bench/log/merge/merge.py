"""The bags of the agents of one flight on one time line: what no single one of them could know."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from dtsa_agent.air.record import SlotRecord
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log.agent_bag import AgentBag
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.merged_flight import MergedReplay, check_rules
from dtsa_bench.log.rules import RuleChecker
from dtsa_bench.runs.delivery import counts_of_datagrams

from .join import join
from .timeline import Clock, Crossing, Process, TimeLine, fit, process_name

_END = 50  # slots


class SentDatagram(NamedTuple):
    """A datagram that was handed to the network."""

    process: Process
    record: SlotRecord


class Merge:
    """Bags of one flight on one time line.

    :raises ConfigError: for bags of different swarms, two of one agent at one time, or none with a slot in it.
    """

    def __init__(self, bags: Sequence[AgentBag], nothing_written: Sequence[str] = ()) -> None:
        self.processes = _processes(bags)
        self.nothing_written = list(nothing_written)
        self.config = bags[0].swarm
        self.sent = _sent_datagrams(self.processes)
        self.unmatched, self._crossings = _crossings(self.processes, self.sent, not self.nothing_written)
        kept = [one for one in self._crossings if one.sender[1] >= 0 and one.receiver[1] >= 0]
        self.line = fit(kept, bags[0].flight_ns)
        self.apart = _groups_apart(self.processes, self.line)
        self._starts = _SlotStarts(self.processes, self.line, self.config.slot_ns)

    @cached_property
    def log(self) -> FlightLog:
        """The flight as one log: slots and times of the common line; slot 0 is the first that all counted alike.

        :raises ConfigError: if there is no such slot.
        :raises BagError: if most slots are missing.
        """
        first, clocks = self._starts.common_slot, self.line.clocks
        if first is None and len(self.processes) == 1:  # there is nothing to compare the one clock with
            ((process, bag),) = self.processes.items()
            first, clocks = bag.slots[0].slot, {process: Clock(bag.slots[0].start_ns, 0.0, 0.0)}
        if first is None:
            count, why = len(self.processes), "bags of agents that hear each other and come to count slots alike"
            if self.apart:
                why = f"bags of one flight on one time line; {clocks_apart(self.apart)}"
            raise ConfigError("bags", count, why)
        on_line = {process: bag for process, bag in self.processes.items() if process in clocks and bag.slots}
        slot_ns, (zero, length) = self.config.slot_ns, _line_of_slots(on_line, clocks, first, self.config.slot_ns)

        def to_common_time(clock: Clock) -> Callable[[int], int]:
            return lambda own_ns: round((clock.common_ns(own_ns) - zero) * slot_ns / length)

        times = {process: to_common_time(clocks[process]) for process in on_line}
        summary = self.line.summary()
        about = {
            **self._about_bags(),
            "frames_heard_not_as_sent": self.unmatched,
            "residual_us": {name: value or 0.0 for name, value in summary["residual_us"].items()},
            "clocks": summary["clocks"],
            "slot_on_the_first_clock_ns": length,
            "agents_that_gave_up_a_time": sorted({agent for agent, number in self.processes if number < 0}),
        }
        return join(on_line, times, first, round(self.line.flight_ns), about)

    def _about_bags(self) -> dict[str, Any]:
        here = {agent for agent, _ in self.processes}
        return {
            "missing": [agent for agent in range(1, self.config.agents + 1) if agent not in here],
            "broken_off": [process_name(process) for process, bag in self.processes.items() if bag.broken_off],
            "nothing_written": self.nothing_written,
            "not_on_the_time_line": [
                process_name(process) for process in self.processes
                if process not in self.line.clocks and process[1] >= 0
            ],
            "not_determined": self.apart,
        }  # fmt: skip

    def summary(self, air_ns: int = 0) -> dict[str, Any]:
        """What came of the flight, and whether all decisions follow from what each agent heard, as plain values.

        :param air_ns: ns that a frame is on the air, to tell which overlapped there; 0: only turns are compared.
        """
        processes, line = self.processes, self.line
        has_common = self._starts.common_slot is not None
        joined = MergedReplay(self.log).run() if has_common else None
        alone = [
            MergedReplay(_log_alone(process, bag)).run()  # slots of its own, which are nobody else's
            for process, bag in processes.items()
            if bag.slots and not (has_common and process in line.clocks)
        ]
        replays = [*([joined] if joined else []), *alone]
        refused: Counter[str] = sum((bag.refused for bag in processes.values()), Counter())
        slots, here = max(len(bag.slots) for bag in processes.values()), {agent for agent, _ in processes}
        heard = sum(len(record.before) + len(record.heard) for bag in processes.values() for record in bag.slots)
        delivery = counts_of_datagrams(len(here), slots, len(self.sent), heard, refused)
        held = {process_name(process): bag.summary.get("held_slots") for process, bag in processes.items()}
        rules = check_rules(self.log, joined.unsent) if joined else RuleChecker(self.config)
        return {
            "bags": sum(number >= 0 for _, number in processes),
            "slots_of_times_given_up": sum(len(bag.slots) for (_, number), bag in processes.items() if number < 0),
            **self._about_bags(),
            "time_line": line.summary(),
            **self._starts.summary(),
            **_air(self.sent, line, air_ns, self._starts.common_slot),
            "frames_unsent": sum(len(replay.unsent) for replay in replays),
            "unheard": delivery.problem(refused) or None,
            "frames_heard": len(self._crossings),
            "frames_heard_not_as_sent": self.unmatched,
            "turns": rules.summary(),
            "decisions_again": {
                "equal": sum(replay.equal for replay in replays),
                "of": sum(len(bag.slots) for bag in processes.values()),
                "differences": [one for replay in replays for one in replay.differences],
            },
            "not_taken_in": {process_name(p): dict(bag.refused) for p, bag in processes.items() if bag.refused},
            "held_slots": {name: count for name, count in held.items() if count},
            "never_flew": [process_name(p) for p, bag in processes.items() if bag.summary.get("never_flew")],
            "flight": joined.results if joined else None,
        }


def is_verified(summary: Mapping[str, Any]) -> bool:
    """Whether nothing in a merged flight contradicts the protocol or another bag."""
    again = summary["decisions_again"]
    # Of frames that nobody else heard nothing is known if their sender's bag was not finished.
    is_partial = summary["broken_off"] or summary["missing"] or summary["nothing_written"]
    keeps_rules = is_partial or not summary["turns"]["rules_broken"]
    is_equal = again["equal"] == again["of"] and not summary["frames_heard_not_as_sent"]
    return bool(is_equal and keeps_rules and not summary["not_determined"])


def clocks_apart(groups: Sequence[Sequence[str]]) -> str:
    """That clocks of groups cannot be compared, in words; empty where there are none."""
    if not groups:
        return ""
    named_groups = " | ".join(", ".join(group) for group in groups)
    return f"offsets of clocks not determined: frames do not go both ways between {named_groups}"


def _processes(bags: Sequence[AgentBag]) -> dict[Process, AgentBag]:
    """The bags by agent and process."""
    if not any(bag.slots for bag in bags):
        raise ConfigError("bags", str(bags[0].path) if bags else "", "bags with a slot in them")
    found: dict[Process, AgentBag] = {}
    times = {id(bag): _times(bag) for bag in bags}
    last = [dataclasses.replace(bag, slots=times[id(bag)][-1]) for bag in bags]
    for bag in sorted(last, key=lambda bag: (bag.agent, bag.slots[0].slot if bag.slots else -1)):
        if bag.swarm != bags[0].swarm:
            theirs, ours = bag.swarm.to_dict(), bags[0].swarm.to_dict()
            other = ", ".join(
                f"{name} {theirs[name]}, there {ours[name]}" for name in ours if theirs[name] != ours[name]
            )
            raise ConfigError("bag", str(bag.path), f"one of the same flight as {bags[0].path}: {other}")
        number = sum(agent == bag.agent for agent, _ in found)
        before = found.get((bag.agent, number - 1))
        if before is not None and before.slots and (not bag.slots or bag.slots[0].slot <= before.slots[-1].slot):
            raise ConfigError("bag", str(bag.path), f"one process of cf{bag.agent} at a time: {before.path} is another")
        found[(bag.agent, number)] = bag
    for bag in bags:  # what it flew before it took over a time with smaller numbers: processes of negative ones
        earlier = dataclasses.replace(bag, summary={}, refused=Counter())
        for slots in reversed(times[id(bag)][:-1]):
            number = -1 - sum(agent == bag.agent and number < 0 for agent, number in found)
            found[(bag.agent, number)] = dataclasses.replace(earlier, slots=slots)
    return found


def _times(bag: AgentBag) -> list[list[SlotRecord]]:
    """The slots of an agent, split where they count back: there it took over another time."""
    starts = [0, *(k for k in range(1, len(bag.slots)) if bag.slots[k].slot <= bag.slots[k - 1].slot), len(bag.slots)]
    return [bag.slots[a:b] for a, b in pairwise(starts)]


def _log_alone(process: Process, bag: AgentBag) -> FlightArrays:
    """The log of a process that shares no time line with others."""
    nothing: dict[str, Any] = {"missing": [], "broken_off": [], "nothing_written": [], "not_on_the_time_line": []}
    return join({process: bag}, {process: lambda own_ns: own_ns}, bag.slots[0].slot, 0, nothing)


def _groups_apart(processes: Mapping[Process, AgentBag], line: TimeLine) -> list[list[str]]:
    """The groups between which frames do not go both ways, by names; empty: it is one group.

    A process that sent nothing could not be heard: it makes no group, and is not on the time line either.
    """
    sharing = {process for group in line.groups for process in group}
    alone = [(process,) for process in processes if process not in sharing and process[1] >= 0]
    groups = [
        group for group in (*line.groups, *alone) if any(r.datagram for one in group for r in processes[one].slots)
    ]
    return [[process_name(process) for process in group] for group in groups] if len(groups) > 1 else []


def _sent_datagrams(processes: Mapping[Process, AgentBag]) -> dict[tuple[int, int], SentDatagram]:
    """All datagrams that were sent, by slot and sender."""
    return {
        (record.slot, process[0]): SentDatagram(process, record)
        for process, bag in sorted(processes.items())
        for record in bag.slots
        if record.datagram
    }


def _crossings(
    processes: Mapping[Process, AgentBag], sent: Mapping[tuple[int, int], SentDatagram], complete: bool
) -> tuple[int, list[Crossing]]:
    """How many frames were heard that their sender's bag does not have, or has otherwise, and all others.

    :param complete: whether all that was sent is there.
    """
    unmatched, crossings = 0, []
    whole: set[int] = set()
    if complete:
        whole = {agent for agent, _ in processes} - {agent for (agent, _), bag in processes.items() if bag.broken_off}
    earlier = _sent_datagrams({process: bag for process, bag in processes.items() if process[1] < 0})
    for receiver, bag in processes.items():
        for record in bag.slots:
            for heard in (*record.before, *record.heard):
                origin = sent.get((heard.slot, heard.sender))
                if origin is None or origin.record.datagram != heard.datagram:
                    origin = earlier.get((heard.slot, heard.sender), origin)
                if origin is not None and origin.record.datagram == heard.datagram:
                    crossings.append(Crossing(origin.process, receiver, origin.record.sent_ns, heard.arrival_ns))
                elif origin is not None or heard.sender in whole:
                    unmatched += 1
    return unmatched, crossings


class _SlotStarts:
    """When slots started on the common time line."""

    def __init__(self, processes: Mapping[Process, AgentBag], line: TimeLine, slot_ns: int) -> None:
        self._started = [line.clocks[process].common_ns(bag.started_ns) for process, bag in processes.items()
                         if process in line.clocks and process[1] == 0]  # fmt: skip
        starts: dict[int, list[int]] = {}
        for process, bag in processes.items():
            if process in line.clocks:
                for record in bag.slots:
                    starts.setdefault(record.slot, []).append(line.clocks[process].common_ns(record.start_ns))
        count = max((len(at) for at in starts.values()), default=0)  # the most that were ever there together
        spread = {slot: max(at) - min(at) for slot, at in sorted(starts.items())}
        #: First slot in which as many as ever are there and count alike.
        self.common_slot: int | None = next(
            (slot for slot, apart in spread.items() if len(starts[slot]) == count and apart < slot_ns // 2), None
        )
        self._common_ns = min(starts[self.common_slot]) if self.common_slot is not None else None
        after = [slot for slot in spread if self.common_slot is not None and slot >= self.common_slot]
        self._spread = [spread[slot] for slot in after if len(starts[slot]) > 1]
        self._torn = sum(apart >= slot_ns // 2 for apart in self._spread)

    def summary(self) -> dict[str, Any]:
        """When all counted alike, and how far apart slots started then."""
        known = self._common_ns is not None and self._started
        after = (self._common_ns - max(self._started)) / 1e9 if known else None
        return {
            "common_slot": self.common_slot,
            "common_after_last_start_s": after,
            "slots_apart": self._torn,  # later ones that began half a slot apart or more
            "clock_spread_ms": {
                "mean": float(np.mean(self._spread)) / 1e6 if self._spread else None,
                "max": max(self._spread) / 1e6 if self._spread else None,
                "end": max(self._spread[-_END:]) / 1e6 if self._spread else None,
            },
        }


def _line_of_slots(
    processes: Mapping[Process, AgentBag], clocks: Mapping[Process, Clock], first: int, slot_ns: int
) -> tuple[float, float]:
    """Start of slot 0 and length of a slot, ns of common time, as a straight line through the slots' starts."""
    starts: dict[int, list[int]] = {}
    for process, bag in processes.items():
        for record in bag.slots:
            if record.slot >= first:
                starts.setdefault(record.slot, []).append(clocks[process].common_ns(record.start_ns))
    slots = np.array(sorted(starts), dtype=np.float64)
    at = np.array([float(np.median(starts[int(slot)])) for slot in slots])
    length = float(slot_ns)
    if len(slots) > 1:
        length = float(np.polyfit(slots - first, at - at[0], 1)[0])
    return float(np.median(at - length * slots)), length


def _air(
    sent: Mapping[tuple[int, int], SentDatagram], line: TimeLine, air_ns: int, common_slot: int | None
) -> dict[str, Any]:
    """Two senders in a slot, and frames that were on the air together."""
    double = [slot for slot, count in Counter(slot for slot, _ in sent).items() if count > 1]
    after = sum(common_slot is not None and slot >= common_slot for slot in double)
    at = sorted(line.clocks[s.process].common_ns(s.record.sent_ns) for s in sent.values() if s.process in line.clocks)
    return {
        "frames_sent": len(sent),
        "slots_with_two_senders": after,
        "slots_with_two_senders_before": len(double) - after,
        "overlapping_frames": sum(b - a < air_ns for a, b in pairwise(at)) if air_ns else None,
    }
