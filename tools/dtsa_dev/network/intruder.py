"""A stranger on the air: plays frames again, at once and later, changes them, makes some up. He has no key."""

from __future__ import annotations

import random
from collections import deque

from dtsa_agent.air.datagram import HEADER

from .switch import Switch

_PAYLOAD = 14 + 20 + 8  # bytes of Ethernet, IP and UDP headers before a datagram
_CHECKSUM = slice(_PAYLOAD - 2, _PAYLOAD)  # of UDP; 0: none
_KEPT = 500  # frames
_FLOOD = 20  # frames at a time, now and then


class Intruder:
    """Answers each frame with one of his own; his radio disturbs nobody's, so that what he says arrives.

    :param switch: the air.
    :param seed: of what he says.
    """

    def __init__(self, switch: Switch, seed: int) -> None:
        self._switch, self._random = switch, random.Random(seed)
        self._heard: deque[bytes] = deque(maxlen=_KEPT)
        self.said = 0
        switch.listener = self.hear

    def hear(self, frame: bytes) -> None:
        """A frame has left the air.

        :param frame: an Ethernet frame.
        """
        self._heard.append(frame)
        for _ in range(_FLOOD if self._random.random() < 0.01 else 1):
            self._switch.tell_all(self._forged(frame))
            self.said += 1

    def _forged(self, frame: bytes) -> bytes:
        """A frame again; one of long ago; or one of which a byte, all of the swarm's frame, or everything is other."""
        draw = self._random
        kind = draw.randrange(5)
        if kind < 2:
            return frame if kind else self._heard[0]
        data = bytearray(frame)
        data[_CHECKSUM] = b"\0\0"
        if kind == 2:
            data[draw.randrange(_PAYLOAD, len(data))] ^= 1 << draw.randrange(8)
        else:
            begin = _PAYLOAD + (HEADER if kind == 3 else 0)
            data[begin:] = draw.randbytes(len(data) - begin)
        return bytes(data)
