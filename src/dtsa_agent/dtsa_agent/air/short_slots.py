"""Slots that are too short for a network: an agent notices it by frames that are far off their slots, and says so."""

from __future__ import annotations

from collections.abc import Callable

_FRAMES = 100  # of which a share is taken
_SHARE = 0.05


class ShortSlots:
    """Looks how many of the frames heard were off by more than a quarter of a slot.

    :param slot_ms: ms, length of a slot.
    :param say: is told a line, once; None: nobody is.
    """

    __slots__ = ("_counted", "_off", "_say", "_slot_ms", "found")

    def __init__(self, slot_ms: float, say: Callable[[str], None] | None) -> None:
        self._slot_ms, self._say = slot_ms, say
        self._counted, self._off = -1, 0
        #: Whether slots are too short.
        self.found = False

    def judge(self, timed: int, off: int) -> None:
        """Looks at what has been heard since the last time.

        :param timed: number of frames heard so far.
        :param off: of these, those that were off by more than a quarter of a slot.
        """
        if timed - max(self._counted, 0) < _FRAMES:
            return
        if self._counted >= 0:  # the first ones may be of agents that are about to take over the time of this one
            share = (off - self._off) / (timed - self._counted)
            if share > _SHARE and not self.found:
                self.found = True
                if self._say is not None:
                    self._say(
                        f"slots of {self._slot_ms:g} ms are too short for this network: {share:.0%} of the last "
                        f"{timed - self._counted} frames were off by more than a quarter of a slot"
                    )
        self._counted, self._off = timed, off
