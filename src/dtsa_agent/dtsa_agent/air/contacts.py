"""Whom an agent hears, who hears it, and who is there: what datagrams say about that beside their frames.

Each datagram names some of those that its sender hears, in the order of their ids, other ones each time. An agent that
is missing between two neighbours in such a list is not heard by its sender, whatever else was lost: a loss delays what
is known, and makes up nothing. Where a datagram names one agent at a time, only silence for long tells.

Those agents are there that were heard lately, or named by others, and have not said that they leave. *Lately* ends with
the last frame that was heard at all: an agent that hears nobody any more does not come to believe that nobody is there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from dtsa_agent.core.frame import condition_in
from dtsa_agent.core.settings.config import SwarmConfig

_CYCLES = 8  # of lists of one name each, after which an agent that was not named is not heard
FOR_EVER = 1 << 40  # slots
_NAMED = 3  # cycles of names within which an agent that somebody hears is named, whatever is lost


@dataclass(frozen=True, slots=True)
class Limits:
    """For how long an agent may not be heard, slots.

    :param moving: of one that moves.
    :param resting: of one that rests or is on probation: it may speak in its main anchors only, or not at all.
    :param named: how much longer it is there, for how long it is there after somebody has named it, and for how long it
        counts that it did not name this agent.
    """

    moving: int
    resting: int
    named: int


def limits_of(config: SwarmConfig, peers: int) -> Limits:
    """For how long agents of a swarm may not be heard.

    :param config: what all agents share.
    :param peers: number of names in a datagram.
    """
    round_, row = config.agents, config.policy_row
    turn = max(2 * config.anchor_every * round_, round(0.5 / config.slot_s))
    long = max(turn, 6 * config.main_every * round_)
    if not row.extended and "received" in row.port:  # agents send by chance, and those that have arrived need not
        return Limits(long, FOR_EVER, long)
    named = _NAMED * round_ * -(-(round_ - 1) // max(1, peers - 1)) if peers else long
    return Limits(turn, long if row.extended else turn, named)


class Contact(NamedTuple):
    """How an agent stands with the others; numbers of others."""

    there: int  # that are there
    hears: int  # of these, whom it hears
    heard_by: int  # of these, who hear it, as far as they have said
    both: int  # whom it hears and who hear it


class Contacts:
    """What one agent knows of it.

    :param agents: number of agents.
    :param agent: own id.
    :param limits: for how long agents may not be heard.
    :param peers: number of names in a datagram.
    """

    def __init__(self, agents: int, agent: int, limits: Limits, peers: int) -> None:
        self._agents, self._agent, self._limits, self._peers = agents, agent, limits, peers
        self._heard: dict[int, int] = {}  # slot of the last frame, by sender
        self._named: dict[int, int] = {}  # slot in which others named one last
        self._still: dict[int, bool] = {}  # rests, or is on probation
        self._probation: dict[int, bool] = {}
        self._says: dict[int, bool] = {}  # whether it hears this agent, as far as it has said
        self._denied: dict[int, int] = {}  # slot in which it said last that it does not
        self._unnamed: dict[int, int] = {}  # its datagrams since it named this agent
        self._left: set[int] = set()
        self._seen: dict[int, int] = {}  # largest slot in a frame of its own, of whatever time
        self._last = 0  # slot of the last frame of all

    def reset(self, slot: int) -> None:
        """Another time was taken over: those that were there still are, and nothing else is known of them.

        :param slot: the present one, of the new time.
        """
        there = [agent for agent in self._heard.keys() | self._named.keys() if self._is_there(agent, False)]
        for each in (self._heard, self._named, self._still, self._probation, self._says, self._denied, self._unnamed):
            each.clear()
        self._named.update(dict.fromkeys(there, slot))
        self._last = 0

    def see(self, sender: int, slot: int, now: int) -> None:
        """A frame of another time was heard: its sender is there, unless the frame was played again.

        :param sender: id.
        :param slot: in which it says that it was sent.
        :param now: the present slot, of the own time.
        """
        if slot > self._seen.get(sender, -1):
            self._seen[sender] = slot
            if sender not in self._left:
                self._named[sender] = max(self._named.get(sender, 0), now)

    def hear(self, sender: int, slot: int, frame: bytes, names: Sequence[int]) -> None:
        """A frame was heard.

        :param sender: id.
        :param slot: in which it was sent.
        :param frame: its bytes.
        :param names: ids of whom its sender hears, as the datagram has them.
        """
        named, left = self._named, self._left
        self._last = max(self._last, slot)
        self._seen[sender] = max(self._seen.get(sender, 0), slot)
        self._heard[sender] = max(self._heard.get(sender, 0), slot)
        leaves, rests, probation = condition_in(frame)
        self._still[sender], self._probation[sender] = rests or probation, probation
        (left.add if leaves else left.discard)(sender)
        for name in names:
            if 1 <= name <= self._agents and name != self._agent and name not in left:
                named[name] = max(named.get(name, 0), slot)
        self._unnamed[sender] = self._unnamed.get(sender, 0) + 1
        says = said_of(self._agent, names, self._peers)
        if says is None and self._peers == 1 and self._unnamed[sender] > _CYCLES * (self._agents - 1):
            says = False
        if says is not None:
            self._says[sender] = says
        if says:
            self._unnamed[sender] = 0
        elif says is not None:
            self._denied[sender] = slot
            if probation:  # it is new, and has not heard all yet
                del self._says[sender]

    def _limit(self, agent: int) -> int:
        return self._limits.resting if self._still.get(agent) else self._limits.moving

    def hears(self, agent: int, slot: int) -> bool:
        """Whether an agent was heard lately, and has not left.

        :param agent: id.
        :param slot: the present one.
        """
        return agent in self._heard and agent not in self._left and slot - self._heard[agent] <= self._limit(agent)

    def _is_there(self, agent: int, strict: bool) -> bool:
        limits, last = self._limits, self._last
        if agent in self._left:
            return False
        by_frame = (limits.resting if strict else self._limit(agent)) + limits.named
        by_name = (limits.resting if strict else 0) + limits.named
        return (agent in self._heard and last - self._heard[agent] <= by_frame) or (
            agent in self._named and last - self._named[agent] <= by_name
        )

    def _says_to_hear(self, agent: int, slot: int) -> bool | None:
        """As far as it has said; what others denied long ago need not hold any more."""
        says = self._says.get(agent)
        return None if says is False and slot - self._denied[agent] > self._limits.named else says

    def count(self, slot: int, strict: bool) -> Contact:
        """How it stands with the others.

        :param slot: the present one.
        :param strict: it is new: who has not said to hear it does not; an agent on probation counts, too; and what is
            known is not forgotten so soon, because agents on probation speak, and name others, seldom.
        """
        there = hears = heard_by = both = 0
        for agent in self._heard.keys() | self._named.keys():
            if not self._is_there(agent, strict) or (self._probation.get(agent) and not strict):
                continue
            is_heard = self.hears(agent, slot)
            hears_it = self._says_to_hear(agent, slot)
            if hears_it is None:
                hears_it = not strict or not self._peers
            there += 1
            hears += is_heard
            heard_by += hears_it
            both += is_heard and hears_it
        return Contact(there, hears, heard_by, both)


def said_of(agent: int, names: Sequence[int], peers: int) -> bool | None:
    """Whether the sender of a list of names hears an agent; None: the list does not say.

    :param agent: id.
    :param names: ids, in the order of ids, the smallest after the largest.
    :param peers: number of names that fit.
    """
    if agent in names:
        return True
    if len(names) < peers:  # all whom it hears
        return False
    for before, after in pairwise(names):
        if (agent - before) & 0xFFFF < (after - before) & 0xFFFF:
            return False
    return None
