"""What frames do to each other at each receiver: reach, overlap, capture, a sender's own deafness."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import LocalProtocolError

from .config import ChannelConfig
from .topology import group_numbers, parse_partition, squared_distances

Mask = NDArray[np.bool_]
#: Distances below this are taken as this when powers are compared, m.
_NEAREST_M = 0.01


class OnAir(NamedTuple):
    """One transmission on the channel's time line."""

    sender: int
    """Id of the sender."""
    start_ns: int
    """The sender turns to sending, and stops hearing."""
    air_ns: int
    """The first bit is on air."""
    end_ns: int
    """The last bit has left; the sender hears again."""

    def overlaps(self, other: OnAir) -> bool:
        """True when both are on air at one time."""
        return self.air_ns < other.end_ns and other.air_ns < self.end_ns

    def deafens(self, other: OnAir) -> bool:
        """True when the sender of this one is busy with it while the other one is on air."""
        return self.start_ns < other.end_ns and other.air_ns < self.end_ns


class Medium:
    """Who reaches and who disturbs whom, under one set of settings.

    :param config: the settings.
    """

    __slots__ = (
        "_agents",
        "_capture",
        "_disturb2",
        "_exponent",
        "_groups",
        "_range2",
        "everywhere",
        "needs_positions",
    )

    def __init__(self, config: ChannelConfig) -> None:
        self._agents = config.agents
        self._range2 = config.range_m**2
        self._disturb2 = (config.range_m * config.interference_factor) ** 2
        self._capture = 10.0 ** (config.capture_db / 10.0) if config.capture_db else 0.0
        self._exponent = config.path_loss_exponent
        groups = parse_partition(config.partition, config.agents)
        self._groups = group_numbers(groups, config.agents) if groups else None
        self.needs_positions = bool(config.range_m or config.capture_db)
        #: True when everybody hears and disturbs everybody: two frames at one time destroy each other
        #: everywhere.
        self.everywhere = not self.needs_positions and self._groups is None

    def judge(self, frame: OnAir, others: Iterable[OnAir], positions: NDArray[np.float64] | None) -> tuple[Mask, Mask]:
        """Return (reach, collided), (N,) each: who would hear it alone, and who of these does not.

        :param frame: the transmission in question.
        :param others: transmissions that may overlap it.
        :param positions: (3, N), m, frame map; needed for range and capture only.
        """
        if self.needs_positions and positions is None:
            raise LocalProtocolError("a limited range and capture need the agents' positions")
        reach, power = self._heard(frame.sender, positions, self._range2)
        disturbed = np.zeros(self._agents, dtype=np.bool_)
        noise = np.zeros(self._agents)
        deaf = np.zeros(self._agents, dtype=np.bool_)
        for other in others:
            if other.deafens(frame):
                deaf[other.sender - 1] = True
            if other.overlaps(frame):
                heard, strength = self._heard(other.sender, positions, self._disturb2)
                disturbed |= heard
                if self._capture:
                    noise += np.where(heard, strength, 0.0)
        if self._capture:
            disturbed &= power < self._capture * noise
        return reach, reach & (disturbed | deaf)

    def _heard(
        self, sender: int, positions: NDArray[np.float64] | None, range2: float
    ) -> tuple[Mask, NDArray[np.float64]]:
        """Return who is near enough to a sender, (N,), and the power there, relative to that at 1 m."""
        heard = np.ones(self._agents, dtype=np.bool_)
        power = heard.astype(np.float64) if not self._capture else np.zeros(0)
        if self._groups is not None:
            heard &= self._groups == self._groups[sender - 1]
        if self.needs_positions and positions is not None:
            distance2 = squared_distances(positions, sender)
            if range2:
                heard &= distance2 <= range2
            if self._capture:
                power = np.maximum(distance2, _NEAREST_M**2) ** (-0.5 * self._exponent)
        heard[sender - 1] = False
        return heard, power
