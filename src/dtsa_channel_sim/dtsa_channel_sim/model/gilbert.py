"""Losses in bursts: the two-state chain of Gilbert and Elliott, addressable by slot.

A chain is good or bad in each slot. With p = P(good -> bad), r = P(bad -> good) and one uniform word u per
slot: u < p makes it bad whatever it was, u >= 1 - r makes it good whatever it was, and anything between keeps
it. So the state of a slot follows from the last word before it that decided: any slot can be looked at
without walking through all others, and slots without a frame count like any other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError

from .draws import WordBlocks, Words, threshold

Mask = NDArray[np.bool_]
Numbers = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GilbertElliott:
    """The numbers of one chain for all, or, as (N, N) arrays with row = sender, of one for each directed link.

    :param bad_share: share of slots in the bad state.
    :param enter: P(good -> bad) per slot, p.
    :param leave: P(bad -> good) per slot, r; 1 / r is the mean length of a bad phase in slots.
    """

    bad_share: float | Numbers
    enter: float | Numbers
    leave: float | Numbers

    @classmethod
    def from_means(cls, loss: float, burst_length: float, p_good: float = 0.0, p_bad: float = 1.0) -> GilbertElliott:
        """Return the chain with a given mean loss and mean length of its bad phases.

        share = (loss - p_good) / (p_bad - p_good), r = 1 / burst_length, p = r share / (1 - share). The length is at
        least 1 / (1 - share), the length of the runs that independent losses have.

        :raises ConfigError: when no such chain exists.
        """
        if p_bad <= p_good:
            raise ConfigError("p_bad", p_bad, f"a number above p_good, {p_good:g}")
        if not p_good <= loss <= p_bad:
            raise ConfigError("loss", loss, f"in bursts a number from p_good to p_bad, {p_good:g} to {p_bad:g}")
        share = (loss - p_good) / (p_bad - p_good)
        if share >= 1.0:
            return cls(1.0, 1.0, 0.0)
        shortest = 1.0 / (1.0 - share)
        if burst_length < shortest * (1.0 - 1e-12):
            raise ConfigError(
                "burst_length", burst_length, f"at a loss of {loss:g} at least {shortest:.4g} slots, or 0 for none"
            )
        leave = 1.0 / burst_length
        return cls(share, leave * share / (1.0 - share), leave)


class _Limits(NamedTuple):
    """Where words decide: scalars, or one for each receiver (N,)."""

    enter: NDArray[np.uint64]
    keep: NDArray[np.uint64]
    share: NDArray[np.uint64]

    def of(self, columns: NDArray[np.intp]) -> _Limits:
        """Those of some receivers."""
        return _Limits(*(limit[columns] for limit in self)) if self.enter.ndim else self


class Chains:
    """States of the chains of all receivers, or of all links, begun at slot 0 in their long-run mixture.

    ``factors`` has one constant per sender, indexed by id: it makes the words of its links from those of the receivers.
    """

    __slots__ = ("_block", "_end", "_factors", "_first", "_known", "_limits", "_step", "_words")

    def __init__(self, model: GilbertElliott, words: WordBlocks, factors: Sequence[np.uint64]) -> None:
        self._words = words
        self._factors = factors
        limits = _Limits(threshold(model.enter), threshold(1.0 - model.leave), threshold(model.bad_share))
        if limits.enter.ndim:
            rows = [_Limits(*row) for row in zip(*limits, strict=True)]
            self._limits = [rows[0], *rows]  # by the sender's id; index 0 is not used
        else:
            self._limits = [limits] * (words.agents + 1)
        # Enough slots to settle all links of a sender most of the time, in one look back.
        kept = float(np.max(np.maximum(0.0, 1.0 - model.leave - model.enter)))
        decay = max(-math.log(kept), 1e-9) if kept > 0.0 else 40.0
        self._step = int(min(words.rows, max(8.0, (math.log(words.agents) + 2.0) / decay)))
        self._first = self._end = 0
        self._block: Mask = np.zeros((0, words.agents), dtype=np.bool_)
        self._known: dict[int, tuple[int, Mask]] = {}

    def receivers(self, slot: int) -> Mask:
        """Return which receivers are in a bad phase, (1, N)."""
        if not self._first <= slot < self._end:
            self._fill(slot // self._words.rows)
        row = slot - self._first
        return self._block[row : row + 1]

    def links(self, slot: int, sender: int) -> Mask:
        """Return which links from one sender, an id, are in a bad phase, (1, N)."""
        # Where the last look ended, this one may end too: it saves work and changes nothing.
        floor, before = self._known.get(sender, (-1, None))
        if floor == slot and before is not None:
            return before
        if floor > slot or before is None:
            floor, before = -1, None
        bad = self._search_back(slot, self._factors[sender], self._limits[sender], floor, before)[None]
        bad.setflags(write=False)
        self._known[sender] = (slot, bad)
        return bad

    def arrays(self, senders: Sequence[int], slot: int) -> dict[str, NDArray[Any]]:
        """Return where words decide, and the phases (1: bad) in a slot, -1: before the first; rows by sender, (C, N).

        :param senders: ids; (0,) where all receivers have one chain each.
        """
        agents = self._words.agents
        limits = [self._limits[sender] for sender in senders]
        shape = len(senders), agents
        arrays = {
            name: np.array([np.broadcast_to(getattr(row, name), agents) for row in limits])
            for name in ("enter", "keep", "share")
        }
        phase = np.zeros(shape, dtype=np.uint8)
        for row, sender in enumerate(senders if slot >= 0 else ()):
            factor = self._factors[sender] if sender else np.uint64(1)
            phase[row] = self._search_back(slot, factor, limits[row], -1, None)
        return {**arrays, "phase": phase}

    def _search_back(self, slot: int, factor: np.uint64, limits: _Limits, floor: int, before: Mask | None) -> Mask:
        """Return the states (N,) in a slot, from the last word that decided, or ``before`` in ``floor``."""
        agents = self._words.agents
        bad = np.zeros(agents, dtype=np.bool_) if before is None else before[0].copy()
        todo = np.arange(agents)
        end, step = slot + 1, self._step
        while len(todo) and end > floor + 1:
            first = max(floor + 1, end - step)
            words = self._words.span(first, end)
            every = len(todo) == agents
            some = limits if every else limits.of(todo)
            value, decided = self._decide((words if every else words[:, todo]) * factor, first, some)
            last = len(words) - 1 - np.argmax(decided[::-1], axis=0)
            columns = np.arange(len(todo))
            known = decided[last, columns]
            bad[todo[known]] = value[last, columns][known]
            todo = todo[~known]
            end, step = first, min(2 * step, 4 * self._words.rows)
        return bad

    @staticmethod
    def _decide(words: Words, first: int, limits: _Limits) -> tuple[Mask, Mask]:
        """Return (bad, decided) for rows of words that begin with slot ``first``."""
        bad = words < limits.enter
        decided = bad | (words >= limits.keep)
        if first == 0:
            bad[0] = words[0] < limits.share
            decided[0] = True
        return bad, decided

    def _fill(self, number: int) -> None:
        """Work out the states of all receivers in one block of slots."""
        rows = self._words.rows
        first, end = number * rows, (number + 1) * rows
        limits = self._limits[0]
        bad, decided = self._decide(self._words.span(first, end), first, limits)
        if first > 0:
            if first == self._end:
                before = self._block[-1]
            else:
                before = self._search_back(first - 1, np.uint64(1), limits, -1, None)
            bad[0] = np.where(decided[0], bad[0], before)
            decided[0] = True
        last = np.where(decided, np.arange(len(bad))[:, None], 0)
        np.maximum.accumulate(last, axis=0, out=last)
        self._block = np.take_along_axis(bad, last, axis=0)
        self._block.setflags(write=False)
        self._first, self._end = first, end
