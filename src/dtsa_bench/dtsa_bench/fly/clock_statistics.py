"""How well agents on their own clocks keep together: from the times that they report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_channel_sim.ros.observer import ChannelObserver

ON_TIME_NS = 1_000_000  # a frame this far from the swarm's common time is not on time any more
_END = 50  # slots


class ClockStatistics(ChannelObserver):
    """Collects when slots start and frames leave, and sums it up.

    :param agents: number of agents N.
    """

    def __init__(self, agents: int) -> None:
        self._agents = agents
        self._starts: dict[int, NDArray[np.float64]] = {}  # (N,) ns by slot: own slot's start where silent
        self._sends: list[tuple[int, int, int]] = []  # slot, agent's id, ns

    def report(self, message: Any) -> None:
        self.add(message.slot, message.agent, message.offset_ns, message.length)

    def add(self, slot: int, ids: Sequence[int], offsets_ns: Sequence[int], lengths: Sequence[int]) -> None:
        """Takes in one report.

        :param slot: as its agents count.
        :param ids: of the agents.
        :param offsets_ns: ns, of each agent's slot from the channel's; of its transmission, if it sends.
        :param lengths: bytes of each frame, 0: silent.
        """
        starts = self._starts.get(slot)
        if starts is None:
            starts = self._starts[slot] = np.full(self._agents, np.nan)
        for agent, offset, length in zip(ids, offsets_ns, lengths, strict=True):
            if length:
                self._sends.append((slot, agent, offset))
            else:
                starts[agent - 1] = offset

    def summary(self) -> dict[str, Any]:
        """The results; None where nothing was reported.

        ``clock_spread_*_ms``: between the first and the last agent's start of the same slot, over all slots, and the
        largest of the last 50; ``send_offset_ms``: by agent, how far its frames left from the swarm's common time (the
        median of the slot's starts); ``sends_on_time_share``: frames within 1 ms of it.
        """
        usable = {slot: row[~np.isnan(row)] for slot, row in sorted(self._starts.items())}
        spread = np.array([row.max() - row.min() for row in usable.values() if len(row) > 1]) / 1e6
        common = {slot: float(np.median(row)) for slot, row in usable.items() if len(row)}
        away: dict[int, list[float]] = {}
        for slot, agent, offset in self._sends:
            if slot in common:
                away.setdefault(agent, []).append(offset - common[slot])
        every = np.array([value for values in away.values() for value in values])
        return {
            "clock_spread_max_ms": float(spread.max()) if len(spread) else None,
            "clock_spread_mean_ms": float(spread.mean()) if len(spread) else None,
            "clock_spread_end_ms": float(spread[-_END:].max()) if len(spread) else None,
            "sends_on_time_share": float((np.abs(every) <= ON_TIME_NS).mean()) if len(every) else None,
            "send_offset_ms": {
                str(agent): {"median": float(np.median(values)) / 1e6, "max": float(max(values, key=abs)) / 1e6}
                for agent, values in sorted(away.items())
            },
        }
