"""What an agent did in a slot, for whoever keeps a record of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from dtsa_agent.core.swarm import Floats


@dataclass(frozen=True, slots=True)
class Heard:
    """A frame of another agent that was heard in time."""

    sender: int  # id
    slot: int  # in which it was sent
    arrival_ns: int  # own clock
    datagram: bytes  # as it was on the air
    accepted: bool  # whether the tables took it


@dataclass(slots=True)
class SlotRecord:
    """One slot of one agent. Times are ns of its own clock."""

    slot: int
    start_ns: int  # when it started, as the agent knew when it opened it
    opened_ns: int  # when it was decided
    anew: bool  # the agent began with this slot, or began anew, knowing nothing
    present: int  # 1; 2: it is leaving
    chosen: int  # id taken for the sender, 0: nobody
    reason: int  # index into REASONS
    digest: int  # of the agent's table
    score: float
    track: Floats  # (S, 3) m, frame map: true positions at the control instants of the slot before
    velocity: Floats  # (3,) m/s, at the start
    command: Floats  # (3,) m/s, at the start
    goal: Floats  # (3,) m
    frame: bytes = b""  # what it was to send, without a tag; empty: silent
    sent_ns: int = -1  # when that was handed to the network; -1: not at all
    datagram: bytes = b""  # as on the air; empty: nothing was sent
    before: list[Heard] = field(default_factory=list)  # heard since it began anew, before this first slot
    heard: list[Heard] = field(default_factory=list)  # while this slot was open, in this order


class Watcher(Protocol):
    """Who is told what an agent does."""

    def slot(self, record: SlotRecord) -> None:
        """A slot is over.

        :param record: all of it; the watcher may keep it.
        """

    def other(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """A datagram has not been taken in.

        :param reason: why.
        :param data: the datagram, its first 512 bytes.
        :param arrival_ns: ns, own clock.
        """
