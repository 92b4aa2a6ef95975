"""TDMA of other kinds: self-organised as that of ships (AIS), and triggered by events."""

from __future__ import annotations

import math

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.plugins import Table
from dtsa_agent.core.swarm import SlotOutcome

from .knowledge import has_arrived

_TIMEOUTS = (3, 8)  # frames of reports a slot is kept for: drawn from 3 to 7
_LEAST = 4  # slots to choose from, even if some are in use
_SELECTION = 0.2  # of the nominal increment


class Sotdma:
    """Each frame announces when its sender comes next and for how long it will keep that rhythm (ITU-R M.1371).

    Time has frames of L slots, one report of each agent in each. An agent listens to one frame, then enters with a slot
    drawn from free ones near its nominal one, and keeps it for 3 to 7 frames; the last report announces another one,
    within 0.2 L. Three own bytes: reports left, and offset to the next one. Collisions end with the slot's time-out.

    Options: ``sotdma.load`` (0.5), N / L. ``sotdma.entry`` (0), 1: the first report is sent by random access (RATDMA)
    in one of four free slots from a random one of the second frame on, with probability 1/4, 1/2, 3/4, 1 (assumed).
    ``sotdma.reuse`` (0), 1: an agent that finds no free slot near the nominal one takes that of the agent farthest away
    instead of looking farther afield, as STDMA of vehicles does.
    """

    options = ("entry", "load", "reuse")
    own_bytes = 3
    may_join = True

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        load = min(1.0, max(0.01, config.options.get("sotdma.load", 0.5)))
        self._frame = max(2, math.ceil(config.agents / load))  # L, slots
        self._agent = agent
        self._random = np.random.default_rng([config.seed, 1371, agent])
        self._taken: dict[int, int] = {}  # slot number -> id that has announced it
        self._next = -1  # own next slot; -1: not entered yet
        self._left = 0  # reports left in it
        self._offset = 0  # announced in the present frame: slots to the next report
        self._by_random_access = config.options.get("sotdma.entry", 0.0) > 0.0
        self._reuses = config.options.get("sotdma.reuse", 0.0) > 0.0
        self._begin = -1  # from this slot on the first report may be sent; -1: not drawn yet
        self._passed = 0  # free slots since then

    def choose(self, table: Table, slot: int) -> int:
        """Itself in its own slots; else who has announced this one."""
        if self._agent and self._next < 0 and slot >= self._frame:
            if self._by_random_access:
                self._enter(slot)
            else:
                self._next = self._draw(table, slot + (self._agent * self._frame) // table.config.agents, slot)
                self._left = int(self._random.integers(*_TIMEOUTS))
        if slot == self._next and self._agent:
            return self._agent
        return self._taken.get(slot, 0)

    def _enter(self, slot: int) -> None:
        """Sends the first report by random access, as soon as a draw says so."""
        if self._begin < 0:
            self._begin = slot + int(self._random.integers(self._frame))
        late = slot >= self._begin + 2 * self._frame  # there may be no free slot at all
        if slot < self._begin or (slot in self._taken and not late):
            return
        self._passed += 1
        if late or self._random.random() < self._passed / _LEAST:
            self._next = slot

    def _draw(self, table: Table, nominal: int, now: int) -> int:
        """A slot around a nominal one, free if there are free ones near it, or if slots are not reused."""
        reach = max(1, round(_SELECTION * self._frame / 2))
        while True:
            around = list(range(max(now + 1, nominal - reach), nominal + reach + 1))
            free = [slot for slot in around if slot not in self._taken]
            if len(free) >= _LEAST or 2 * reach >= self._frame:
                return int(self._random.choice(free or around))
            if self._reuses and around:
                return int(self._random.choice(free)) if free else self._farthest(table, around)
            reach += 1

    def _farthest(self, table: Table, slots: list[int]) -> int:
        """The slot whose owner was farthest away when it was heard last; the first of equal ones."""
        own = table.sent_position[:, [self._agent - 1]]
        owners = [self._taken[slot] - 1 for slot in slots]
        away = ((table.sent_position[:, owners] - own) ** 2).sum(axis=0)
        return slots[int(away.argmax())]

    def own_data(self, table: Table, slot: int) -> bytes:
        """Frames left, and the offset to the next report."""
        if self._left:
            self._offset = self._frame
        else:
            self._offset = self._draw(table, slot + self._frame, slot) - slot
        return bytes((self._left, *self._offset.to_bytes(2, "little")))

    def receive_data(self, table: Table, slot: int, sender: int, data: bytes) -> None:
        """Notes when the sender comes again, as far as it has said."""
        left, offset = data[0], int.from_bytes(data[1:], "little")
        if not 1 <= offset <= 2 * self._frame or left >= _TIMEOUTS[1]:
            return
        self._taken[slot + offset] = sender
        for report in range(2, left + 1):
            self._taken[slot + report * offset] = sender

    def slot_over(self, table: Table, slot: int, outcome: SlotOutcome) -> None:
        """Goes on to the next own slot; what is over is forgotten."""
        self._taken.pop(slot, None)
        if slot != self._next:
            return
        self._next = slot + self._offset
        self._left = self._left - 1 if self._left else int(self._random.integers(*_TIMEOUTS))


class EventTdma:
    """TDMA in which the owner is silent while its last frame, moved on, is right to within some distance.

    After the wireless control bus, arXiv 2101.10961. Options: ``event-tdma.error_m`` (0.05), ``event-tdma.rounds`` (10:
    the longest silence).
    """

    options = ("error_m", "rounds")
    may_join = True

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        self._agents, self._agent, self._slot_s = config.agents, agent, config.slot_s
        self._r_min = config.r_min
        self._hold = config.estimator == "hold"
        self._error = config.options.get("event-tdma.error_m", 0.05)
        self._silence = config.options.get("event-tdma.rounds", 10.0) * config.agents

    def choose(self, table: Table, slot: int) -> int:
        """The owner; who is the owner and has nothing to say, nobody."""
        owner = slot % self._agents + 1
        return owner if owner != self._agent or self._must_send(table, slot) else 0

    def _must_send(self, table: Table, slot: int) -> bool:
        own = self._agent - 1
        sent = int(table.sent_slot[own])
        if sent < 0 or slot - sent >= self._silence:
            return True
        if has_arrived(table, self._r_min) == bool(table.in_ap[own]):
            return True  # has set out, or has arrived, and not said so yet
        moved = table.sent_position[:, own]
        if not self._hold:
            moved = moved + table.sent_velocity[:, own] * ((slot - sent) * self._slot_s)
        assert table.own_position is not None
        return math.dist(table.own_position, moved) > self._error
