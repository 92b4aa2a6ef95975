"""Datagrams: a frame, and what its sender says about time beside it; and the settings of the stations that send them.

Layout: docs/reference/protocol.md; the same in C: ``libdtsa/station/datagram.c``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from dtsa_agent.core.frame import named_in

from .frame import LENGTHS, TAG_LENGTH, Refused, decode, tag
from .table import Rules

ACCEPTED, NOT_OURS, WRONG_LENGTH, OTHER_SETTINGS, NO_FRAME, UNKNOWN_AGENT = range(6)
REJECTED, REPEATED, OTHER_TIME, SAME_ID, TOO_EARLY = range(6, 11)  # what became of a datagram
ALL_BUT_ONE, SHARE = -1, -2
KEEPS_NOTHING, KEEPS_NUMBERS, KEEPS_STARTS = range(3)  # slots move as the rules say; a little; never
LATE_UNIT_NS = 10_000


class Link(NamedTuple):
    """What carries the datagrams; the same for all stations of a swarm."""

    header: bytes
    says_late: bool
    names: int  # heard agents that a datagram names
    flight_ns: int
    trust_ns: int


@dataclass(frozen=True, slots=True)
class Settings:
    """Of one station, beside the rules."""

    id: int
    slot_ns: int
    seed: int
    link: Link
    quorum: int = ALL_BUT_ONE
    quorum_share: float = 0.0
    key: bytes = b""
    session: int = 0
    early_count: int = 64
    begins_ns: int | None = None  # start of slot 0, where all begin together
    late_ns: int | None = None  # start of slot 0, where it listens first and hears no frame
    keeps_time: int = KEEPS_NOTHING  # whatever it hears, its slots keep their numbers
    equal_tables: bool = False  # of the policy: it waits longer for frames, and never restarts by itself


class Parsed(NamedTuple):
    """What a datagram says."""

    sender: int
    slot: int  # as on the air
    late_ns: int
    names: tuple[tuple[int, int], ...]  # id, and how much later than expected its sender hears it, ns
    frame: bytes


def parse_datagram(data: bytes, c: Settings, rules: Rules) -> Parsed | int:
    """What a datagram says, or why it says nothing."""
    link, agreed = c.link, len(c.link.header)
    head = agreed + 2 * link.says_late + 4 * link.names
    if agreed == 8 and (len(data) < 3 or data[:3] != link.header[:3]):
        return NOT_OURS
    if len(data) < agreed:
        return WRONG_LENGTH
    if data[:agreed] != link.header:
        return OTHER_SETTINGS
    if len(data) != head + LENGTHS[rules.profile] + (TAG_LENGTH if c.key else 0):
        return WRONG_LENGTH
    times, frame = data[agreed:head], data[head:]
    named = named_in(frame)
    if named is None:
        return NO_FRAME
    sender, slot = named
    if not 1 <= sender <= rules.agents:
        return UNKNOWN_AGENT
    if c.key:
        frame, code = frame[:-TAG_LENGTH], frame[-TAG_LENGTH:]
        if tag(c.key, c.session, slot, frame + times) != code:
            return REJECTED
    if slot >= rules.slot_cycle:
        return NO_FRAME
    if not c.key:
        try:
            decode(frame, rules.position_step)
        except Refused:
            return NO_FRAME
    late = int.from_bytes(times[:2], "little") * LATE_UNIT_NS if link.says_late else 0
    names = []
    for i in range(2 * link.says_late, len(times), 4):
        by = int.from_bytes(times[i + 2 : i + 4], "little", signed=True)
        names.append((int.from_bytes(times[i : i + 2], "little"), by * LATE_UNIT_NS))
    return Parsed(sender, slot, late, tuple(names), frame)


def write_datagram(c: Settings, frame: bytes, slot: int, late_ns: int, named: Sequence[tuple[int, int]]) -> bytes:
    """The datagram of a frame.

    :param slot: its number on the air.
    :param late_ns: how much later than its slot it leaves.
    :param named: ids of heard agents, and how much later than expected each is heard, ns.
    """
    times = min(max(late_ns // LATE_UNIT_NS, 0), 0xFFFF).to_bytes(2, "little") if c.link.says_late else b""
    for k, by in [*named, *[(0, 0)] * (c.link.names - len(named))]:
        units = min(max(by // LATE_UNIT_NS, -0x8000), 0x7FFF)
        times += k.to_bytes(2, "little") + units.to_bytes(2, "little", signed=True)
    code = tag(c.key, c.session, slot, frame + times) if c.key else b""
    return c.link.header + times + frame + code


def names_hear(agent: int, names: Sequence[int], most: int) -> int:
    """Whether the sender of a list of names hears an agent: 1, -1, or 0: the list does not tell."""
    if agent in names:
        return 1
    if len(names) < most:  # all whom it hears
        return -1
    return -1 if any((agent - a) & 0xFFFF < (b - a) & 0xFFFF for a, b in pairwise(names)) else 0
