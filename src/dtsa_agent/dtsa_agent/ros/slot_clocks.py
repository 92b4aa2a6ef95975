"""When the slots of agents start that have clocks of their own.

The time line is the channel's: ns from the start of slot 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.kernel import ffi, lib

_PPB = 1_000_000_000
# Slots move by half the median of nine frames; what is off by more than 1 ms is not trusted (dtsa.h).
_ALIGNER = {"receptions": 9, "share": 32768, "limit_ns": 1_000_000}


def slot_starts(local_ns: int, offset_ns: NDArray[np.int64], drift_ppb: NDArray[np.int64]) -> NDArray[np.int64]:
    """How much later than the channel's clock some clocks show a time, ns: the first ns at which they show it.

    :param local_ns: the time, ns.
    :param offset_ns: (L,) ns, what each clock shows at the channel's time 0.
    :param drift_ppb: (L,) parts per billion by which each runs fast.
    """
    # The first c with c (1 + drift) + offset >= local, written so that no product leaves 64 bits within months.
    ahead = local_ns - offset_ns
    return np.asarray(ahead - ahead * drift_ppb // (_PPB + drift_ppb) - local_ns)


class SlotClocks:
    """The clocks of L agents, and what the agents have learned to wait.

    :param slot_ns: ns, length of a slot.
    :param offset_ns: (L,) ns, what each clock shows at time 0.
    :param drift_ppb: (L,) parts per billion by which each runs fast.
    :param align: whether slots move towards what is heard.
    """

    def __init__(self, slot_ns: int, offset_ns: Sequence[int], drift_ppb: Sequence[int], align: bool) -> None:
        self._slot_ns = slot_ns
        self._offset: NDArray[np.int64] = np.array(offset_ns, dtype=np.int64)
        self._drift: NDArray[np.int64] = np.array(drift_ppb, dtype=np.int64)
        self._shift: NDArray[np.int64] = np.zeros(len(self._offset), dtype=np.int64)  # ns, learned
        self._starts: tuple[int | None, NDArray[np.int64]] = None, self._shift  # of the slot asked for last
        self._ideal = not (self._offset.any() or self._drift.any())  # all clocks show the channel's time
        self._aligners = [ffi.new("dtsa_aligner *", _ALIGNER) for _ in self._offset] if align else []

    @property
    def align(self) -> bool:
        """Whether slots move towards what is heard."""
        return bool(self._aligners)

    def starts(self, slot: int) -> NDArray[np.int64]:
        """When each agent's slot starts, (L,) ns after the channel's start of that slot.

        :param slot: its number.
        """
        if self._ideal:
            return self._shift
        if slot != self._starts[0]:
            self._starts = slot, slot_starts(slot * self._slot_ns, self._offset, self._drift) + self._shift
        return self._starts[1]

    def local_ns(self, time_ns: int) -> NDArray[np.int64]:
        """What each agent's clock shows, (L,) ns.

        :param time_ns: ns on the channel's time line.
        """
        return np.asarray(time_ns + time_ns * self._drift // _PPB + self._offset)

    def take(self, index: int | np.intp, late_ns: int) -> None:
        """An agent takes the time from a frame.

        :param index: position of the agent.
        :param late_ns: ns by which the frame began later than the agent expected it.
        """
        self._move(index, late_ns)
        if self._aligners:
            lib.dtsa_align_reset(self._aligners[index])

    def hear(self, index: int | np.intp, late_ns: int) -> int:
        """An agent's slots move towards a frame that it heard.

        :param index: position of the agent.
        :param late_ns: ns by which the frame began later than the agent expected it.
        :returns: how many frames in a row did not fit.
        """
        aligner = self._aligners[index]
        moved = lib.dtsa_align(aligner, late_ns)
        if moved:
            self._move(index, moved)
        return int(aligner.ignored_in_a_row)

    def forget(self) -> None:
        """All begin to learn anew."""
        for aligner in self._aligners:
            lib.dtsa_align_reset(aligner)

    def _move(self, index: int | np.intp, by_ns: int) -> None:
        self._shift[index] += by_ns
        self._starts = None, self._shift
