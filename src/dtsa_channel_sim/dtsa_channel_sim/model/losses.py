"""Which receivers lose a frame to noise: independent losses, bursts, losses of single links, measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.kernel import memory

from .config import ChannelConfig
from .draws import LOSS, STATE, WordBlocks, sender_factors, threshold
from .gilbert import Chains, GilbertElliott
from .measured import MeasuredLosses
from .topology import link_matrix

Mask = NDArray[np.bool_]
Thresholds = Sequence[NDArray[np.uint64]]


class NoiseSource:
    """The random numbers of a channel: the same for all settings that it goes through."""

    def __init__(self, seed: int, agents: int) -> None:
        self.words, self.state_words = WordBlocks(seed, LOSS, agents), WordBlocks(seed, STATE, agents)
        self._seed, self._agents = seed, agents

    @cached_property
    def factors(self) -> list[np.uint64]:
        """Constants of senders, by id."""
        return sender_factors(self._seed, LOSS, self._agents)

    @cached_property
    def state_factors(self) -> list[np.uint64]:
        """The same for the words of bursts."""
        return sender_factors(self._seed, STATE, self._agents)


class Losses:
    """Losses under one set of settings.

    Noise, the loss of a link and a loss that was measured are independent causes:
    P(received) = (1 - loss) (1 - link loss) (1 - measured loss).
    """

    __slots__ = ("_bad", "_certain", "_chains", "_good", "_lent", "_per_link", "_source", "none")

    def __init__(self, config: ChannelConfig, source: NoiseSource) -> None:
        self._source = source
        links = link_matrix(config.loss_matrix, config.link_loss, config.agents)
        #: True when no frame is ever lost to noise.
        measured = config.losses if isinstance(config.losses, MeasuredLosses) else None
        self.none = config.loss == 0.0 and links is None and measured is None
        self._chains: Chains | None = None
        self._per_link = config.burst_scope == "link" or measured is not None
        if measured is not None:
            fitted = measured.fitted(config.agents)
            self._chains = Chains(fitted.chains, source.state_words, source.state_factors)
            self._good = _thresholds(config.loss, _both(links, fitted.loss_good), config.agents)
            self._bad = _thresholds(config.loss, _both(links, fitted.loss_bad), config.agents)
        elif config.burst_length and config.loss:
            model = GilbertElliott.from_means(config.loss, config.burst_length, config.p_good, config.p_bad)
            factors = source.state_factors if self._per_link else ()
            self._chains = Chains(model, source.state_words, factors)
            self._good = _thresholds(config.p_good, links, config.agents)
            self._bad = _thresholds(config.p_bad, links, config.agents)
        else:
            self._good = self._bad = _thresholds(config.loss, links, config.agents)
        # The plain Gilbert channel needs no second draw: bad loses all, good loses none.
        self._certain = measured is None and config.p_good == 0.0 and config.p_bad == 1.0 and links is None

    def lost(self, slot: int, sender: int) -> Mask:
        """Return who would lose a frame to noise, (1, N); the sender's own entry has no meaning."""
        if self._chains is None:
            return self._source.words.row(slot) * self._source.factors[sender] < self._good[sender]
        bad = self._chains.links(slot, sender) if self._per_link else self._chains.receivers(slot)
        if self._certain:
            return bad
        words = self._source.words.row(slot) * self._source.factors[sender]
        return words < np.where(bad, self._bad[sender], self._good[sender])

    def fill(self, slot: int, losses: Any) -> int:
        """Fill a ``sim_losses`` from a slot on; return the slot up to which it holds."""
        losses.none, losses.chains = self.none, 0
        if self.none:
            return 2**63 - 1
        source, agents = self._source, self._source.words.agents
        number = slot // source.words.rows
        losses.first = number * source.words.rows
        arrays = {
            "words": source.words.block(number), "factors": np.array(source.factors[1:]),
            "good": _rows(self._good, agents), "bad": _rows(self._bad, agents),
        }  # fmt: skip
        if self._chains is not None:
            senders = range(1, agents + 1) if self._per_link else (0,)
            arrays |= self._chains.arrays(senders, slot - 1)
            arrays |= {"state_words": source.state_words.block(number)}
            arrays |= {"state_factors": np.array(source.state_factors[1:])}
            losses.chains, losses.certain = len(senders), self._certain
        self._lent = {name: memory(array) for name, array in arrays.items()}
        for name, lent in self._lent.items():
            setattr(losses, name, lent)
        return int(losses.first) + source.words.rows


def _rows(thresholds: Thresholds, agents: int) -> NDArray[np.uint64]:
    """Return thresholds by sender and receiver, (N, N)."""
    return np.array([np.broadcast_to(row, agents) for row in thresholds[1:]])


def _thresholds(loss: float, links: NDArray[np.float64] | None, agents: int) -> Thresholds:
    """Return thresholds by sender's id (index 0 is not used): scalars, or rows (N,)."""
    if links is None:
        return [threshold(loss)] * (agents + 1)
    both = threshold(1.0 - (1.0 - loss) * (1.0 - links))
    return [both[0], *both]


def _both(links: NDArray[np.float64] | None, measured: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the loss of every link by two causes, (N, N)."""
    return measured if links is None else 1.0 - (1.0 - links) * (1.0 - measured)
