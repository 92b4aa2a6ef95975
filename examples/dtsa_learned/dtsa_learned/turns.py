"""Whose turn it is, by what each agent has heard: for many flights at once in training, for one agent in a plug-in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .rules import ARRIVED, MOVER, STEPS, WAITING, Rules

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
DELAY = 3  # slots until news counts: until then it has reached nearly all
_FAILED = 5  # turns in a row without a frame, after which an agent is taken to rest
_KEPT = DELAY + 2  # slots of which is kept who sent


class Turns:
    """Turns of V observers in B flights of N agents.

    In each slot the agent with the greatest claim has its turn: slots since its last turn, times a learned rate. Each
    observer computes all claims from what it has heard. News counts :data:`DELAY` slots after it was sent: frames
    gossip the newest states, so by then nearly all have it, also those that lost the frame itself. The turns in between
    are computed anew in each slot, so observers that know the same come to the same turn, whatever they thought before.

    :param rules: (B) those of each flight.
    :param agents: number of agents N.
    :param ids: (V,) ids of the observers.
    :param quiet_until: first slot with turns other than those of owners, for an agent that came late.
    """

    def __init__(self, rules: Sequence[Rules], agents: int, ids: Sequence[int], quiet_until: int = 0) -> None:
        shape = len(rules), len(ids), agents
        self._agents, self._ids, self._quiet_until = agents, np.array(ids), quiet_until
        self._rounds = np.array([1, 4, 16]) * agents
        # Rates by flight, kind, time, share and calm, one after the other.
        self._rates = np.concatenate([one.rates.ravel() for one in rules])
        self._first = (np.arange(len(rules)) * rules[0].rates.size)[:, None]
        self._every = np.array([one.every for one in rules])[:, None]
        self._row = np.arange(len(rules) * len(ids)).reshape(shape[:2]) * agents  # where that of each observer begins
        self._own = np.arange(agents)[None, None, :] == (self._ids - 1)[None, :, None]
        self._turn = np.full(shape, -1, dtype=np.int64)  # slot of the last one
        # An agent that nobody has heard is taken for a mover. Otherwise those that lost its first frame would give its
        # turns to others, and it would collide with them for ever.
        self._moves = np.ones(shape, dtype=np.bool_)  # as it counts
        self._moved = np.zeros(shape, dtype=np.bool_)  # has been heard moving
        self._kind = np.full(shape, MOVER, dtype=np.int64)
        self._since = np.zeros(shape, dtype=np.int64)  # slot of the frame that said so
        self._news = np.full(shape, -1, dtype=np.int64)  # slot of a frame that says otherwise; -1: none
        self._woken = np.zeros(shape[:2], dtype=np.int64)  # slot of the last frame that said that somebody has set out
        self._sender = np.full((*shape[:2], _KEPT), -1, dtype=np.int64)  # index of who sent in the last slots; -1: none
        self._sent = np.full(shape, -1, dtype=np.int64)  # as before the last slot
        self._missed = np.zeros(shape, dtype=np.bool_)  # another one sent in its last turn
        self._failed = np.zeros(shape, dtype=np.int64)  # turns in a row without a frame of its own
        self._next = np.full(shape[:2], -1, dtype=np.int64)  # index of whose turn it was in the next slot that counts
        self.plan = np.zeros(shape[:2], dtype=np.int64)  # (B, V) id of the agent whose turn an observer takes it for

    def __call__(self, slot: int, sent: Ints, moves: Bools) -> Bools:
        """Which observers send in a slot.

        :param slot: the slot that begins.
        :param sent: (B, V, N) slot of the state last heard of each agent, of itself: last sent; -1: never.
        :param moves: (B, V, N) whether it moves, by that state.
        :returns: (B, V).
        """
        self._note_senders(slot, sent)
        self._count_turn(slot - 1 - DELAY)
        self._count_news(slot - 1 - DELAY, sent, moves)
        rates, turn = self._rates_now(slot), self._turn.copy()
        for then in range(max(0, slot - DELAY), slot + 1):
            plan = self._plan(then, rates, turn)
            turn.reshape(-1)[self._row + plan] = then
            if then == slot - DELAY:
                self._next = plan
        self.plan = plan + 1
        sends = self.plan == self._ids
        if slot < self._quiet_until:
            sends &= self._is_owners(slot)
        return sends

    def _note_senders(self, slot: int, sent: Ints) -> None:
        """Notes who sent in the last slots, by frames and gossip."""
        self._sender[:, :, (slot - 1) % _KEPT] = -1
        flight, observer, agent = np.nonzero((sent != self._sent) & (sent >= slot - 1 - DELAY))
        self._sender[flight, observer, sent[flight, observer, agent] % _KEPT] = agent
        self._failed[flight, observer, agent] = 0
        self._sent = sent.copy()

    def _count_turn(self, slot: int) -> None:
        """Counts the turn of a slot: of whoever sent, else of the agent that was to send.

        Where another one sent, that agent keeps its claim, but not twice in a row: it may have come to rest unheard.
        """
        if slot < 0:
            return
        planned, sender = self._next, self._sender[:, :, slot % _KEPT]
        at, turn, missed = self._row + planned, self._turn.reshape(-1), self._missed.reshape(-1)
        hears = ((self._sender >= 0) & (self._sender != self._ids[None, :, None] - 1)).any(axis=2)  # else it is deaf
        self._failed.reshape(-1)[at] += (sender != planned) & hears
        keeps = (sender >= 0) & (sender != planned) & ~missed[at]
        turn[at] = np.where(keeps, turn[at], slot)
        missed[at] = keeps

    def _count_news(self, last: int, sent: Ints, moves: Bools) -> None:
        """Takes in what frames up to a slot have said."""
        heard = sent >= 0
        self._moved |= moves & heard
        differs = (moves != self._moves) & heard
        self._news = np.where(differs, np.where(self._news < 0, sent, self._news), -1)
        counts = differs & (self._news <= last)
        if counts.any():
            self._moves ^= counts
            self._since[counts] = self._news[counts]
            self._kind[counts] = np.where(self._moves, MOVER, np.where(self._moved, ARRIVED, WAITING))[counts]
            woken = np.where(counts & self._moves, self._news, 0).max(axis=2)
            np.maximum(self._woken, woken, out=self._woken)
            self._news[counts] = -1
        np.maximum(self._turn, np.where(sent <= last, sent, -1), out=self._turn)

    def _plan(self, slot: int, rates: Ints, turn: Ints) -> Ints:
        """(B, V) index of the agent whose turn a slot is: its owner's, or that of the greatest claim."""
        n = self._agents
        if slot < n:
            return np.full(turn.shape[:2], slot)
        claimed = (rates * (slot - turn)).argmax(axis=2)
        owners = self._is_owners(slot)
        return np.where(owners, slot // self._every % n, claimed) if owners.any() else claimed

    def _is_owners(self, slot: int) -> Bools:
        return np.asarray(slot < self._agents or (slot + 1) % self._every == 0)

    def _rates_now(self, slot: int) -> Ints:
        """(B, V, N) how fast claims grow, whole numbers."""
        silent = self._failed >= _FAILED
        n, count = self._agents, (self._moves & ~silent).sum(axis=2)
        kind = np.where(silent & self._moves, ARRIVED, self._kind)
        share = (6 * count > n).astype(np.int64) + (3 * count > n) + (3 * count > 2 * n)
        of_all = self._first + STEPS * share + self._steps(slot - self._woken)
        at = STEPS**3 * kind + STEPS**2 * self._steps(slot - self._since) + of_all[:, :, None]
        return np.asarray(self._rates[at])

    def _steps(self, slots: Ints) -> Ints:
        """How long ago, in rounds of TDMA: up to 1, 4, 16, more."""
        return self._rounds.searchsorted(slots)
