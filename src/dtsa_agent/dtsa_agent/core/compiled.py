"""The compiled kernel; where it is not built everything runs on the specification (``core/reference``)."""

from __future__ import annotations

from itertools import count, takewhile

try:
    from . import _kernel as kernel

    MISSING = ""
except ImportError as error:  # no compiler, or the package is used from its sources
    kernel = None  # type: ignore[assignment]
    MISSING = f"{error}"  # why there is none; empty: there is one

__all__ = ["COMPILED", "CORES", "MISSING", "NAMES", "REFERENCE", "kernel"]

COMPILED, REFERENCE = "compiled", "reference"
CORES = (COMPILED, REFERENCE)  # what moves a swarm

_names = getattr(kernel, "names", lambda index: ())  # a kernel made before has none

# What the compiled kernel calls what has a number, by kind, in the order of the numbers.
NAMES: dict[str, tuple[str, ...]] = {kind: tuple(names) for kind, *names in takewhile(bool, map(_names, count()))}
