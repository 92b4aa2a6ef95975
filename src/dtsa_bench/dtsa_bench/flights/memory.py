"""Memory of a process that records for hours."""

from __future__ import annotations

import ctypes

_M_MMAP_THRESHOLD = -3
_LARGE = 1 << 16  # bytes


def keep_heap_small() -> bool:
    """Lets large blocks live outside the heap of this process, and go back to the system when they are freed.

    By itself glibc puts ever larger blocks into the heap once it has seen them freed. A recorder makes and frees some a
    second (chunks, and what compresses them) between many small ones: holes remain, about half a megabyte a minute.

    :returns: whether that could be done: with glibc only.
    """
    try:
        return bool(ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, _LARGE))
    except (OSError, AttributeError):
        return False
