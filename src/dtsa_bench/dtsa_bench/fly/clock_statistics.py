"""How well agents on their own clocks keep together: from the times that they report."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_channel_sim.ros.observer import ChannelObserver

ON_TIME_NS = 1_000_000  # a frame this far from the swarm's common time is not on time any more
_END = 50  # slots
_OPEN = 2000  # slots that are not summed up yet


class ClockStatistics(ChannelObserver):
    """Collects when slots start and frames leave, and sums it up.

    :param agents: number of agents N.
    """

    def __init__(self, agents: int) -> None:
        self._agents = agents
        self._starts: dict[int, NDArray[np.float64]] = {}  # (N,) ns by slot: own slot's start where silent
        self._sends: dict[int, list[tuple[int, int]]] = {}  # by slot: agent's id, ns
        self._spread = array("f")  # ns, of slots that are summed up
        self._away: dict[int, array[float]] = {}  # ns, by agent, likewise

    def report(self, message: Any, data: bytes) -> None:
        count = len(message.agent)
        for row, slot in enumerate(message.slot):
            part = slice(row * count, (row + 1) * count)
            self.add(slot, message.agent, message.offset_ns[part], message.length[part])

    def add(self, slot: int, ids: Sequence[int], offsets_ns: Sequence[int], lengths: Sequence[int]) -> None:
        """Takes in what one process says of one slot.

        :param slot: as its agents count.
        :param ids: of the agents.
        :param offsets_ns: ns, of each agent's slot from the channel's; of its transmission, if it sends.
        :param lengths: bytes of each frame, 0: silent.
        """
        starts = self._starts.get(slot)
        if starts is None:
            starts = self._starts[slot] = np.full(self._agents, np.nan)
            if len(self._starts) > _OPEN:
                self._sum_up(min(self._starts))
        silent = np.array(lengths) == 0
        starts[np.array(ids)[silent] - 1] = np.array(offsets_ns)[silent]
        for index in np.flatnonzero(~silent):
            self._sends.setdefault(slot, []).append((ids[index], offsets_ns[index]))

    def _sum_up(self, slot: int) -> None:
        """Nothing more will be told of a slot."""
        row = self._starts.pop(slot)
        usable = row[~np.isnan(row)]
        if len(usable) > 1:
            self._spread.append(usable.max() - usable.min())
        for agent, offset in self._sends.pop(slot, []):
            if len(usable):
                self._away.setdefault(agent, array("f")).append(offset - float(np.median(usable)))

    def summary(self) -> dict[str, Any]:
        """The results; None where nothing was reported.

        ``clock_spread_*_ms``: between the first and the last agent's start of the same slot, over all slots, and the
        largest of the last 50; ``send_offset_ms``: by agent, how far its frames left from the swarm's common time (the
        median of the slot's starts); ``sends_on_time_share``: frames within 1 ms of it.
        """
        for slot in sorted(self._starts):
            self._sum_up(slot)
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
