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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError

from .draws import WordBlocks, matrix_of, thresholds

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


class Chains:
    """States of the chains of all receivers, or of all links, begun at slot 0 in their long-run mixture.

    A sender is an id, for the chains of its links, or 0 for those of the receivers.
    """

    def __init__(self, model: GilbertElliott, words: WordBlocks) -> None:
        self._words = words
        # Where words decide, by sender.
        self._enter = thresholds(model.enter, words.agents)
        self._keep = thresholds(1.0 - model.leave, words.agents)
        self._share = thresholds(model.bad_share, words.agents)
        # So many slots nearly always have a word that decides, for each link of a sender.
        kept = float(np.clip(1.0 - model.enter - model.leave, 1e-9, 1.0 - 1e-9).max())
        self._first_step = min(words.rows, max(8, round((math.log(words.agents) + 4.0) / -math.log(kept))))
        self._receivers = range(0)  # slots whose states are known of all receivers,
        self._states: Mask = np.zeros((0, words.agents), np.bool_)  # and these
        self._seen: dict[int, tuple[int, Mask]] = {}  # slot and states of the last look at each sender's links

    def bad(self, slot: int, sender: int) -> Mask:
        """Return which links from a sender are in a bad phase in a slot, (N,)."""
        if not sender:
            if slot not in self._receivers:
                self._walk(slot // self._words.rows)
            states: Mask = self._states[slot - self._receivers.start]
            return states
        # Where the last look ended, this one may end too: it saves work and changes nothing.
        floor, before = self._seen.get(sender, (-1, None))
        if floor == slot and before is not None:
            return before
        bad = self._search_back(slot, sender, *((floor, before) if floor < slot else (-1, None)))
        bad.setflags(write=False)
        self._seen[sender] = slot, bad
        return bad

    def arrays(self, senders: Sequence[int], slot: int) -> dict[str, NDArray[Any]]:
        """Return where words decide, and the phases (1: bad) in a slot, -1: none yet; rows by sender, (C, N)."""
        agents = self._words.agents
        phase = np.zeros((len(senders), agents), dtype=np.uint8)
        for row, sender in enumerate(senders if slot >= 0 else ()):
            phase[row] = self._search_back(slot, sender)
        limits = {"enter": self._enter, "keep": self._keep, "share": self._share}
        return {**{k: matrix_of(rows[: len(senders)], agents) for k, rows in limits.items()}, "phase": phase}

    def _search_back(self, slot: int, sender: int, floor: int = -1, before: Mask | None = None) -> Mask:
        """Return the states (N,) in a slot, from the last word that decided, or ``before`` in ``floor``."""
        columns = np.arange(self._words.agents)
        known = np.zeros(len(columns), np.bool_)
        bad = known if before is None else before
        end, step = slot + 1, self._first_step
        while True:
            first = max(floor + 1, end - step)
            value, decided = self._decide(first, end, sender)
            last = len(value) - 1 - np.argmax(decided[::-1], axis=0)
            found = decided[last, columns]
            bad = np.where(found & ~known, value[last, columns], bad)
            known = known | found
            if first == floor + 1 or known.all():
                return bad
            end, step = first, min(2 * step, 4 * self._words.rows)

    def _decide(self, first: int, end: int, sender: int) -> tuple[Mask, Mask]:
        """Return (bad, decided) by the words of some slots, (end - first, N)."""
        row = max(sender - 1, 0)
        words = self._words.span(first, end) * self._words.factors[sender]
        bad = words < self._enter[row]
        decided = bad | (words >= self._keep[row])
        if first == 0:
            bad[0], decided[0] = words[0] < self._share[row], True
        return bad, decided

    def _walk(self, number: int) -> None:
        """Work out the states of all receivers in one block of slots."""
        first, end = number * self._words.rows, (number + 1) * self._words.rows
        bad, decided = self._decide(first, end, 0)
        if first > 0:
            before = self._states[-1] if first == self._receivers.stop else self._search_back(first - 1, 0)
            bad[0] = np.where(decided[0], bad[0], before)
        last = np.where(decided, np.arange(len(bad))[:, None], 0)
        np.maximum.accumulate(last, axis=0, out=last)
        self._states, self._receivers = np.take_along_axis(bad, last, axis=0), range(first, end)
        self._states.setflags(write=False)
