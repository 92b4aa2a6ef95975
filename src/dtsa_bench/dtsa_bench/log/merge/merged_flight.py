"""A merged flight as its agents' records, and what these agents knew.

Times are ns from the start of slot 0, on the line that :mod:`.timeline` estimates.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.air.port import NETWORK
from dtsa_agent.air.record import ReceivedFrame, SlotRecord
from dtsa_agent.core import SwarmConfig
from dtsa_bench.log.ages import Ages, ObservedPairs
from dtsa_bench.log.arrays import NEW, PRESENT, FlightArrays
from dtsa_bench.log.bag.errors import UnusableBag

from .joined import AgentBag, JoinedSlot, ProcessReplay, ReplayedFlight, flight_results, replay_flight
from .merge import compare_decisions, count_unmatched_frames, judged, sent_of
from .timeline import Life


@dataclass(frozen=True, slots=True)
class FrameOfOther:
    """A frame of an agent of which there is no record, as others have heard it."""

    sent_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class MergedFlight:
    """One flight."""

    config: SwarmConfig
    common_slot: int  # first slot that all counted alike
    lives: Mapping[Life, AgentBag]
    strays: Mapping[tuple[int, int], FrameOfOther]  # by slot and sender
    about: dict[str, Any]  # plain values

    def replay(self) -> Generator[JoinedSlot, None, dict[str, Any] | None]:
        """Replay all agents; see :func:`.joined.replay_flight`."""
        replays = {life: ProcessReplay(bag) for life, bag in self.lives.items()}
        return replay_flight(self.lives, replays, self.senders(), self.common_slot)

    def judge(self) -> dict[str, Any]:
        """Judge the flight again from what the log holds, with the keys of :meth:`.merge.Merge.judge`."""
        sent = sent_of(self.lives)
        replays = {life: ProcessReplay(bag) for life, bag in self.lives.items()}
        flown = flight_results(replay_flight(self.lives, replays, self.senders(), self.common_slot))
        complete = not self.about["nothing_written"] and not self.about["not_on_the_time_line"]
        gave_up = self.about.get("agents_that_gave_up_a_time", ())
        unmatched = count_unmatched_frames(self.lives, sent, complete, gave_up)
        return {
            **{name: self.about[name] for name in ("missing", "broken_off", "nothing_written", "not_determined")},
            "frames_heard_not_as_sent": self.about["frames_heard_not_as_sent"] + unmatched,
            "decisions_again": compare_decisions(self.lives, replays),
            "turns": judged(self.lives, sent, self.common_slot),
            "flight": flown,
        }

    def senders(self) -> dict[int, int]:
        """How many are known to have sent, by slot."""
        counts: dict[int, int] = {}
        for slot, _ in [*sent_of(self.lives), *self.strays]:
            counts[slot] = counts.get(slot, 0) + 1
        return counts


def from_log(log: FlightArrays) -> MergedFlight:
    """A merged flight from its log.

    :raises UnusableBag: if what it was merged from does not fit its records.
    """
    assert log.merged is not None
    config = log.config.swarm
    lives: dict[Life, AgentBag] = {}
    frames: dict[tuple[int, int], FrameOfOther] = {}
    parts = [part for part in (log.earlier, log) if part is not None]
    try:
        for about in log.merged["processes"]:
            agent = int(about["agent"])
            life = agent, sum(other == agent for other, _ in lives)
            summary = {"ended": True} if about["ended_in_order"] else {}
            bag = AgentBag(
                log.file or Path(log.name), agent, config, NETWORK, 0, summary=summary,
                broken_off=bool(about["broken_off"]), goals_told=bool(about["goals_told"]),
            )  # fmt: skip
            for part in parts:
                bag.slots += _slots_of(part, agent, int(about["first"]), int(about["last"]))
            lives[life] = bag
        for part in parts:
            sent = part.sent_frames
            for row, sender, data in zip(sent.row.tolist(), sent.sender.tolist(), sent.data, strict=True):
                if not part.known[row, sender - 1] and part.sent_ns is not None:
                    at_ns = int(part.start_ns[row] + part.sent_ns[row, sender - 1])
                    frames[row + part.first_slot, sender] = FrameOfOther(at_ns, data)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise UnusableBag(log.file or log.name, f"its records do not fit together ({error})") from None
    return MergedFlight(config, int(log.merged["common_slot"]), lives, frames, log.merged)


def _slots_of(log: FlightArrays, agent: int, first: int, last: int) -> Iterator[SlotRecord]:
    """The records of one agent between two slots."""
    column, heard = agent - 1, log.heard
    entries: dict[int, list[int]] = {}
    if heard is not None:
        for k in np.flatnonzero(heard.by[:, column]).tolist():
            entries.setdefault(int(heard.row[k]), []).append(k)
    for row in range(max(0, first - log.first_slot), min(len(log), last - log.first_slot + 1)):
        if not log.known[row, column]:
            continue
        data = log.frame(row, agent)
        at = int(log.start_ns[row] + log.offset_ns[row, column])
        presence = PRESENT if log.presence is None else int(log.presence[row, column])
        taken_in: tuple[list[ReceivedFrame], list[ReceivedFrame]] = [], []
        if heard is not None:
            for k in entries.get(row, []):
                one = ReceivedFrame(int(heard.sender[k]), int(heard.slot[k]), int(heard.time_ns[k]), heard.data[k], True)
                taken_in[0 if heard.before[k] else 1].append(one)
        yield SlotRecord(
            row + log.first_slot, at, at, bool(presence & NEW), presence & ~NEW, int(log.chosen[row, column]),
            int(log.reason[row, column]), int(log.digest[row, column]), float(log.score[row, column]),
            log.track[row, :, :, column], log.velocity[row, :, column], log.command[row, :, column],
            log.goal[row, :, column], sent_ns=at if data else -1, datagram=data, before=taken_in[0], heard=taken_in[1],
        )  # fmt: skip


def follow_merged(log: FlightArrays) -> tuple[Ages, dict[str, Any], list[str]]:
    """What the agents of a merged flight knew, and its results, by replaying all of them."""
    flight = from_log(log)
    ages, replayed = Ages.empty(len(log), log.agents), ReplayedFlight(flight.replay())
    for joined in replayed:
        row = joined.slot - log.first_slot
        if row >= len(log):
            continue  # a bag of which a part is lost
        counted, age, error = _pairs(joined)
        ages.results[row] = joined.results
        ages.put(row, counted & joined.counted, age, error)
    return ages, replayed.results or {}, merged_notes(flight.about, np.flatnonzero(ages.results))


def observed_merged(log: FlightArrays) -> Iterator[ObservedPairs]:
    """What each observer of a merged flight knew, slot by slot; only those of which there is a record."""
    for joined in from_log(log).replay():
        row, tables = joined.slot - log.first_slot, joined.tables
        if row >= len(log):
            continue
        expected, age, error = _pairs(joined)
        known = (tables.sent_slot >= 0) & log.known[row][tables.observer][:, None]
        known[np.arange(len(known)), tables.observer] = False
        at, column = np.nonzero(known)
        counted = expected & joined.counted & joined.results
        observers = tables.observer[at] + 1
        yield ObservedPairs(row, observers, column + 1, age[at, column], error[at, column], counted[at, column])


def _pairs(joined: JoinedSlot) -> tuple[Any, Any, Any]:
    """What each observer knows of each agent: whether it expects it to move, age (slots), error (m; NaN: not known)."""
    tables = joined.tables
    counted = (tables.in_ap != 0) & (tables.sent_slot >= 0)
    counted[np.arange(len(counted)), tables.observer] = False
    gap = np.sqrt(((tables.estimate_position - joined.position) ** 2).sum(axis=1))
    return counted, joined.slot - tables.sent_slot, gap


def merged_notes(about: Mapping[str, Any], results: Any) -> list[str]:
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
            f"Results are those of slots {results[0]} to {results[-1]}: from when nobody was on probation until "
            "the first agent ended. Completion time counts from there."
        )
    else:
        notes.append("There are no results: at no time had all been heard, with nobody on probation.")
    return notes
