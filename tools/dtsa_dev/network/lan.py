"""A switch between the hosts of a trial that is no radio: it loses nothing, and brings to all what is for all."""

from __future__ import annotations

import os
import select
import time
from collections import Counter
from collections.abc import Callable, Sequence

from .hosts import Host, arrived

_MULTICAST = b"\x01\x00\x5e"  # Ethernet addresses of IPv4's groups begin so
_ASK_S = 0.02


class Lan:
    """An Ethernet switch that learns where its hosts are.

    :param joined: the hosts.
    """

    def __init__(self, joined: Sequence[Host]) -> None:
        self._cables = [host.cable for host in joined]
        self._behind: dict[bytes, int] = {}  # cable, by hardware address
        self.carried = 0  # frames read
        self.to_groups: Counter[str] = Counter()  # of these, by the last three bytes of the group's address
        self.undelivered = 0  # frames that a host did not take

    def run(self, until: Callable[[], bool], seconds: float) -> bool:
        """Carries frames.

        :param until: asked about fifty times a second: whether to stop.
        :param seconds: s after which it stops, whatever happens.
        :returns: whether it was asked to stop.
        """
        end = time.monotonic() + seconds
        ask = 0.0
        while True:
            now = time.monotonic()
            if now >= ask:
                if until():
                    return True
                ask = now + _ASK_S
            if now >= end:
                return False
            for cable in select.select(self._cables, [], [], _ASK_S)[0]:
                self._read(cable)

    def _read(self, cable: int) -> None:
        for frame in arrived(cable):
            self.carried += 1
            target = None if frame[0] & 1 else self._behind.get(frame[:6])
            if frame[:3] == _MULTICAST:
                self.to_groups[".".join(map(str, frame[3:6]))] += 1
            self._behind[frame[6:12]] = cable
            for other in self._cables if target is None else (target,):
                if other != cable:
                    try:
                        os.write(other, frame)
                    except OSError:
                        self.undelivered += 1
