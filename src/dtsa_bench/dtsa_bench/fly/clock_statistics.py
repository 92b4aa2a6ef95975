"""How well agents on their own clocks keep together: from the times that they report."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dtsa_agent.ros.common.report_fields import ReportFields
from dtsa_channel_sim.ros.observer import ChannelObserver

ON_TIME_NS = 1_000_000  # a frame this far from the swarm's common time is not on time any more
_END = 50  # slots
_OPEN = 1000  # slots that are not summed up yet


class ClockStatistics(ChannelObserver):
    """Collects when slots start and frames leave, and sums it up.

    :param agents: number of agents N.
    """

    def __init__(self, agents: int) -> None:
        self._slot = np.full(_OPEN, -1, dtype=np.int64)  # each in row slot % _OPEN, -1: none yet
        self._starts = np.full((_OPEN, agents), np.nan)  # ns, own slot's start, nan: sent, or not known
        self._sends = np.full((_OPEN, agents), np.nan)  # ns, of the transmission
        self._spread = array("f")  # ns, of slots that are summed up
        self._away: dict[int, array[float]] = {}  # ns, by agent, likewise

    def report(self, message: ReportFields, data: bytes) -> None:
        self.add(message.slot, message.agent, message.offset_ns, message.length)

    def add(
        self, slot: ArrayLike, ids: Sequence[int], offsets_ns: NDArray[np.int64], lengths: NDArray[np.uint8]
    ) -> None:
        """Takes in what one process says of some slots; nothing of slots that have been summed up.

        :param slot: (m,) as its agents count, ascending.
        :param ids: (n,) of the agents.
        :param offsets_ns: (m n) ns, of each agent's slot from the channel's; of its transmission, if it sends.
        :param lengths: (m n) bytes of each frame, 0: silent.
        """
        slots = np.asarray(slot, dtype=np.int64)
        rows = slots % _OPEN
        for new in slots[self._slot[rows] < slots].tolist():
            self._sum_up(new % _OPEN)
            self._slot[new % _OPEN] = new
        at = np.ix_(rows, np.asarray(ids, dtype=np.intp) - 1)
        open_ = (self._slot[rows] == slots)[:, None]
        silent, offsets = lengths.reshape(len(slots), -1) == 0, offsets_ns.reshape(len(slots), -1)
        self._starts[at] = np.where(open_ & silent, offsets, self._starts[at])
        self._sends[at] = np.where(open_ & ~silent, offsets, self._sends[at])

    def _sum_up(self, row: int) -> None:
        """Nothing more will be told of a slot."""
        starts, sends = self._starts[row], self._sends[row]
        usable = np.sort(starts[~np.isnan(starts)])
        count = len(usable)
        if count > 1:
            self._spread.append(usable[-1] - usable[0])
        for index in np.flatnonzero(~np.isnan(sends)).tolist() if count else ():
            median = (usable[(count - 1) // 2] + usable[count // 2]) / 2
            self._away.setdefault(index + 1, array("f")).append(sends[index] - median)
        starts[:] = sends[:] = np.nan

    def summary(self) -> dict[str, Any]:
        """The results; None where nothing was reported.

        ``clock_spread_*_ms``: between the first and the last agent's start of the same slot, over all slots, and the
        largest of the last 50; ``send_offset_ms``: by agent, how far its frames left from the swarm's common time (the
        median of the slot's starts); ``sends_on_time_share``: frames within 1 ms of it.
        """
        for row in np.argsort(self._slot).tolist():
            self._sum_up(row)
        spread = np.array(self._spread, dtype=np.float64) / 1e6
        away = {agent: np.array(values, dtype=np.float64) for agent, values in sorted(self._away.items())}
        every = np.concatenate(list(away.values())) if away else np.zeros(0)
        return {
            "clock_spread_max_ms": float(spread.max()) if len(spread) else None,
            "clock_spread_mean_ms": float(spread.mean()) if len(spread) else None,
            "clock_spread_end_ms": float(spread[-_END:].max()) if len(spread) else None,
            "sends_on_time_share": float((np.abs(every) <= ON_TIME_NS).mean()) if len(every) else None,
            "send_offset_ms": {
                str(agent): {"median": float(np.median(values)) / 1e6, "max": float(max(values, key=abs)) / 1e6}
                for agent, values in away.items()
            },
        }
