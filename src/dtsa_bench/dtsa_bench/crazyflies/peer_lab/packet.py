"""A peer-to-peer packet on its way."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Packet:
    """A peer-to-peer packet.

    :param sender: id of its sender; 0: a foreign one.
    :param raw: port and data.
    :param ordered_ns: ns, when the app ordered to send it.
    """

    sender: int
    raw: bytes
    ordered_ns: int

    @property
    def data(self) -> bytes:
        """Without the port."""
        return self.raw[1:]
