"""Which receivers lose a frame to noise: independent losses, bursts, losses of single links, measured ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.kernel import memory

from .config import ChannelConfig
from .draws import LOSS, STATE, WordBlocks, matrix_of, thresholds
from .gilbert import Chains, GilbertElliott
from .measured import MeasuredLosses
from .topology import link_matrix

Mask = NDArray[np.bool_]


class Losses:
    """Losses under one set of settings.

    Noise, the loss of a link and a loss that was measured are independent causes:
    P(received) = (1 - loss) (1 - link loss) (1 - measured loss).
    """

    __slots__ = ("_bad", "_certain", "_chains", "_good", "_lent", "_per_link", "_states", "_words", "none")

    def __init__(self, config: ChannelConfig) -> None:
        self._words, self._states = (WordBlocks(config.seed, stream, config.agents) for stream in (LOSS, STATE))
        links = link_matrix(config.loss_matrix, config.link_loss, config.agents)
        measured = config.losses if isinstance(config.losses, MeasuredLosses) else None
        #: True when no frame is ever lost to noise.
        self.none = config.loss == 0.0 and links is None and measured is None
        self._per_link = config.burst_scope == "link" or measured is not None
        model, good, bad = None, [config.loss, links], [config.loss, links]
        if measured is not None:
            model, loss_good, loss_bad = measured.fitted(config.agents)
            good, bad = [*good, loss_good], [*bad, loss_bad]
        elif config.burst_length and config.loss:
            model = GilbertElliott.from_means(config.loss, config.burst_length, config.p_good, config.p_bad)
            good, bad = [config.p_good, links], [config.p_bad, links]
        self._chains = None if model is None else Chains(model, self._states)
        # Words below these are losses, by sender.
        self._good, self._bad = (thresholds(_combined(causes), config.agents) for causes in (good, bad))
        # The plain Gilbert channel needs no second draw: bad loses all, good loses none.
        self._certain = measured is None and config.p_good == 0.0 and config.p_bad == 1.0 and links is None

    def lost(self, slot: int, sender: int) -> Mask:
        """Return who would lose a frame to noise, (N,); the sender's own entry has no meaning."""
        limits = self._good[sender - 1]
        if self._chains is not None:
            is_bad = self._chains.bad(slot, sender if self._per_link else 0)
            if self._certain:
                return is_bad
            limits = np.where(is_bad, self._bad[sender - 1], limits)
        lost: Mask = self._words.row(slot) * self._words.factors[sender] < limits
        return lost

    def fill(self, slot: int, losses: Any) -> int:
        """Fill a ``sim_losses`` from a slot on; return the slot up to which it holds."""
        losses.none, losses.chains = self.none, 0
        if self.none:
            return 2**63 - 1
        words, states = self._words, self._states
        number = slot // words.rows
        losses.first = number * words.rows
        arrays = {
            "words": words.block(number), "factors": np.array(words.factors[1:]),
            "good": matrix_of(self._good, words.agents), "bad": matrix_of(self._bad, words.agents),
        }  # fmt: skip
        if self._chains is not None:
            senders = range(1, words.agents + 1) if self._per_link else (0,)
            arrays |= self._chains.arrays(senders, slot - 1)
            arrays |= {"state_words": states.block(number), "state_factors": np.array(states.factors[1:])}
            losses.chains = len(senders)
        self._lent = {name: memory(array) for name, array in arrays.items()}
        for name, lent in self._lent.items():
            setattr(losses, name, lent)
        return int(losses.first) + words.rows


def _combined(causes: Sequence[Any]) -> Any:
    """Return the loss of every link by independent causes: numbers, (N, N) or None."""
    *others, loss = [cause for cause in causes if cause is not None]
    for cause in reversed(others):
        loss = 1.0 - (1.0 - cause) * (1.0 - loss)
    return loss
