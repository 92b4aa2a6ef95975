"""A digest of everything in a bag: a dropped, swapped or altered message shows even where nothing else does.

The digest is the sum, modulo 2^128, of one BLAKE2b hash a message. It does not depend on the order in
which messages are read, but each hash covers the topic, both times, the number on the topic and the
bytes, so that no message can be left out, moved or changed without another sum. It guards against mishaps
and careless edits, not against somebody who writes a new digest as well. A run's random id is left out.
Fast CDR leaves the bytes between aligned fields as they happen to be, so two recordings of one flight may differ in
their digests although no field does.
"""

from __future__ import annotations

import struct
from hashlib import blake2b

from dtsa_agent.ros.common.wire.packing import without_run

KEY = "digest"  # name of the digest in a bag's custom data

_TIMES = struct.Struct("<QQQ")
_MASK = (1 << 128) - 1


class BagDigest:
    """Running digest of a bag."""

    __slots__ = ("_sum",)

    def __init__(self) -> None:
        self._sum = 0

    def add(
        self, topic: bytes, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes, run: bool = False
    ) -> None:
        """Take in one message.

        :param data: its CDR bytes.
        :param run: whether it carries a run's id.
        """
        state = blake2b(topic, digest_size=16)
        state.update(_TIMES.pack(log_time_ns, publish_time_ns, sequence))
        state.update(without_run(data) if run else data)
        self._sum = (self._sum + int.from_bytes(state.digest(), "little")) & _MASK

    def hexdigest(self) -> str:
        """The digest so far, 32 hexadecimal digits."""
        return f"{self._sum:032x}"
