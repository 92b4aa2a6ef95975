"""The bags of the agents of one flight on one time line: what no single one of them could know."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.air.port import flight_ns, frame_in
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log.agent_bag import AgentBag
from dtsa_bench.log.arrays import DECIDED, UNKNOWN, VECTORS, FlightArrays, ReceivedFrames, empty_arrays, split_log
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.merged_flight import MergedReplay, check_rules, run_of
from dtsa_bench.log.rules import RuleChecker
from dtsa_bench.runs.delivery import counts_of_datagrams
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .timeline import Clock, Crossings, Process, TimeLine, fit, process_name

_END = 50  # slots
_SECTIONS = ("swarm", "limits", "mode")  # of the configuration: there is no simulated channel, and no simulated clocks

Processes = Mapping[Process, AgentBag]
ToCommon = Callable[[NDArray[np.int64]], NDArray[np.int64]]  # times of a process's own clock to the common line, ns


class SentDatagram(NamedTuple):
    """A datagram that was handed to the network."""

    process: Process
    sent_ns: int  # own clock
    data: bytes


SentDatagrams = Mapping[tuple[int, int], Sequence[SentDatagram]]  # by slot and sender: of all processes of the agent


class Merge:
    """Bags of one flight on one time line.

    :raises ConfigError: for bags of different swarms, two of one agent at one time, or none with a slot in it.
    """

    def __init__(self, bags: Sequence[AgentBag], nothing_written: Sequence[str] = ()) -> None:
        self.processes = _processes(bags)
        self.nothing_written = list(nothing_written)
        self.config = bags[0].swarm
        self.sent = _sent_datagrams(self.processes)
        self.heard_count, self.unmatched, crossings = _crossings(self.processes, self.sent, not self.nothing_written)
        self.line = fit(sorted(self.processes), crossings, flight_ns(self.config, bags[0].port))
        self.apart = _groups_apart(self.processes, self.line)
        self._starts = _SlotStarts(self.processes, self.line.clocks, self.config.slot_ns)

    @cached_property
    def log(self) -> FlightLog:
        """The flight as one log: slots and times of the common line; slot 0 is the first that all counted alike.

        :raises ConfigError: if there is no such slot, or most slots are missing.
        """
        starts, clocks = self._starts, self.line.clocks
        if starts.common_slot is None and len(self.processes) == 1:  # there is nothing to compare the one clock with
            ((process, bag),) = self.processes.items()
            clocks = {process: Clock(int(bag.log.start_ns[0]), 0.0, 0.0)}
            starts = _SlotStarts(self.processes, clocks, self.config.slot_ns)
        if starts.common_slot is None:
            why = "bags of agents that hear each other and come to count slots alike"
            if self.apart:
                why = f"bags of one flight on one time line; {clocks_apart(self.apart)}"
            raise ConfigError("bags", len(self.processes), why)
        zero_ns, slot_ns = starts.line()
        summary = self.line.summary()
        about = {
            **self._about_bags(clocks),
            "frames_heard_not_as_sent": self.unmatched,
            "residual_us": {name: value or 0.0 for name, value in summary["residual_us"].items()},
            "clocks": summary["clocks"],
            "agents_that_gave_up_a_time": sorted({agent for agent, number in self.processes if number < 0}),
        }
        on_line = {process: self.processes[process] for process in clocks if len(self.processes[process].log)}

        def to_common(clock: Clock) -> ToCommon:
            return lambda own_ns: np.rint(
                (clock.common_ns(own_ns) - zero_ns) * self.config.slot_ns / slot_ns
            ).astype(np.int64)  # fmt: skip

        times = {process: to_common(clocks[process]) for process in on_line}
        return _join(on_line, times, starts.common_slot, round(self.line.flight_ns), about)

    def _about_bags(self, clocks: Mapping[Process, Clock]) -> dict[str, Any]:
        here = {agent for agent, _ in self.processes}
        return {
            "missing": [agent for agent in range(1, self.config.agents + 1) if agent not in here],
            "broken_off": [process_name(process) for process, bag in self.processes.items() if bag.broken_off],
            "nothing_written": self.nothing_written,
            "not_on_the_time_line": [process_name(one) for one in self.processes if one not in clocks and one[1] >= 0],
            "not_determined": self.apart,
        }

    def summary(self) -> dict[str, Any]:
        """What came of the flight, and whether all decisions follow from what each agent heard, as plain values."""
        processes, line, common = self.processes, self.line, self._starts.common_slot
        joined = None if common is None else MergedReplay(self.log).run()
        alone = [
            MergedReplay(_log_alone(process, bag)).run()  # slots of its own, which are nobody else's
            for process, bag in processes.items()
            if len(bag.log) and (common is None or process not in line.clocks)
        ]
        replays = [*([joined] if joined else []), *alone]
        refused: Counter[str] = sum((bag.refused for bag in processes.values()), Counter())
        lengths, here = [len(bag.slots) for bag in processes.values()], {agent for agent, _ in processes}
        heard = sum(len(bag.heard.row) for bag in processes.values())
        sent = [(slot, one.process) for (slot, _), datagrams in self.sent.items() for one in datagrams]
        delivery = counts_of_datagrams(len(here), max(lengths), len(sent), heard, refused)
        senders = Counter(slot for slot, (_, number) in sent if number >= 0)  # others are slots of another time
        double = [slot for slot, count in senders.items() if count > 1]
        after = sum(common is not None and slot >= common for slot in double)
        held = {process_name(process): bag.summary.get("held_slots") for process, bag in processes.items()}
        rules = check_rules(self.log, joined.unsent) if joined else RuleChecker(self.config)
        return {
            "bags": sum(number >= 0 for _, number in processes),
            "slots_of_times_given_up": sum(lengths[k] for k, (_, number) in enumerate(processes) if number < 0),
            **self._about_bags(line.clocks),
            "time_line": line.summary(),
            **self._starts.summary(),
            "frames_sent": len(sent),
            "slots_with_two_senders": after,
            "slots_with_two_senders_before": len(double) - after,
            "frames_unsent": sum(len(replay.unsent) for replay in replays),
            "unheard": delivery.problem(refused) or None,
            "frames_heard": self.heard_count,
            "frames_heard_not_as_sent": self.unmatched,
            "turns": rules.summary(),
            "decisions_again": {
                "equal": sum(replay.equal for replay in replays),
                "of": sum(lengths),
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
    named_groups = " | ".join(", ".join(map(str, group)) for group in groups)
    return f"offsets of clocks not determined: frames do not go both ways between {named_groups}"


# -- processes and what they share -----------------------------------------------------------------------------------
def _processes(bags: Sequence[AgentBag]) -> dict[Process, AgentBag]:
    """The bags by agent and process."""
    if not any(len(bag.log) for bag in bags):
        raise ConfigError("bags", str(bags[0].path) if bags else "", "bags with a slot in them")
    found: dict[Process, AgentBag] = {}
    for bag in sorted(bags, key=lambda bag: (bag.agent, bag.log.first_slot if len(bag.log) else -1)):
        if bag.swarm != bags[0].swarm:
            theirs, ours = bag.swarm.to_dict(), bags[0].swarm.to_dict()
            other = ", ".join(
                f"{name} {theirs[name]}, there {ours[name]}" for name in ours if theirs[name] != ours[name]
            )
            raise ConfigError("bag", str(bag.path), f"one of the same flight as {bags[0].path}: {other}")
        number = sum(agent == bag.agent for agent, _ in found)
        before = found.get((bag.agent, number - 1))
        if before is not None and bag.log.first_slot < before.log.first_slot + len(before.log):
            raise ConfigError("bag", str(bag.path), f"one process of cf{bag.agent} at a time: {before.path} is another")
        found[(bag.agent, number)] = bag
    for bag in bags:  # what it flew before it took over another time: processes of negative numbers
        for log in reversed(bag.earlier):
            number = -1 - sum(agent == bag.agent and number < 0 for agent, number in found)
            found[(bag.agent, number)] = dataclasses.replace(bag, log=log, summary={}, refused=Counter())
    return found


def _groups_apart(processes: Processes, line: TimeLine) -> list[list[str]]:
    """The groups between which frames do not go both ways, by names; empty: it is one group.

    A process that sent nothing could not be heard: it makes no group, and is not on the time line either.
    """
    sharing = {process for group in line.groups for process in group}
    alone = [(process,) for process in processes if process not in sharing and process[1] >= 0]
    groups = [group for group in (*line.groups, *alone) if any(processes[one].log.sent.any() for one in group)]
    return [[process_name(process) for process in group] for group in groups] if len(groups) > 1 else []


def _sent_datagrams(processes: Processes) -> SentDatagrams:
    """All datagrams that were sent."""
    sent: dict[tuple[int, int], list[SentDatagram]] = {}
    for process, bag in processes.items():
        frames = bag.log.sent_frames
        for row, sent_ns, data in zip(frames.row.tolist(), bag.sent_ns.tolist(), frames.data, strict=True):
            sent.setdefault((bag.log.first_slot + row, process[0]), []).append(SentDatagram(process, sent_ns, data))
    return sent


def _crossings(processes: Processes, sent: SentDatagrams, complete: bool) -> tuple[int, int, Crossings]:
    """How many frames were heard as they were sent, how many their sender's bag does not have, and those of one time.

    :param complete: whether all that was sent is there.
    """
    whole = {agent for agent, _ in processes} - {agent for (agent, _), bag in processes.items() if bag.broken_off}
    numbers = {process: k for k, process in enumerate(sorted(processes))}
    count = unmatched = 0
    rows: list[tuple[int, int, int, int]] = []
    for receiver, bag in processes.items():
        heard = bag.heard
        columns = heard.slot.tolist(), heard.sender.tolist(), heard.time_ns.tolist(), heard.data
        for slot, sender, arrival_ns, data in zip(*columns, strict=True):
            sent_then = sent.get((slot, sender), ())
            origin = next((datagram for datagram in sent_then if datagram.data == data), None)
            if origin is None:
                unmatched += bool(sent_then) or (complete and sender in whole)
                continue
            count += 1
            if origin.process[1] >= 0 and receiver[1] >= 0:
                rows.append((numbers[origin.process], numbers[receiver], origin.sent_ns, arrival_ns))
    return count, unmatched, Crossings(*np.array(rows, np.int64).reshape(-1, 4).T)


class _SlotStarts:
    """When slots started on the common time line."""

    def __init__(self, processes: Processes, clocks: Mapping[Process, Clock], slot_ns: int) -> None:
        self._slot_ns = slot_ns
        on_line = [(process, clocks[process], bag) for process, bag in processes.items() if process in clocks]
        starts = [(bag.slots, clock.common_ns(bag.log.start_ns[bag.log.recorded])) for _, clock, bag in on_line]
        first = [int(clock.common_ns(bag.started_ns)) for process, clock, bag in on_line if process[1] == 0]
        self._started_ns = max(first, default=None)
        self._slot = np.unique(np.concatenate([np.zeros(0, np.int64), *(slots for slots, _ in starts)]))
        self._zero_ns = min((int(at_ns.min()) for _, at_ns in starts if len(at_ns)), default=0)
        # (slots, processes) from `_zero_ns` on; not a number: the process had no such slot
        at = self._at_ns = np.full((len(self._slot), len(starts)), np.nan)
        for column, (slots, at_ns) in enumerate(starts):
            at[np.searchsorted(self._slot, slots), column] = at_ns - self._zero_ns
        count = np.isfinite(at).sum(axis=1)
        self._spread_ns = np.nanmax(at, axis=1, initial=-np.inf) - np.nanmin(at, axis=1, initial=np.inf)
        alike = (count == count.max(initial=0)) & (self._spread_ns < slot_ns // 2)
        #: First slot in which as many as ever are there and count alike.
        self.common_slot = int(self._slot[np.argmax(alike)]) if alike.any() else None
        self._shared = (count > 1) & alike.any() & (self._slot >= (self.common_slot or 0))

    def summary(self) -> dict[str, Any]:
        """When all counted alike, and how far apart slots started then."""
        spread, after_s = self._spread_ns[self._shared], None
        if self.common_slot is not None and self._started_ns is not None:
            common = self._at_ns[np.searchsorted(self._slot, self.common_slot)]
            after_s = (int(np.nanmin(common)) + self._zero_ns - self._started_ns) / 1e9
        return {
            "common_slot": self.common_slot,
            "common_after_last_start_s": after_s,
            "slots_apart": int((spread >= self._slot_ns // 2).sum()),  # later ones that began half a slot apart or more
            "clock_spread_ms": {
                "mean": float(spread.mean()) / 1e6 if len(spread) else None,
                "max": float(spread.max()) / 1e6 if len(spread) else None,
                "end": float(spread[-_END:].max()) / 1e6 if len(spread) else None,
            },
        }

    def line(self) -> tuple[float, float]:
        """Start of slot 0 and length of a slot, ns of common time, as a straight line through the slots' starts."""
        later = self._slot >= (self.common_slot or 0)
        slots, at = self._slot[later].astype(np.float64), np.nanmedian(self._at_ns[later], axis=1) + self._zero_ns
        length = float(self._slot_ns)
        if len(slots) > 1:
            length = float(np.polyfit(slots - slots[0], at - at[0], 1)[0])
        return float(np.median(at - length * slots)), length


# -- one log ---------------------------------------------------------------------------------------------------------
def _log_alone(process: Process, bag: AgentBag) -> FlightLog:
    """The log of a process that shares no time line with others."""
    nothing: dict[str, Any] = {"missing": [], "broken_off": [], "nothing_written": [], "not_on_the_time_line": []}
    return _join({process: bag}, {process: np.copy}, bag.log.first_slot, 0, nothing)


def _join(
    processes: Processes, times: Mapping[Process, ToCommon], common_slot: int, under_way_ns: int,
    about: Mapping[str, Any],
) -> FlightLog:  # fmt: skip
    """The log of a flight of which these are the agents' records.

    :param common_slot: the first slot that all counted alike, slot 0 of the log.
    :param under_way_ns: from the order to send a frame to its arrival.
    :param about: what to know of the bags, as plain values.
    :raises ConfigError: if most slots are missing.
    """
    config = next(iter(processes.values())).swarm
    first = min(bag.log.first_slot for bag in processes.values())
    last = max(bag.log.first_slot + len(bag.log) for bag in processes.values()) - 1
    recorded = len(np.unique(np.concatenate([bag.slots for bag in processes.values()])))
    arrays = empty_arrays(last - first + 1, recorded, config.agents, config.steps, config.slot_ns)
    arrays["start_ns"] += first * config.slot_ns
    arrays["recorded"][:] = True
    frames: dict[tuple[int, int], tuple[int, bytes]] = {}  # by row and sender: when, and what
    heard: list[ReceivedFrames] = []
    for process, bag in sorted(processes.items()):
        log, sent, received = bag.log, bag.log.sent_frames, bag.heard
        own, column, offset = np.flatnonzero(log.known), process[0] - 1, log.first_slot - first
        start_ns, sent_ns = times[process](log.start_ns), np.maximum(0, times[process](bag.sent_ns))
        start_ns[sent.row] = sent_ns
        arrays["known"][own + offset, column] = True
        arrays["offset_ns"][own + offset, column] = start_ns[own] - arrays["start_ns"][own + offset]
        for name in (*DECIDED, *VECTORS, "presence", "track"):
            arrays[name][own + offset, ..., column] = getattr(log, name)[own, ..., 0]
        for row, at_ns, data in zip((sent.row + offset).tolist(), sent_ns.tolist(), sent.data, strict=True):
            frames[row, column + 1] = at_ns, frame_in(data, config)
        heard.append(ReceivedFrames(
            received.row + offset, received.sender, received.slot, times[process](received.time_ns),
            np.repeat(np.arange(config.agents)[None] == column, len(received.row), axis=0), received.before,
            [frame_in(data, config) for data in received.data],
        ))  # fmt: skip
    taken = _sorted_by_row(heard)
    columns = taken.slot.tolist(), taken.sender.tolist(), taken.time_ns.tolist(), taken.data
    for slot, sender, arrival_ns, data in zip(*columns, strict=True):  # frames of agents of which there is no record
        if first <= slot <= last:
            frames.setdefault((slot - first, sender), (arrival_ns - under_way_ns, data))
    keys = sorted(frames)
    for row, sender in keys:
        at_ns, data = frames[row, sender]
        arrays["length"][row, sender - 1] = len(data)
        arrays["sent_ns"][row, sender - 1] = at_ns - arrays["start_ns"][row]
    settings = run_of(config).to_dict()
    log = FlightLog(
        name="", settings={name: settings[name] for name in _SECTIONS}, agents=config.agents, slot_ns=config.slot_ns,
        first_slot=first, data=b"".join([frames[key][1] for key in keys]), heard=taken, has_end=False,
        received=np.zeros((len(keys), config.agents), np.bool_),
        merged={**about, "common_slot": common_slot, "processes": [_describe(*one) for one in processes.items()]},
        **arrays,
    )  # fmt: skip
    log.received, log.lost, log.outcome = receptions_of(log)
    return split_log(log, common_slot)


def _sorted_by_row(heard: Sequence[ReceivedFrames]) -> ReceivedFrames:
    order = np.argsort(np.concatenate([one.row for one in heard]), kind="stable")
    data = [frame for one in heard for frame in one.data]
    arrays = (np.concatenate(columns)[order] for columns in list(zip(*heard, strict=True))[:-1])
    return ReceivedFrames(*arrays, [data[k] for k in order.tolist()])


def _describe(process: Process, bag: AgentBag) -> dict[str, Any]:
    """State of a process that records of slots do not carry."""
    return {
        "agent": process[0],
        "process": process_name(process),
        "bag": str(bag.path),
        "first": bag.log.first_slot,
        "last": bag.log.first_slot + len(bag.log) - 1,
        "goals_told": bag.goals_told,
        "ended_in_order": bool(bag.summary),
        "broken_off": bag.broken_off,
    }


def receptions_of(log: FlightArrays) -> tuple[NDArray[np.bool_], NDArray[np.uint16], NDArray[np.uint8]]:
    """Received, lost and outcome, as in a log: what follows from what the agents heard.

    Receivers of which there is no record are neither reached nor lost.
    """
    row, column = np.nonzero(log.length)
    frame = np.arange(len(row))
    received = np.zeros((len(row), log.agents), np.bool_)
    if log.heard is not None:
        place = np.full((len(log), log.agents), -1)
        place[row, column] = frame
        at = log.heard.slot - log.first_slot
        inside = np.flatnonzero((at >= 0) & (at < len(log)) & (log.heard.sender > 0) & (log.heard.sender <= log.agents))
        heard = place[at[inside], log.heard.sender[inside] - 1]
        np.logical_or.at(received, heard[heard >= 0], log.heard.receivers[inside[heard >= 0]])
    received[frame, column] = False
    missed = log.known[row] & ~received
    missed[frame, column] = False
    lost = np.zeros(log.length.shape, np.uint16)
    lost[row, column] = missed.sum(axis=1)
    count = log.sent.sum(axis=1)
    outcome = np.where(count > 1, COLLISION, np.where(count > 0, SUCCESS, IDLE)).astype(np.uint8)
    outcome[(count == 0) & ~log.known.all(axis=1)] = UNKNOWN
    return received, lost, outcome
