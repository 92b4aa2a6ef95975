"""The compiled core as Python sees it: libdtsa, by the binding that cffi makes of its headers (``setup.py``).

A structure, a number or a name stands once, in C. Arrays stay NumPy's: C borrows their memory.
"""

from __future__ import annotations

from itertools import count, takewhile
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ._kernel import ffi, lib

__all__ = ["NAMES", "ffi", "fields_of", "lib", "memory", "shared_arrays"]


def _strings(names: Any) -> tuple[str, tuple[str, ...]]:
    return ffi.string(names.kind).decode(), tuple(ffi.string(names.names[k]).decode() for k in range(names.count))


#: Names of policies, estimators, avoiders, selections, profiles and reasons, in the order of their numbers.
NAMES: dict[str, tuple[str, ...]] = dict(map(_strings, takewhile(bool, map(lib.dtsa_names, count()))))


# What C calls arrays, by the letters of their items in NumPy.
_TYPES = {np.dtype(name).char: ffi.typeof(f"{name}_t[]") for name in ("int32", "int64", "uint16", "uint32", "uint64")}
_TYPES |= {"d": ffi.typeof("double[]"), "f": ffi.typeof("float[]")}
_TYPES |= {"B": ffi.typeof("uint8_t[]"), "?": ffi.typeof("uint8_t[]")}


def memory(array: NDArray[Any], *, writable: bool = False) -> Any:
    """Return the memory of an array for C, which must not outlive the result.

    :raises ValueError: if the array is not contiguous, or read-only where C writes.
    """
    return ffi.from_buffer(_TYPES[array.dtype.char], array, require_writable=writable)


def fields_of(structure: str, source: object, **others: Any) -> dict[str, Any]:
    """Return the fields of a structure in C: those given, else the attributes of ``source`` with their names."""
    names = [name for name, _ in ffi.typeof(structure).fields]
    return {name: getattr(source, name) for name in names if name not in others and hasattr(source, name)} | others


def shared_arrays(cls: type, structure: str) -> dict[str, tuple[str, str]]:
    """Return the arrays that a class shares with C: letters of the shape, and type of the items, by name."""
    kinds, hints = dict(ffi.typeof(structure).fields), get_type_hints(cls, include_extras=True)
    shapes = {name: hint.__metadata__[0] for name, hint in hints.items() if hasattr(hint, "__metadata__")}
    return {name: (shape, kinds[name].type.item.cname.removesuffix("_t")) for name, shape in shapes.items()}
