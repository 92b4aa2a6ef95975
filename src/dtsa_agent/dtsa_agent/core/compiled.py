"""The compiled kernel; where it is not built everything runs on the specification (``core/reference``)."""

from __future__ import annotations

try:
    from . import _kernel as kernel

    MISSING = ""
except ImportError as error:  # no compiler, or the package is used from its sources
    kernel = None  # type: ignore[assignment]
    MISSING = f"{error}"  # why there is none; empty: there is one

__all__ = ["COMPILED", "CORES", "MISSING", "REFERENCE", "kernel"]

COMPILED, REFERENCE = "compiled", "reference"
CORES = (COMPILED, REFERENCE)  # what moves a swarm
