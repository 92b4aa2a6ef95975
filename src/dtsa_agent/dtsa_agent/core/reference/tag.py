"""Whose frame it was: a truncated message authentication code over frame, slot and session.

What it protects: docs/how-to/security.md.
"""

from __future__ import annotations

from typing import Protocol

LENGTH = 4  # bytes of a tag
_PERSON = b"dtsa v1"  # tags of other software, or of another version of this one, are none of ours


class Keyed(Protocol):
    """A hash that has taken in key and session, and waits for slot and frame."""

    def copy(self) -> Keyed:
        """The same state once more."""

    def update(self, data: bytes, /) -> None:
        """Takes in more bytes."""

    def digest(self) -> bytes:
        """The code."""


def keyed(key: bytes, session: int) -> Keyed:
    """BLAKE2s with a key, begun with the session: what all tags of a flight have in common."""
    import hashlib  # brings OpenSSL along: 0.6 MB that an agent in flight does without

    return hashlib.blake2s(session.to_bytes(8, "little"), key=key, digest_size=LENGTH, person=_PERSON)


def tag(begun: Keyed, slot: int, data: bytes) -> bytes:
    """The 4 bytes that follow a frame.

    :param slot: the slot in which it is sent, 8 bytes, little-endian; it is not taken from the frame.
    """
    mac = begun.copy()
    mac.update(slot.to_bytes(8, "little"))
    mac.update(data)
    return mac.digest()
