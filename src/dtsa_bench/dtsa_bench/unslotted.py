"""Flights in which agents send at any instant: what is on the air in a slot, and who hears it.

Slots are the ticks of the flight: frames carry the state at the start of the slot in which they begin, and are heard in
the slot in which they arrive.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import AbstractSwarm
from dtsa_agent.core.abstract_swarm import SwarmWrapper
from dtsa_agent.core.plugins import PluginSwarm
from dtsa_agent.core.unslotted import next_wake
from dtsa_channel_sim import Channel
from dtsa_channel_sim.model.air import Air
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS


@dataclass(slots=True)
class Carried:
    """What the air carried in one slot."""

    senders: tuple[int, ...] = ()  # ids that began to send in it, each once
    lengths: list[int] = field(default_factory=list)  # bytes of the frames that began in it
    heard: list[tuple[bytes, NDArray[np.bool_]]] = field(default_factory=list)  # frames that arrived, and (N,) by whom
    outcome: int = IDLE  # SUCCESS: frames ended in it and none was disturbed; COLLISION: one was


class UnslottedTraffic:
    """Lets the policies of all agents act, on one medium.

    :param swarm: all agents, with an unslotted policy; each has a table of its own.
    :param channel: the medium.
    """

    def __init__(self, swarm: AbstractSwarm, channel: Channel) -> None:
        inside = swarm
        while isinstance(inside, SwarmWrapper) and not isinstance(inside, PluginSwarm):
            inside = inside.inner
        assert isinstance(inside, PluginSwarm)
        self._swarm, self._parts = swarm, inside
        self._slot_ns = swarm.config.slot_ns
        self._airtime = channel.config.airtime
        self._air: Air[int] = Air(channel)
        self._wakes = [(0, index) for index in range(len(swarm.ids))]
        heapify(self._wakes)
        self._free_ns = [0] * len(swarm.ids)  # when each radio has done with its last frame
        self._count = 0
        self._on_air: dict[int, bytes] = {}
        self._arriving: list[tuple[int, int, bytes, NDArray[np.bool_]]] = []  # heap by arrival
        self._frames: list[bytes] = []
        self._carried = Carried()
        self._began: set[int] = set()

    def slot(self, slot: int) -> Carried:
        """Everything that happens on the air in a slot; tables are as they were when it began.

        :param slot: its number; slots come one after the other.
        """
        swarm, end_ns = self._swarm, (slot + 1) * self._slot_ns
        self._carried, self._began = Carried(), set()
        swarm.sends[:] = swarm.present > 0
        swarm.emit(slot)
        self._frames = [swarm.frame(index) for index in range(len(swarm.ids))]
        while self._wakes[0][0] < end_ns:
            now_ns, index = heappop(self._wakes)
            heappush(self._wakes, (self._wake(index, now_ns, end_ns), index))
        self._settle(end_ns)
        while self._arriving and self._arriving[0][0] <= end_ns:
            _, _, frame, mask = heappop(self._arriving)
            self._carried.heard.append((frame, mask))
        self._carried.senders = tuple(swarm.ids[index] for index in sorted(self._began))
        swarm.sends[:] = 0
        swarm.sends[sorted(self._began)] = 1
        swarm.emit(slot)
        return self._carried

    def _wake(self, index: int, now_ns: int, end_ns: int) -> int:
        if not self._swarm.present[index]:
            return end_ns
        policy, table = self._parts.policies[index], self._parts.tables[index]
        return next_wake(policy, policy.wake(table, now_ns, _Radio(self, index, now_ns)), now_ns)

    def busy(self, index: int, now_ns: int) -> bool:
        """Whether a radio finds the air in use.

        :param index: position of its agent in ``ids``.
        :param now_ns: ns, now.
        """
        return self._air.busy(self._swarm.ids[index], now_ns, self._swarm.position)

    def send(self, index: int, now_ns: int) -> bool:
        """An agent begins to send its frame of this slot; False: it still sends another.

        :param index: its position in ``ids``.
        :param now_ns: ns, now.
        """
        frame = self._frames[index]
        if now_ns < self._free_ns[index] or not frame:
            return False
        self._settle(now_ns)
        self._count += 1
        self._air.begin(self._count, self._swarm.ids[index], now_ns, len(frame))
        self._free_ns[index] = now_ns + self._airtime.total_ns(len(frame))
        self._on_air[self._count] = frame
        self._began.add(index)
        self._carried.lengths.append(len(frame))
        return True

    def _settle(self, until_ns: int) -> None:
        for verdict in self._air.settle(until_ns, self._swarm.position):
            frame = self._on_air.pop(verdict.frame_id)
            if verdict.received.any():
                heappush(self._arriving, (verdict.arrival_ns, verdict.frame_id, frame, verdict.received))
            if verdict.collided or self._carried.outcome == COLLISION:
                self._carried.outcome = COLLISION
            else:
                self._carried.outcome = SUCCESS


class _Radio:
    """What a policy has of the radio while it acts; see :class:`~dtsa_agent.core.plugins.Radio`."""

    __slots__ = ("_index", "_now_ns", "_traffic")

    def __init__(self, traffic: UnslottedTraffic, index: int, now_ns: int) -> None:
        self._traffic, self._index, self._now_ns = traffic, index, now_ns

    def busy(self) -> bool:
        return self._traffic.busy(self._index, self._now_ns)

    def send(self) -> bool:
        return self._traffic.send(self._index, self._now_ns)
