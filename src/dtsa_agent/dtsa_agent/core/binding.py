"""Images of the structures that the compiled kernel keeps, made field by field in the order of their headers.

Arrays stay NumPy's: an image holds their addresses, so that Python and C look at the same memory.
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from .compiled import MISSING
from .compiled import kernel as _kernel

__all__ = ["AVOID", "METRICS", "SWARM", "Layout"]

Field = tuple[str, str, str]  # name; type in a letter of `struct`, of an array in NumPy's words; shape of an array


class Layout:
    """What a structure consists of.

    :param fields: in the order of the header. A shape is read letter by letter: a figure, or a size of the image's.
    :param size: bytes of the structure in the compiled kernel; of a kernel made before there were images 0.
    :raises ImportError: if it has another size there.
    """

    def __init__(self, fields: tuple[Field, ...], size: int) -> None:
        self.fields = fields
        self._shapes = {shape for _, _, shape in fields}
        self._types = {kind: np.dtype(kind) for _, kind, shape in fields if shape}
        self._packed = struct.Struct("@" + "".join("P" if shape else kind for _, kind, shape in fields))
        if not MISSING and self._packed.size != size:
            raise ImportError("the compiled kernel is of another version; build dtsa_agent again")

    def image(
        self, values: Mapping[str, Any], arrays: Mapping[str, Any] | None = None, sizes: Mapping[str, int] | None = None
    ) -> bytes:
        """The structure's bytes.

        :param values: of its scalars, by name.
        :param arrays: its arrays, by name; whoever uses the image keeps them alive.
        :param sizes: what the letters of their shapes stand for.
        :raises ValueError: for an array of another type or size, or one that is read-only or not contiguous.
        """
        given, letters = arrays or {}, sizes or {}
        counts = {shape: math.prod(letters[s] if s in letters else int(s) for s in shape) for shape in self._shapes}
        return self._packed.pack(
            *(
                _address(name, given[name], self._types[kind], counts[shape]) if shape else values[name]
                for name, kind, shape in self.fields
            )
        )


def _address(name: str, array: Any, kind: np.dtype[Any], count: int) -> int:
    if array.dtype != kind or array.size != count or not array.flags.carray:
        raise ValueError(f"{name}: {array.size} values of type {array.dtype}; allowed: {count} of {kind}")
    if count:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # a quarter of the time that NumPy takes to say it
    address: int = array.ctypes.data
    return address


# dtsa_avoid_params of libdtsa/include/dtsa.h.
_AVOID_FIELDS: tuple[Field, ...] = tuple(
    (name, "d", "")
    for name in (
        "v_max", "gain", "radius", "horizon", "softness", "bias", "period", "influence", "strength", "core",
        "tangential", "margin_rate", "margin_max", "sidestep", "stretch_z",
    )
)  # fmt: skip
AVOID = Layout(_AVOID_FIELDS, 8 * len(_AVOID_FIELDS))

# swarm of libdtsa_sim/swarm.h up to its own part, with what is in it: dtsa_config, dtsa_lease_config, vehicle_params.
# n agents, v tables, l local agents, s control instants, k decay_len, f bytes of a frame, p bytes of a policy's state.
SWARM = Layout(
    (
        ("agents", "i", ""), ("slot_s", "d", ""), ("steps", "i", ""), ("policy", "i", ""), ("estimator", "i", ""),
        ("avoider", "i", ""), ("selection", "i", ""), ("profile", "i", ""), ("epsilon", "d", ""), ("age_cap", "d", ""),
        ("boot_round", "i", ""), ("return_every", "i", ""), ("r_min", "d", ""), ("c_r", "i", ""),
        ("targets_known", "i", ""), ("gossip", "i", ""), ("position_step", "d", ""), ("key", "Q", ""), *_AVOID_FIELDS,
        ("anchor_every", "i", ""), ("open_every", "i", ""), ("adoption", "i", ""), ("depth_rate", "d", ""),
        ("share", "d", ""), ("patience", "q", ""), ("main_every", "i0q", ""),
        ("start", "f8", "3n"), ("target", "f8", "3n"), ("decay", "f8", "2k"),
        ("decay_len", "i0q", ""),  # a structure in a structure ends at a multiple of eight bytes
        ("local_count", "i", ""), ("table_count", "i", ""), ("shared", "i", ""), ("tau", "d", ""), ("a_max", "d", ""),
        ("local", "i4", "l"), ("observer", "i4", "v"), ("sent_p", "f8", "v3n"), ("sent_v", "f8", "v3n"),
        ("sent_c", "f8", "v3n"), ("sent_slot", "i8", "vn"), ("last", "i8", "vn"), ("in_ap", "u1", "vn"),
        ("entry_hash", "u4", "vn"), ("table_hash", "u4", "v"), ("est_p", "f8", "v3n"), ("est_v", "f8", "v3n"),
        ("g", "f8", "vn"), ("h", "i8", "vn"), ("pos", "f8", "3l"), ("vel", "f8", "3l"), ("cmd", "f8", "3l"),
        ("goal", "f8", "3l"), ("track", "f8", "s3l"), ("active", "u1", "l"), ("final", "u1", "l"),
        ("present", "u1", "l"), ("chosen", "u2", "l"), ("reason", "u1", "l"), ("digest", "u4", "l"),
        ("score", "f8", "l"), ("sends", "u1", "l"), ("frame_len", "u1", "l"), ("frames", "u1", "lf"),
        ("lease_state", "u1", "lp"), ("rejects", "u8", "2"),
    ),
    getattr(_kernel, "SWARM_IMAGE", 0),
)  # fmt: skip

# metrics of libdtsa_sim/metrics.h.
METRICS = Layout(
    (
        ("n", "i", ""), ("news_from", "q", ""), ("collision_m", "d", ""), ("r_min", "d", ""), ("path", "f8", "n"),
        ("last_position", "f8", "3n"), ("target", "f8", "3n"), ("moving", "u1", "n"),
        ("gone", "u1", "n"), ("goal", "f8", "3n"), ("woken", "i8", "n"), ("heard", "u1", "n"), ("delays", "i8", "d"),
        ("sums", "i8", "s"),
    ),
    getattr(_kernel, "METRICS_IMAGE", 0),
)  # fmt: skip
