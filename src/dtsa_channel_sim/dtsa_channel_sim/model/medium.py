"""The medium: what transmissions do to each other at each receiver, at any instant.

This is the one place that says how long a frame is on air, who is in reach, what overlap does, when the stronger of two
frames survives, that a sender does not hear, when a radio finds the air busy, and what noise takes away.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import LocalProtocolError

from .airtime import Airtime
from .config import ChannelConfig
from .losses import Losses

Mask = NDArray[np.bool_]
Positions = NDArray[np.float64]
#: Distances below this are taken as this when powers are compared, m.
_NEAREST_M = 0.01
_NO_POWER = np.zeros(0)


class OnAir(NamedTuple):
    """One transmission on the channel's time line."""

    sender: int  # id
    start_ns: int  # the sender turns to sending, and stops hearing
    air_ns: int  # the first bit is on air
    end_ns: int  # the last bit has left; the sender hears again

    @classmethod
    def of(cls, airtime: Airtime, sender: int, start_ns: int, length: int) -> OnAir:
        """The transmission of a frame of some bytes; its sender turns to sending at ``start_ns``."""
        return cls(sender, start_ns, start_ns + airtime.ramp_up_ns, start_ns + airtime.total_ns(length))

    def overlaps(self, other: OnAir) -> bool:
        """True when both are on air at one time."""
        return self.air_ns < other.end_ns and other.air_ns < self.end_ns

    def deafens(self, other: OnAir) -> bool:
        """True when the sender of this one is busy with it while the other one is on air."""
        return self.start_ns < other.end_ns and other.air_ns < self.end_ns


class Reception(NamedTuple):
    """What became of one transmission at all receivers."""

    received: Mask  # (N,) agent with id index + 1 received it
    lost: int  # receivers in reach that lost it to noise or jamming
    collided: int  # receivers in reach where it collided, or that were sending themselves


class Medium:
    """Who receives what, under one set of settings.

    Positions are (3, N), m, frame map; needed for range and capture only.
    """

    __slots__ = (
        "_agents", "_capture", "_disturb2", "_exponent", "_groups", "_jam", "_range2", "everywhere", "losses",
        "needs_positions",
    )  # fmt: skip

    def __init__(self, config: ChannelConfig) -> None:
        self._agents = config.agents
        self._range2 = config.range_m**2
        self._disturb2 = (config.range_m * config.interference_factor) ** 2
        self._capture = 10.0 ** (config.capture_db / 10.0) if config.capture_db else 0.0
        self._exponent = config.path_loss_exponent
        self._jam = config.jam
        self._groups = np.zeros(config.agents, dtype=np.int32)  # number of each agent's
        for number, group in enumerate(config.groups):
            self._groups[np.asarray(group) - 1] = number
        #: Which receivers lose a frame to noise.
        self.losses = Losses(config)
        self.needs_positions = config.needs_positions
        #: True when everybody hears and disturbs everybody: two frames at one time destroy each other
        #: everywhere.
        self.everywhere = not self.needs_positions and not config.groups

    def resolve(
        self, slot: int, frame: OnAir, others: Sequence[OnAir], positions: Positions | None = None
    ) -> Reception:
        """Return what became of one transmission among others that may overlap it, by the random numbers of a slot.

        :raises LocalProtocolError: when positions are needed and missing.
        """
        clear, collided = self._undisturbed(frame, others, positions)
        if self._jam:
            received = np.zeros_like(clear)
        elif self.losses.none:
            return Reception(clear, 0, collided)
        else:
            received = clear & ~self.losses.lost(slot, frame.sender)
        return Reception(received, int(np.count_nonzero(clear) - np.count_nonzero(received)), collided)

    def reach(self, sender: int, positions: Positions | None = None) -> Mask:
        """Return who hears an agent alone on the air but for noise, (N,)."""
        return self._strength_of(sender, positions, self._range2)[0]

    def senses(self, receiver: int, when_ns: int, frame: OnAir, positions: Positions | None = None) -> bool:
        """Return whether a radio that listens finds the air busy with a transmission.

        A radio that sends itself, or turns to sending, cannot listen: its air is busy.
        """
        if frame.sender == receiver:
            return frame.start_ns <= when_ns < frame.end_ns
        if not frame.air_ns <= when_ns < frame.end_ns:
            return False
        return self.everywhere or bool(self._strength_of(frame.sender, positions, self._disturb2)[0][receiver - 1])

    def _undisturbed(self, frame: OnAir, others: Sequence[OnAir], positions: Positions | None) -> tuple[Mask, int]:
        """Return who hears a transmission but for noise, (N,), and how many in its reach do not."""
        reach, power = self._strength_of(frame.sender, positions, self._range2)
        if not others:
            return reach, 0
        disturbed = np.zeros(self._agents, dtype=np.bool_)
        noise = np.zeros(self._agents) if self._capture else _NO_POWER
        deaf = []  # indices of those that send meanwhile
        for other in others:
            if other.deafens(frame):
                deaf.append(other.sender - 1)
            if other.overlaps(frame):
                heard, strength = self._strength_of(other.sender, positions, self._disturb2)
                disturbed |= heard
                if self._capture:
                    noise += np.where(heard, strength, 0.0)
        if self._capture:
            disturbed &= power < self._capture * noise
        if deaf:
            disturbed[deaf] = True
        collided = reach & disturbed
        return reach & ~collided, int(np.count_nonzero(collided))

    def _strength_of(self, sender: int, positions: Positions | None, range2: float) -> tuple[Mask, NDArray[np.float64]]:
        """Return who is near enough to a sender, (N,), and the power there, relative to that at 1 m (with capture)."""
        heard, power = self._groups == self._groups[sender - 1], _NO_POWER
        if self.needs_positions:
            if positions is None:
                raise LocalProtocolError("a limited range and capture need the agents' positions")
            offset = positions - positions[:, sender - 1 : sender]
            distance2 = offset[0] ** 2 + offset[1] ** 2 + offset[2] ** 2
            if range2:
                heard &= distance2 <= range2
            if self._capture:
                power = np.maximum(distance2, _NEAREST_M**2) ** (-0.5 * self._exponent)
        heard[sender - 1] = False
        return heard, power
