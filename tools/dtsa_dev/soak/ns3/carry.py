"""Frames of a scheme on the simulated channel: when each begins, and who receives it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AbstractSwarm, SwarmConfig
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_bench.simulation.unslotted import UnslottedTraffic
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.medium import Medium, OnAir, Positions, Reception


@dataclass(slots=True)
class Traffic:
    """Frames of a run, in the order of their starts."""

    positions: list[list[float]]  # of each agent, m, frame map
    on_air_ns: int  # of a frame
    unit_ns: int  # in which a load of 1 begins one frame: a frame's time on the air, or a slot
    judged_ns: int  # every frame that begins before has been judged, and all that disturb it
    frames: list[tuple[int, int]] = field(default_factory=list)  # index of the sender, ns of the first bit
    received: list[NDArray[np.bool_]] = field(default_factory=list)  # (N,) by whom


class _Noting:
    """A medium that notes what it judges."""

    def __init__(self, medium: Medium, notes: list[tuple[OnAir, Reception]]) -> None:
        self._medium, self._notes = medium, notes
        self.senses = medium.senses

    def judge(self, slot: int, frame: OnAir, others: Sequence[OnAir], positions: Positions | None = None) -> Reception:
        """As the medium does."""
        found = self._medium.judge(slot, frame, others, positions)
        self._notes.append((frame, found))
        return found


class NotingChannel(Channel):
    """A channel whose medium notes what it judges."""

    __slots__ = ("_noting", "notes")

    def __init__(self, config: ChannelConfig) -> None:
        super().__init__(config)
        self.notes: list[tuple[OnAir, Reception]] = []
        self._noting = _Noting(super().medium(0), self.notes)

    def medium(self, slot: int) -> Any:
        """The noting one; settings do not change."""
        del slot
        return self._noting


def traffic(swarm_config: SwarmConfig, channel: ChannelConfig, slots: int) -> Traffic:
    """Lets a swarm that stands still send by its scheme.

    :param swarm_config: the swarm, with its policy.
    :param channel: the channel.
    :param slots: length of the run.
    """
    swarm, length = make_swarm(swarm_config), swarm_config.frame_length
    on_air_ns, end_ns = channel.airtime.on_air_ns(length), slots * channel.slot_ns
    unslotted = swarm_config.policy_row.unslotted
    found = Traffic(
        positions=swarm.position.T.tolist(),
        on_air_ns=on_air_ns,
        unit_ns=on_air_ns if unslotted else channel.slot_ns,
        judged_ns=end_ns - 2 * channel.airtime.total_ns(length) if unslotted else end_ns,
    )
    (_unslotted if unslotted else _slotted)(swarm, channel, slots, found)
    return found


def _unslotted(swarm: AbstractSwarm, config: ChannelConfig, slots: int, found: Traffic) -> None:
    channel = NotingChannel(config)
    air = UnslottedTraffic(swarm, channel)
    for slot in range(slots):
        air.slot(slot)
    for frame, reception in sorted(channel.notes, key=lambda note: (note[0].air_ns, note[0].sender)):
        found.frames.append((frame.sender - 1, frame.air_ns))
        found.received.append(reception.received)


def _slotted(swarm: AbstractSwarm, config: ChannelConfig, slots: int, found: Traffic) -> None:
    channel, agents = Channel(config), config.agents
    for slot in range(slots):
        sending = swarm.begin(slot)
        senders = [swarm.ids[index] for index in sending]
        frames = [swarm.frame(index) for index in sending]
        mask = channel.arbitrate(slot, senders, [len(frame) for frame in frames], swarm.position).mask(agents)
        for sender, frame, heard in zip(senders, frames, mask, strict=True):
            swarm.hear(slot, frame, heard)
            found.frames.append((sender - 1, slot * config.slot_ns + config.ramp_up_ns))
            found.received.append(heard)
        swarm.end(slot)
