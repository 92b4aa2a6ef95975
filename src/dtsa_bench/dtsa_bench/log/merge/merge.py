"""The bags of the agents of one flight on one time line: what no single one of them could know."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from dtsa_agent.air.port import frame_in
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log.rules import Judge
from dtsa_bench.runs.hearing import of_datagrams

from .joined import AgentBag, ProcessReplay, flight_results, replay_flight
from .timeline import Crossing, Life, TimeLine, fit, named

_END = 50  # slots


class Sent(NamedTuple):
    """A frame that was handed to the network."""

    life: Life
    record: SlotRecord


class Merge:
    """Bags of one flight on one time line.

    :raises ConfigError: for bags of different swarms, two of one agent at one time, or none with a slot in it.
    """

    def __init__(self, bags: Sequence[AgentBag], nothing_written: Sequence[str] = ()) -> None:
        self.lives = _lives(bags)
        self.nothing_written = list(nothing_written)
        self.config = bags[0].swarm
        self.sent = sent_of(self.lives)
        self.unmatched, self._crossings = _crossings(self.lives, self.sent, not self.nothing_written)
        kept = [one for one in self._crossings if one.sender[1] >= 0 and one.receiver[1] >= 0]
        self.line = fit(kept, bags[0].flight_ns)
        self.apart = _apart(self.lives, self.line)
        self.turns = _Turns(self.lives, self.line, self.config.slot_ns)

    def judge(self, air_ns: int = 0) -> dict[str, Any]:
        """Judges the flight; once.

        :param air_ns: ns that a frame is on the air, to tell which overlapped there; 0: only turns are compared.
        """
        lives, line, common_slot = self.lives, self.line, self.turns.common_slot
        replays = {life: ProcessReplay(bag) for life, bag in lives.items()}
        on_line = {life: lives[life] for life in line.clocks}
        flown = flight_results(
            replay_flight(on_line, replays, senders_of(lives, self.sent), common_slot)
        )
        for life in lives.keys() - on_line.keys():  # slots of its own, which are nobody else's
            for record in lives[life].slots:
                replays[life].step(record)
        here = {agent for agent, _ in lives}
        refused: Counter[str] = sum((bag.refused for bag in lives.values()), Counter())
        slots = max(len(bag.slots) for bag in lives.values())
        heard = sum(len(record.before) + len(record.heard) for bag in lives.values() for record in bag.slots)
        hearing = of_datagrams(len(here), slots, len(self.sent), heard, refused)
        return {
            "bags": sum(number >= 0 for _, number in lives),
            "slots_of_times_given_up": sum(len(bag.slots) for (_, number), bag in lives.items() if number < 0),
            "missing": [agent for agent in range(1, self.config.agents + 1) if agent not in here],
            "broken_off": [named(life) for life, bag in lives.items() if bag.broken_off],
            "nothing_written": self.nothing_written,
            "not_on_the_time_line": [named(life) for life in lives if life not in line.clocks and life[1] >= 0],
            "not_determined": self.apart,
            "time_line": line.summary(),
            **self.turns.summary(),
            **_air(self.sent, line, air_ns, common_slot),
            "frames_unsent": sum(bool(r.frame and not r.datagram) for bag in lives.values() for r in bag.slots),
            "unheard": hearing.problem(refused) or None,
            "frames_heard": len(self._crossings),
            "frames_heard_not_as_sent": self.unmatched,
            "turns": judged(lives, self.sent, common_slot),
            "decisions_again": compare_decisions(lives, replays),
            "not_taken_in": {named(life): dict(bag.refused) for life, bag in lives.items() if bag.refused},
            "held_slots": {named(life): held for life, bag in lives.items() if (held := bag.summary.get("held_slots"))},
            "never_flew": [named(life) for life, bag in lives.items() if bag.summary.get("never_flew")],
            "flight": flown,
        }


def verified(summary: Mapping[str, Any]) -> bool:
    """Whether nothing in a merged flight contradicts the protocol or another bag."""
    again = summary["decisions_again"]
    # Of frames that nobody else heard nothing is known if their sender's bag was not finished.
    parts = summary["broken_off"] or summary["missing"] or summary["nothing_written"]
    kept = parts or not summary["turns"]["rules_broken"]
    told = again["equal"] == again["of"] and not summary["frames_heard_not_as_sent"]
    return bool(told and kept and not summary["not_determined"])


def clocks_apart(groups: Sequence[Sequence[str]]) -> str:
    """Says that clocks of groups cannot be compared; empty where there are none."""
    if not groups:
        return ""
    named_groups = " | ".join(", ".join(group) for group in groups)
    return f"offsets of clocks not determined: frames do not go both ways between {named_groups}"


def _lives(bags: Sequence[AgentBag]) -> dict[Life, AgentBag]:
    """The bags by agent and process."""
    if not any(bag.slots for bag in bags):
        raise ConfigError("bags", str(bags[0].path) if bags else "", "bags with a slot in them")
    found: dict[Life, AgentBag] = {}
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
    for bag in bags:  # what it flew before it took over a time with smaller numbers: lives of negative ones
        earlier = dataclasses.replace(bag, summary={}, refused=Counter())
        for slots in reversed(times[id(bag)][:-1]):
            number = -1 - sum(agent == bag.agent and number < 0 for agent, number in found)
            found[(bag.agent, number)] = dataclasses.replace(earlier, slots=slots)
    return found


def _times(bag: AgentBag) -> list[list[SlotRecord]]:
    """The slots of an agent, split where they count back: there it took over another time."""
    starts = [0, *(k for k in range(1, len(bag.slots)) if bag.slots[k].slot <= bag.slots[k - 1].slot), len(bag.slots)]
    return [bag.slots[a:b] for a, b in pairwise(starts)]


def _apart(lives: Mapping[Life, AgentBag], line: TimeLine) -> list[list[str]]:
    """The groups between which frames do not go both ways, by names; empty: it is one group.

    A process that sent nothing could not be heard: it makes no group, and is not on the time line either.
    """
    sharing = {life for group in line.groups for life in group}
    alone = [(life,) for life in lives if life not in sharing and life[1] >= 0]
    groups = [group for group in (*line.groups, *alone) if any(r.datagram for one in group for r in lives[one].slots)]
    return [[named(life) for life in group] for group in groups] if len(groups) > 1 else []


def sent_of(lives: Mapping[Life, AgentBag]) -> dict[tuple[int, int], Sent]:
    """All frames that were sent, by slot and sender."""
    return {
        (record.slot, life[0]): Sent(life, record)
        for life, bag in sorted(lives.items())
        for record in bag.slots
        if record.datagram
    }


def senders_of(lives: Mapping[Life, AgentBag], sent: Mapping[tuple[int, int], Sent]) -> Counter[int]:
    """How many are known to have sent, by slot: by their own bags, or, where these are missing, by those of others."""
    heard = {(h.slot, h.sender) for bag in lives.values() for r in bag.slots for h in (*r.before, *r.heard)}
    return Counter(slot for slot, _ in heard | sent.keys())


def compare_decisions(lives: Mapping[Life, AgentBag], replays: Mapping[Life, ProcessReplay]) -> dict[str, Any]:
    """What came of making all decisions again."""
    return {
        "equal": sum(replay.equal for replay in replays.values()),
        "of": sum(len(bag.slots) for bag in lives.values()),
        "differences": [one for replay in replays.values() for one in replay.differences],
    }


def count_unmatched_frames(
    lives: Mapping[Life, AgentBag], sent: Mapping[tuple[int, int], Sent], complete: bool, partly: Collection[int] = ()
) -> int:
    """How many frames were heard that their sender's bag does not have, or has otherwise.

    :param complete: whether all that was sent is there.
    :param partly: but for frames of these agents.
    """
    return _crossings(lives, sent, complete, partly)[0]


def _crossings(
    lives: Mapping[Life, AgentBag], sent: Mapping[tuple[int, int], Sent], complete: bool, partly: Collection[int] = ()
) -> tuple[int, list[Crossing]]:
    """How many frames were heard that their sender's bag does not have, and all others."""
    strange, found = 0, []
    whole: set[int] = set()
    if complete:
        whole = {agent for agent, _ in lives} - {agent for (agent, _), bag in lives.items() if bag.broken_off}
    earlier = sent_of({life: bag for life, bag in lives.items() if life[1] < 0})
    for receiver, bag in lives.items():
        for record in bag.slots:
            for heard in (*record.before, *record.heard):
                origin = sent.get((heard.slot, heard.sender))
                if origin is None or origin.record.datagram != heard.datagram:
                    origin = earlier.get((heard.slot, heard.sender), origin)
                if origin is not None and origin.record.datagram == heard.datagram:
                    found.append(Crossing(origin.life, receiver, origin.record.sent_ns, heard.arrival_ns))
                elif heard.sender not in partly and (origin is not None or heard.sender in whole):
                    strange += 1
    return strange, found


def judged(
    lives: Mapping[Life, AgentBag], sent: Mapping[tuple[int, int], Sent], common_slot: int | None
) -> dict[str, Any]:
    """What the protocol says of the frames that were sent, or heard, from when on all counted alike.

    :param common_slot: from which all counted alike; None: never.
    """
    config = next(iter(lives.values())).swarm
    frames: dict[int, dict[int, bytes]] = {}
    unsent: dict[int, dict[int, bytes]] = {}
    for (agent, _), bag in lives.items():
        for record in bag.slots:
            if record.frame and not record.datagram:
                unsent.setdefault(record.slot, {})[agent] = record.frame
            for heard in (*record.before, *record.heard):
                frames.setdefault(heard.slot, {})[heard.sender] = frame_in(heard.datagram, config)
    for (slot, agent), origin in sent.items():
        frames.setdefault(slot, {})[agent] = frame_in(origin.record.datagram, config)
    judge = Judge(config)
    for slot in sorted({*frames, *unsent}):
        if common_slot is not None and slot >= common_slot:
            judge.slot(slot, frames.get(slot, {}), unsent.get(slot))
    return judge.summary()


class _Turns:
    """When slots started on the common time line."""

    def __init__(self, lives: Mapping[Life, AgentBag], line: TimeLine, slot_ns: int) -> None:
        self._started = [line.clocks[life].common_ns(bag.started_ns) for life, bag in lives.items()
                         if life in line.clocks and life[1] == 0]  # fmt: skip
        on_line = {life: bag for life, bag in lives.items() if life in line.clocks and bag.slots}
        starts: dict[int, list[int]] = {}
        for life, bag in on_line.items():
            for record in bag.slots:
                starts.setdefault(record.slot, []).append(line.clocks[life].common_ns(record.start_ns))
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


def _air(sent: Mapping[tuple[int, int], Sent], line: TimeLine, air_ns: int, common_slot: int | None) -> dict[str, Any]:
    """Two senders in a slot, and frames that were on the air together."""
    double = [slot for slot, count in Counter(slot for slot, _ in sent).items() if count > 1]
    after = sum(common_slot is not None and slot >= common_slot for slot in double)
    at = sorted(line.clocks[s.life].common_ns(s.record.sent_ns) for s in sent.values() if s.life in line.clocks)
    return {
        "frames_sent": len(sent),
        "slots_with_two_senders": after,
        "slots_with_two_senders_before": len(double) - after,
        "overlapping_frames": sum(b - a < air_ns for a, b in pairwise(at)) if air_ns else None,
    }
