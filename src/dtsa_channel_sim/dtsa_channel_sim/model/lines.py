"""The lines between flight processors and their radios: one of each kind for every agent, at work one frame at a time.

A radio hands its receptions over in the order in which they ended, each when the one before it is through. One that
comes when the radio holds as many as it can is lost. A radio that waits (:class:`~.airtime.Line`) sends a frame of its
own when the reception that it hands over is through, before it turns to the next one.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from .airtime import Airtime
from .medium import Mask


class Lines:
    """What all radios hold. Calls come in the order of their times.

    :param airtime: times of the radio.
    :param agents: number of agents.
    """

    __slots__ = ("_airtime", "_held", "_sending_ns")

    def __init__(self, airtime: Airtime, agents: int) -> None:
        self._airtime = airtime
        # By agent: when each reception that its radio holds is through, ns; the first is on the line.
        self._held: list[deque[int]] = [deque() for _ in range(agents)]
        self._sending_ns = [0] * agents  # when each radio has done with its own frames

    def start_ns(self, agent: int, at_ns: int, length: int) -> int:
        """Return when a radio begins to send a frame of its own, ns.

        :param agent: id.
        :param at_ns: ns, when the radio has the frame.
        :param length: its bytes.
        """
        held = self._release(agent - 1, at_ns)
        start = held[0] if held and self._airtime.line.waits else at_ns
        start = max(start, self._sending_ns[agent - 1])
        self._sending_ns[agent - 1] = start + self._airtime.total_ns(length)
        return start

    def receive(self, end_ns: int, length: int, received: Mask) -> tuple[Mask, int]:
        """Take in a reception; return who has room for it, (N,), and when the last of them has handed it over, ns.

        :param end_ns: ns, end of the last bit.
        :param length: bytes of the frame.
        :param received: (N,) whose radios have received it.
        """
        takes_ns, queue = self._airtime.from_radio_ns(length), self._airtime.line.queue
        taken, last = received.copy(), end_ns + takes_ns
        for index in np.flatnonzero(received).tolist():
            held = self._release(index, end_ns)
            if queue and len(held) >= queue:
                taken[index] = False
                continue
            held.append((held[-1] if held else end_ns) + takes_ns)
            last = max(last, held[-1])
        return taken, last

    def handed_ns(self, agent: int) -> int:
        """Return when the newest reception that a radio took in is through, ns.

        :param agent: id of one that has just taken one in.
        """
        return self._held[agent - 1][-1]

    def reset(self, agent: int) -> None:
        """Forget what a radio holds: its power was off.

        :param agent: id.
        """
        self._held[agent - 1].clear()
        self._sending_ns[agent - 1] = 0

    def _release(self, index: int, now_ns: int) -> deque[int]:
        """Return what a radio still holds: what is through has left it."""
        held = self._held[index]
        while held and held[0] <= now_ns:
            held.popleft()
        return held
