"""Random words that depend on (seed, slot, link) and on nothing else.

Words come in blocks of slots; block k has its own generator, spawned from the seed by k, so that any slot can
be looked at without those before it. One 64-bit word per (slot, receiver) is drawn; the word of the link from
sender s is that word times an odd 64-bit constant of s, modulo 2^64. An odd factor permutes the words, so
each link's word is uniform, and two random factors leave no visible dependence between the links of one
receiver (a two-dimensional lattice of 2^63 points). This costs one multiplication a frame instead of N^2
draws a slot.

Words are even, so a threshold of 2^64 - 1 means "always" and 0 means "never", exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.uint64]

#: Streams of one seed.
LOSS, STATE, CLOCK = 1, 2, 3
_FACTORS = 1 << 32
_BLOCK_WORDS = 1 << 16


def threshold(probability: float | NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return the number t for which a word is below t with the given probability; 0 and 1 are exact."""
    p = np.asarray(probability, dtype=np.float64)
    # 2^64 does not fit; the largest double below 1 times 2^64 does.
    scaled = np.minimum(p, 1.0 - 2.0**-53) * 2.0**64
    return np.asarray(np.where(p >= 1.0, np.uint64(2**64 - 1), scaled.astype(np.uint64)), dtype=np.uint64)


def thresholds(probability: float | NDArray[np.float64], agents: int) -> list[NDArray[np.uint64]]:
    """Return the threshold of every link, a row for each of N senders: (N,), or () where all have the same."""
    limits = threshold(probability)
    return list(limits) if limits.ndim else [limits] * agents


def matrix_of(rows: Sequence[NDArray[np.uint64]], agents: int) -> NDArray[np.uint64]:
    """Return such rows written out, (rows, N)."""
    return np.array([np.broadcast_to(row, agents) for row in rows])


def generator(seed: int, *key: int) -> np.random.Generator:
    """Return the generator that belongs to a seed and a path of numbers below it."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=key)))


class WordBlocks:
    """Words of one stream by slot, for N receivers.

    :param seed: seed of the channel.
    :param stream: number of the stream.
    :param agents: number of receivers N, the length of a row.
    """

    def __init__(self, seed: int, stream: int, agents: int) -> None:
        self._seed, self._stream, self.agents = seed, stream, agents
        self.rows = max(16, _BLOCK_WORDS // agents)
        #: An odd 64-bit constant per sender, by id: the words of its links are those of the receivers times it; 0: 1.
        self.factors = _factors(seed, stream, agents)

    def row(self, slot: int) -> Words:
        """Return the words of one slot, (N,)."""
        words: Words = self.block(slot // self.rows)[slot % self.rows]
        return words

    def span(self, first: int, end: int) -> Words:
        """Return the words of the slots from ``first`` up to, not including, ``end``, (end - first, N)."""
        numbers = range(first // self.rows, (end - 1) // self.rows + 1)
        parts = [self.block(k)[max(0, first - k * self.rows) : min(self.rows, end - k * self.rows)] for k in numbers]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    def block(self, number: int) -> Words:
        """Return all words of a block, (rows, N)."""
        return _block(self._seed, self._stream, number, self.rows, self.agents)


@lru_cache(maxsize=32)  # also from flight to flight: memory that is given back after each one costs more than the draws
def _block(seed: int, stream: int, number: int, rows: int, agents: int) -> Words:
    # Raw output: NumPy keeps it the same from version to version, other than that of its distributions.
    raw = generator(seed, stream, number).bit_generator.random_raw(rows * agents)
    block = (raw & np.uint64(2**64 - 2)).reshape(rows, agents)
    block.setflags(write=False)
    return block


@lru_cache(maxsize=32)
def _factors(seed: int, stream: int, agents: int) -> list[np.uint64]:
    bits = generator(seed, stream, _FACTORS).bit_generator.random_raw(agents + 1)
    return [np.uint64(1), *(np.uint64(int(word) | 1) for word in bits[1:])]
