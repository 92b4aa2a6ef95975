"""Positions of a flight of any length in little memory."""

from __future__ import annotations

import tempfile
import weakref
from typing import IO

import numpy as np
from numpy.typing import NDArray

_IN_MEMORY = 1 << 20  # bytes; what is longer goes to a temporary file


class PositionLog:
    """(3, N) m at each slot's start, one after the other."""

    def __init__(self, agents: int) -> None:
        self._agents = agents
        self._count = 0
        self._recent = bytearray()
        self._file: IO[bytes] | None = None
        self._full = False

    def __len__(self) -> int:
        return self._count

    def append(self, position: NDArray[np.float64]) -> None:
        """Adds a slot. Where there is no more room on the disk, what comes later is not kept.

        :param position: (3, N) m, frame map.
        """
        if self._full:
            return
        self._recent += position.tobytes()
        self._count += 1
        if len(self._recent) > _IN_MEMORY:
            self._save()

    def _save(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            self._file.write(self._recent)
            self._file.flush()
        except OSError:  # a picture then ends early; the flight does not
            self._full = True
            self._count -= len(self._recent) // (24 * self._agents)
        self._recent.clear()

    def array(self) -> NDArray[np.float64]:
        """(T, 3, N) m, all that is kept; a long flight's stays on the disk and is read when it is used."""
        shape = (self._count, 3, self._agents)
        if self._file is None:
            return np.frombuffer(bytes(self._recent), dtype=np.float64).reshape(shape)
        if self._recent:
            self._save()
            shape = (self._count, 3, self._agents)
        return np.memmap(self._file, np.float64, "r", shape=shape)
