"""A merged flight on one time line, as its bag holds it.

Times are ns from the start of slot 0. The line is the one that :mod:`.timeline` estimates, measured in
slots of the swarm: slot i starts at i slot lengths, as in every other bag.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.air.datagram import HEADER, NETWORK, frame_in
from dtsa_agent.air.record import Heard, SlotRecord
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_bench.recordings.bag.merged import MergedFrom

from .agent_bag import AgentBag
from .merge import Merge, again, clocks_apart, judged, sent_of, strange_of
from .merged_flight import Moment, ended, fly
from .replay import Replay
from .timeline import Clock, Life, named

ZERO_NS = 1_000_000_000  # stamp of the start of slot 0
_BEFORE = 0xFFFFFFFF  # slots have 32 bits in messages


@dataclass(frozen=True, slots=True)
class OnAir:
    """A frame of an agent of which there is no record, as others have heard it."""

    sent_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class MergedRun:
    """One flight."""

    config: SwarmConfig
    common_slot: int  # first slot that all counted alike
    lives: Mapping[Life, AgentBag]
    strays: Mapping[tuple[int, int], OnAir]  # by slot and sender
    about: dict[str, Any]  # plain values

    def fly(self, replays: Mapping[Life, Replay] | None = None) -> Generator[Moment, None, dict[str, Any] | None]:
        """Makes all decisions again; see :func:`~dtsa_bench.recordings.merge.merged_flight.fly`.

        :param replays: of each process; None: new ones.
        """
        replays = replays or {life: Replay(bag) for life, bag in self.lives.items()}
        return fly(self.lives, replays, self.senders(), self.common_slot)

    def judge(self) -> dict[str, Any]:
        """Judges the flight again from what the bag holds, with the keys of :meth:`.merge.Merge.judge`."""
        sent = sent_of(self.lives)
        replays = {life: Replay(bag) for life, bag in self.lives.items()}
        flown = ended(self.fly(replays))
        # Bags of earlier versions have neither.
        nothing_written, not_determined = (self.about.get(key, []) for key in ("nothing_written", "not_determined"))
        complete = not nothing_written and not self.about["not_on_the_time_line"]
        return {
            "missing": self.about["missing"],
            "broken_off": self.about["broken_off"],
            "nothing_written": nothing_written,
            "not_determined": not_determined,
            "frames_heard_not_as_sent": self.about["frames_heard_not_as_sent"]
            + strange_of(self.lives, sent, complete, self.about.get("agents_that_gave_up_a_time", ())),
            "decisions_again": again(self.lives, replays),
            "turns": judged(self.lives, sent, self.common_slot),
            "flight": flown,
        }

    def senders(self) -> dict[int, int]:
        """How many are known to have sent, by slot."""
        counts: dict[int, int] = {}
        for slot, _ in [*sent_of(self.lives), *self.strays]:
            counts[slot] = counts.get(slot, 0) + 1
        return counts


def lay(merge: Merge, summary: Mapping[str, Any]) -> MergedRun:
    """A merged flight with the times of its bag.

    :raises ConfigError: if there is no slot that all counted alike.
    """
    first = merge.turns.common_slot
    if first is None and merge.apart:
        raise ConfigError("bags", len(merge.lives), f"bags of one flight on one time line; {clocks_apart(merge.apart)}")
    if first is None:
        raise ConfigError("bags", len(merge.lives), "bags of agents that hear each other and come to count slots alike")
    on_line = {life: bag for life, bag in merge.lives.items() if life in merge.line.clocks and bag.slots}
    zero, length = _slots(on_line, merge, first)
    slot_ns = merge.config.slot_ns

    def shown(clock: Clock) -> Callable[[int], int]:
        return lambda own_ns: round((clock.common_ns(own_ns) - zero) * slot_ns / length)

    lives = {life: _moved(bag, shown(merge.line.clocks[life])) for life, bag in on_line.items()}
    sent = sent_of(lives)
    strays: dict[tuple[int, int], OnAir] = {}
    for bag in lives.values():
        for record in bag.slots:
            for heard in (*record.before, *record.heard):
                key = heard.slot, heard.sender
                if key not in sent and key not in strays:
                    strays[key] = OnAir(
                        heard.arrival_ns - round(merge.line.flight_ns), frame_in(heard.datagram, merge.config)
                    )
    about = {
        "common_slot": first,
        "missing": summary["missing"],
        "broken_off": summary["broken_off"],
        "nothing_written": summary["nothing_written"],
        "not_on_the_time_line": summary["not_on_the_time_line"],
        "not_determined": summary["not_determined"],
        "frames_heard_not_as_sent": summary["frames_heard_not_as_sent"],
        "residual_us": summary["time_line"]["residual_us"],
        "clocks": summary["time_line"]["clocks"],
        "slot_on_the_first_clock_ns": length,
        "agents_that_gave_up_a_time": sorted({agent for agent, number in merge.lives if number < 0}),
        "processes": [_process(life, bag) for life, bag in lives.items()],
    }
    return MergedRun(merge.config, first, lives, strays, about)


def _slots(lives: Mapping[Life, AgentBag], merge: Merge, first: int) -> tuple[float, float]:
    """Start of slot 0 and length of a slot, ns of common time, as a straight line through the slots' starts."""
    starts: dict[int, list[int]] = {}
    for life, bag in lives.items():
        for record in bag.slots:
            if record.slot >= first:
                starts.setdefault(record.slot, []).append(merge.line.clocks[life].common_ns(record.start_ns))
    slots = np.array(sorted(starts), dtype=np.float64)
    at = np.array([float(np.median(starts[int(slot)])) for slot in slots])
    length = float(merge.config.slot_ns)
    if len(slots) > 1:
        length = float(np.polyfit(slots - first, at - at[0], 1)[0])
    return float(np.median(at - length * slots)), length


def _moved(bag: AgentBag, shown: Callable[[int], int]) -> AgentBag:
    """A bag whose times are those of the line."""

    def moved(record: SlotRecord) -> SlotRecord:
        def arrived(frames: Sequence[Heard]) -> list[Heard]:
            return [dataclasses.replace(heard, arrival_ns=shown(heard.arrival_ns)) for heard in frames]

        return dataclasses.replace(
            record,
            start_ns=shown(record.start_ns),
            opened_ns=shown(record.opened_ns),
            sent_ns=max(0, shown(record.sent_ns)) if record.datagram else -1,  # of slot 0 it may be a little less
            before=arrived(record.before),
            heard=arrived(record.heard),
        )

    return dataclasses.replace(bag, slots=[moved(record) for record in bag.slots])


def _process(life: Life, bag: AgentBag) -> dict[str, Any]:
    """What of a process the messages do not say."""
    present = [[r.slot, r.present] for before, r in zip([None, *bag.slots], bag.slots, strict=False)
               if r.present != (1 if before is None else before.present)]  # fmt: skip
    return {
        "agent": life[0],
        "process": named(life),
        "bag": str(bag.path),
        "first": bag.slots[0].slot,
        "last": bag.slots[-1].slot,
        "anew": [record.slot for record in bag.slots if record.anew],
        "present": present,
        "goals_told": bag.goals_told,
        "ended_in_order": bool(bag.summary),
        "broken_off": bag.broken_off,
    }


def read(found: MergedFrom, config: SwarmConfig, path: Path) -> MergedRun:
    """A merged flight from the messages of its bag.

    :raises UnusableBag: if its messages do not fit together.
    """
    try:
        return _Reader(found, config, path).run()
    except (KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
        raise UnusableBag(path, f"its reports do not fit together ({error})") from None


class _Reader:
    """Puts records of slots together."""

    def __init__(self, found: MergedFrom, config: SwarmConfig, path: Path) -> None:
        self._found, self._config, self._path = found, config, path
        self._tag = TAG_LENGTH if config.auth else 0
        self._frames = {
            (int(f.slot), int(f.agent)): OnAir(
                int(f.header.stamp.sec) * 1_000_000_000 + int(f.header.stamp.nanosec) - ZERO_NS, f.data.tobytes()
            )
            for f in found.frames
        }
        self._processes: dict[int, list[tuple[Life, dict[str, Any]]]] = {}
        self._lives: dict[Life, AgentBag] = {}
        for said in found.about["processes"]:
            before = self._processes.setdefault(int(said["agent"]), [])
            life = int(said["agent"]), len(before)
            before.append((life, said))
            summary = {"ended": True} if said["ended_in_order"] else {}
            self._lives[life] = AgentBag(
                path,
                life[0],
                config,
                NETWORK,
                0,
                summary=summary,
                broken_off=bool(said["broken_off"]),
                unsent_kept=False,
                goals_told=bool(said.get("goals_told")),
            )

    def run(self) -> MergedRun:
        for report in self._found.reports:
            self._report(report)
        sent = sent_of(self._lives)
        strays = {key: frame for key, frame in self._frames.items() if key not in sent}
        return MergedRun(self._config, self._found.first, self._lives, strays, self._found.about)

    def _report(self, said: Any) -> None:
        (agent,) = said.agent.tolist()
        slots, steps = said.slot.tolist(), int(said.steps)
        life, about = next(entry for entry in self._processes[agent] if slots[0] <= entry[1]["last"])
        taken: dict[int, list[Heard]] = {}
        for sender, slot, here, at in zip(
            *(getattr(said, f"heard_{name}").tolist() for name in ("sender", "slot", "in", "ns")), strict=True
        ):
            data = self._frames[(slot, sender)].data
            taken.setdefault(here, []).append(Heard(sender, slot, at, bytes(HEADER) + data, True))
        track = said.track.reshape(len(slots), steps, 3)
        velocity, command, goal = (getattr(said, n).reshape(len(slots), 3) for n in ("velocity", "command", "goal"))
        for row, slot in enumerate(slots):
            anew = slot in about["anew"]
            at = slot * self._config.slot_ns + int(said.offset_ns[row])
            data = self._frames[(slot, agent)].data if said.length[row] else b""
            if len(data) != int(said.length[row]):
                raise ValueError(f"slot {slot}: a frame of {len(data)} bytes, {said.length[row]} in its report")
            self._add(life, SlotRecord(
                slot, at, at, anew, _present(about["present"], slot),
                int(said.chosen[row]), int(said.reason[row]), int(said.digest[row]), float(said.score[row]),
                track[row], velocity[row], command[row], goal[row],
                data[: len(data) - self._tag], at if data else -1, bytes(HEADER) + data if data else b"",
                taken.pop((slot - 1) & _BEFORE, []) if anew else [], taken.pop(slot, []),
            ))  # fmt: skip
        if taken:
            raise ValueError(f"cf{agent} has heard frames in slots {sorted(taken)} of which it says nothing")

    def _add(self, life: Life, record: SlotRecord) -> None:
        slots = self._lives[life].slots
        if slots and record.slot <= slots[-1].slot:
            raise ValueError(f"slot {record.slot} of cf{life[0]} comes after slot {slots[-1].slot}")
        slots.append(record)


def _present(changes: Sequence[Sequence[int]], slot: int) -> int:
    """Whether an agent took part in a slot, or was leaving."""
    return int(next((value for since, value in reversed(changes) if since <= slot), 1))
