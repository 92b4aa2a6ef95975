"""A record of who heard whom, replayed slot by slot: what was lost then is lost again."""

from __future__ import annotations

import base64
import binascii
import zlib
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError

Mask = NDArray[np.bool_]
#: Most entries of a record: frames times agents.
MOST = 200_000_000
HEARD, LOST, UNKNOWN = 0, 1, 2
_WORDS = "what MeasuredLosses.to_dict gives"


class LossRecord:
    """Which receivers lost which frame.

    A link does in a slot what it did when it was last looked at; before that, what it did first. Links of which
    nothing is known do as the listener did that is no agent, or lose nothing. The record repeats itself.

    :param slots: (F,) slots, ascending, and with them
    :param senders: (F,) ids of the senders; each at most once in a slot.
    :param outcome: (F, N + 1) HEARD, LOST or UNKNOWN by the receiver's id; 0: a listener that is no agent.
    """

    __slots__ = ("_first", "_period", "_rows", "_slots")

    def __init__(self, slots: NDArray[np.int64], senders: NDArray[np.int64], outcome: NDArray[np.uint8]) -> None:
        self._first = int(slots[0])
        self._period = int(slots[-1]) - self._first + 1
        agents = outcome.shape[1] - 1
        self._slots: dict[int, NDArray[np.int64]] = {}
        self._rows: dict[int, Mask] = {}
        for sender in range(1, agents + 1):
            rows = np.flatnonzero(senders == sender)
            if len(rows):
                self._slots[sender] = slots[rows]
                self._rows[sender] = _held(outcome[rows])
            else:
                self._slots[sender], self._rows[sender] = slots[:1], np.zeros((1, agents), np.bool_)

    def lost(self, slot: int, sender: int) -> Mask:
        """Return who loses a frame, (1, N).

        :param slot: the slot in which it is sent.
        :param sender: id of the sender.
        """
        at = self._first + (slot - self._first) % self._period
        row = max(0, int(np.searchsorted(self._slots[sender], at, side="right")) - 1)
        return self._rows[sender][row : row + 1]


def _held(outcome: NDArray[np.uint8]) -> Mask:
    """Return who loses in each row, (F, N): where nothing is known, what held before; before that, what came first."""
    known = outcome != UNKNOWN
    last = np.where(known, np.arange(len(outcome), dtype=np.int32)[:, None], -1)
    np.maximum.accumulate(last, axis=0, out=last)
    last = np.where(last < 0, np.argmax(known, axis=0), last)
    lost = np.take_along_axis(outcome, last, axis=0) == LOST
    never = ~known.any(axis=0)
    lost[:, never] = False
    lost[:, never] |= lost[:, :1]
    return np.ascontiguousarray(lost[:, 1:])


def pack(slots: NDArray[np.int64], senders: NDArray[np.int64], outcome: NDArray[np.uint8]) -> str:
    """Return a record as text, which :func:`unpack` reads; see :class:`LossRecord`."""
    parts = [
        np.array([len(slots), outcome.shape[1]], "<i8"),
        slots.astype("<i8"),
        senders.astype("<u2"),
        np.packbits(outcome == LOST, axis=1),
        np.packbits(outcome == UNKNOWN, axis=1),
    ]
    return base64.b64encode(zlib.compress(b"".join(part.tobytes() for part in parts), 9)).decode("ascii")


@lru_cache(maxsize=2)
def unpack(text: str, agents: int) -> LossRecord:
    """Return what :func:`pack` has packed, for the first agents of it.

    :param text: the packed record.
    :param agents: number of agents N; the record has as many, or more.
    :raises ConfigError: when the text is none.
    """
    try:
        stream = zlib.decompressobj()
        data = stream.decompress(base64.b64decode(text, validate=True), 4 * MOST)
        frames, width = (int(value) for value in np.frombuffer(data, "<i8", 2))
        bits = -(-width // 8)
        if frames < 1 or width < 2 or len(data) != 16 + frames * (10 + 2 * bits):
            raise ValueError("length")
        slots = np.frombuffer(data, "<i8", frames, 16).astype(np.int64)
        senders = np.frombuffer(data, "<u2", frames, 16 + 8 * frames).astype(np.int64)
        at = 16 + 10 * frames
        planes = [
            np.unpackbits(
                np.frombuffer(data, np.uint8, frames * bits, start).reshape(frames, bits), axis=1, count=width
            )
            for start in (at, at + frames * bits)
        ]
        if slots[0] < 0 or (np.diff(slots) < 0).any():
            raise ValueError("slots")
    except (ValueError, binascii.Error, zlib.error) as error:
        raise ConfigError("losses.record", f"{len(text)} characters ({error})", _WORDS) from None
    outcome = np.where(planes[1] == 1, np.uint8(UNKNOWN), planes[0].astype(np.uint8))
    if width < agents + 1:
        raise ConfigError(
            "losses", f"a record of {width - 1} agents", f"one of {agents} agents or more, as in the swarm"
        )
    return LossRecord(slots, senders, np.ascontiguousarray(outcome[:, : agents + 1]))
