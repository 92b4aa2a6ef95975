"""What each link did, frame after frame, laid side by side so that all links are worked on at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dtsa_channel_sim.model.loss_record import LOST, UNKNOWN
from dtsa_channel_sim.model.loss_table import LossTable

_PIECE = 400  # observations; longer sequences are cut, and each piece begins in the chain's long-run mixture
_LEAST = 1e-12  # likelihood of a single observation
_TOGETHER = 8  # observations whose likelihoods are multiplied before a logarithm is taken

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Sequences:
    """Observations of L links, in C pieces of at most T each; the longest first.

    :param ids: (L, 2) sender and receiver of each link.
    :param sent: (L,) observations.
    :param lost: (L,) those that were lost.
    :param link: (C,) index of each piece's link.
    :param heard: (T, C) 1: heard, 0: lost.
    :param gap: (T, C) slots since the observation before; 0 at the beginning.
    :param active: (T,) how many pieces have so many observations.
    """

    ids: NDArray[np.int64]
    sent: NDArray[np.int64]
    lost: NDArray[np.int64]
    link: NDArray[np.int64]
    heard: Floats
    gap: Floats
    active: NDArray[np.int64]

    @property
    def rate(self) -> Floats:
        """(L,) share that was lost."""
        return np.asarray(self.lost / self.sent)

    @cached_property
    def steady(self) -> bool:
        """Whether each piece has the same gap all along."""
        pairs = enumerate(self.active)
        return len(self.gap) > 1 and all((self.gap[k, :n] == self.gap[1, :n]).all() for k, n in pairs if k)

    def some(self, links: NDArray[np.int64]) -> Sequences:
        """The sequences of some links, in the order given; a link may come several times.

        :param links: their indices.
        """
        order = np.argsort(self.link, kind="stable")  # pieces, link by link
        first = np.searchsorted(self.link[order], links)
        count = np.searchsorted(self.link[order], links, side="right") - first
        place = np.repeat(np.arange(len(links)), count)
        pieces = order[np.arange(len(place)) + np.repeat(first - np.cumsum(count) + count, count)]
        longest_first = np.argsort(pieces, kind="stable")
        pieces, place = pieces[longest_first], place[longest_first]
        active = np.searchsorted(pieces, self.active)
        steps = int(np.count_nonzero(active))
        return Sequences(
            self.ids[links],
            self.sent[links],
            self.lost[links],
            place,
            self.heard[:steps, pieces],
            self.gap[:steps, pieces],
            active[:steps],
        )

    def log_likelihood(self, enter: Floats, leave: Floats, good: Floats, bad: Floats) -> Floats:
        """Log-likelihood of each link, (K, L), by the forward algorithm; between two observations the chain moves on.

        :param enter: (K, L) P(good -> bad) per slot, p.
        :param leave: (K, L) P(bad -> good) per slot, r.
        :param good: (K, L) loss in the good state.
        :param bad: (K, L) loss in the bad state.
        """
        at = self.link
        kept = np.log(np.maximum(1.0 - enter - leave, 1e-300))[:, at]
        share = (enter / (enter + leave))[:, at]
        good, rise, bad = good[:, at], (bad - good)[:, at], bad[:, at]
        total, product = np.zeros_like(share), np.ones_like(share)
        decay = np.exp(self.gap[1] * kept) if self.steady else kept
        # Everything in place: this loop is what fitting costs.
        everything = (share, decay, kept, good, rise, bad, product, total)
        everything += (share.copy(), np.empty_like(share), np.empty_like(share))
        width, views = -1, everything
        for step, count in enumerate(self.active):
            if count != width:
                width, views = int(count), tuple(array[:, :count] for array in everything)
            here, moved, log, low, up, high, likelihoods, logs, state, likelihood, weight = views
            if step:
                if not self.steady:
                    moved = np.exp(np.multiply(log, self.gap[step, :count], out=weight), out=weight)
                state -= here
                state *= moved
                state += here
            heard = self.heard[step, :count]
            np.multiply(state, up, out=likelihood)
            likelihood += low
            np.abs(np.subtract(heard, likelihood, out=likelihood), out=likelihood)
            np.maximum(likelihood, _LEAST, out=likelihood)
            state *= np.abs(np.subtract(heard, high, out=weight), out=weight)
            state /= likelihood
            likelihoods *= likelihood
            if step % _TOGETHER == _TOGETHER - 1:
                logs += np.log(likelihoods, out=weight)
                likelihoods[:] = 1.0
        total += np.log(product)
        result = np.zeros((len(total), len(self.sent)))
        for row, values in zip(result, total, strict=True):
            row[:] = np.bincount(at, values, len(self.sent))
        return result

    def spread(self, share: Floats, kept: Floats) -> Floats:
        """(L,) how many times more a rate varies than that of independent losses, by the chain's correlations.

        :param share: (L,) correlation of losses in one slot, if one could look twice.
        :param kept: (L,) what is left of it after a slot, 1 - p - r.
        """
        log = np.log(np.maximum(kept, 1e-300))[self.link]
        total, pairs = np.zeros(len(self.link)), np.zeros(len(self.link))
        for step, count in enumerate(self.active):
            if step:
                pairs[:count] = (pairs[:count] + 1.0) * np.exp(self.gap[step, :count] * log[:count])
                total[:count] += pairs[:count]
        return np.asarray(1.0 + 2.0 * share * np.bincount(self.link, total, len(self.sent)) / self.sent)


def sequences(tables: Sequence[LossTable], of_receivers: bool = False) -> Sequences:
    """The sequences of all links that were looked at once or more.

    :param tables: flights; a link's sequences of two flights do not go together.
    :param of_receivers: take all links to a receiver as one, from sender 0: what disturbs a receiver disturbs them all.
    """
    pieces: list[tuple[int, NDArray[np.int64], NDArray[np.bool_]]] = []
    ids: dict[tuple[int, int], int] = {}
    for table in tables:
        for sender in [0] if of_receivers else np.unique(table.senders).tolist():
            rows = slice(None) if of_receivers else table.senders == sender
            slots, outcome = table.slots[rows], table.outcome[rows]
            known = outcome != UNKNOWN
            for receiver in np.flatnonzero(known.any(axis=0)).tolist():
                link = ids.setdefault((int(sender), receiver), len(ids))
                there = known[:, receiver]
                own, lost = slots[there], outcome[there, receiver] == LOST
                pieces += [(link, own[k : k + _PIECE], lost[k : k + _PIECE]) for k in range(0, len(own), _PIECE)]
    order = sorted(ids.items())
    place = {link: new for new, (_, link) in enumerate(order)}
    pieces.sort(key=lambda piece: -len(piece[1]))
    steps = len(pieces[0][1]) if pieces else 0
    heard, gap = np.zeros((steps, len(pieces))), np.zeros((steps, len(pieces)))
    sent, lost_of = np.zeros(len(ids), np.int64), np.zeros(len(ids), np.int64)
    for column, (link, slots, lost) in enumerate(pieces):
        heard[: len(slots), column] = ~lost
        gap[1 : len(slots), column] = np.diff(slots)
        sent[place[link]] += len(slots)
        lost_of[place[link]] += int(lost.sum())
    lengths = np.array([len(piece[1]) for piece in pieces], np.int64)
    active = np.array([np.count_nonzero(lengths > step) for step in range(steps)], np.int64)
    links = np.array([place[piece[0]] for piece in pieces], np.int64)
    return Sequences(
        np.array([key for key, _ in order], np.int64).reshape(-1, 2), sent, lost_of, links, heard, gap, active
    )
