"""Messages of any kind over the shared medium: access to it, collisions, noise.

Pure code. Times are ns on a clock of the caller that never runs back; positions are (3, N), m; agents are ids from 1.
Noise is drawn by (seed, topic, sender, receiver, number of the message) alone: the same messages are lost whenever
they are sent.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import setting
from dtsa_agent.core.swarm import Swarm
from dtsa_channel_sim.model.air import NEVER, Air, Arrivals
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.config import ChannelConfig
from dtsa_channel_sim.model.medium import Mask, Medium, Positions

SLOTTED = ("tdma", "age", "error", "lease")
ACCESS = ("unlimited", *SLOTTED, "csma", "aloha")
#: What becomes of messages. dropped: newer ones came, or a radio found no free air; delayed: waited for the air.
COUNTS = ("sent", "received", "lost", "collided", "out_of_range", "dropped", "delayed")
_MAX_AGENTS = 255  # ids in the header of lease have 8 bits
_FIXED = {"agents", "jam", "schedule"}  # settings of the channel that messages do not have
_MAX_BACKOFFS, _MIN_EXPONENT, _MAX_EXPONENT = 4, 3, 5  # CSMA/CA without slots of IEEE 802.15.4


@dataclass(frozen=True, slots=True, repr=False)
class MessageChannel(ChannelConfig):
    """Settings of a channel for messages: those of any channel, and how agents share it."""

    slot_ns: int = setting(10_000_000, "length of a slot", unit="ns", minimum=300_000, maximum=10**9)
    access: str = setting(
        "unlimited", "who sends when; unlimited: messages do not disturb each other", choices=ACCESS, group="Access"
    )
    queue: int = setting(4, "messages of a topic that wait; newer ones replace the oldest", minimum=1, maximum=1000)
    longest: int = setting(4096, "longest message", unit="bytes", minimum=1, maximum=1 << 20)
    delay_ms: float = setting(0.0, "added to every delivery", unit="ms", minimum=0.0, maximum=60_000.0)
    backoff_ms: float = setting(0.32, "csma: unit of random waits", unit="ms", minimum=0.001, maximum=1000.0)

    @classmethod
    def of(cls, values: Mapping[str, Any], agents: int) -> MessageChannel:
        """Return the settings that plain values mean for a number of agents; or raise ConfigError."""
        if not 2 <= agents <= _MAX_AGENTS:
            raise ConfigError("robots", agents, f"2 to {_MAX_AGENTS}")
        for name in values.keys() & _FIXED:
            raise ConfigError(name, values[name], "no such setting of messages")
        return cls.from_dict({**values, "agents": agents})


@dataclass(frozen=True, slots=True, eq=False)
class RadioMessage:
    """A message that an agent sends to others."""

    sender: int  # id
    topic: str  # names, with the number, the draws of its losses
    number: int
    length: int  # bytes on the air
    at_ns: int  # when it is given to the radio
    receivers: Mask  # (N,)
    payload: Any = None


class Transport:
    """The medium between N agents. Call :meth:`send` and :meth:`advance` in the order of their times."""

    def __init__(self, config: MessageChannel) -> None:
        agents, self.config = config.agents, config
        self.counts = {name: np.zeros((agents, agents), np.int64) for name in (*COUNTS, "delay_ns")}  # delay: sum
        self.newest = np.full((agents, agents), None)  # [receiver, sender]: newest message that has come; None: none
        self._heard_ns = np.full(agents, -1)  # when the newest message of each was sent that any agent received
        # Noise is drawn by messages, not by slots.
        quiet = Channel(replace(config, loss=0.0, burst_length=0.0, link_loss=(), loss_matrix=(), losses=""))
        self._airtime = config.airtime.of_messages(config.longest)
        self._air: Air[tuple[RadioMessage, bytes]] = Air(quiet, self._airtime)  # a frame's key: message, header
        self._media: dict[str, Medium] = {}  # reach and noise, by topic
        self._queues: list[deque[RadioMessage]] = [deque() for _ in range(agents)]
        self._free_ns = [0] * agents  # when each radio has done with its last message
        self._begin_ns = [NEVER] * agents  # when each radio begins the message at hand; under csma: listens
        self._backoffs = [0] * agents  # of csma, for that message
        self._random = [np.random.default_rng([config.seed, 802, agent]) for agent in range(agents)]
        self._arriving = Arrivals()  # messages, and (N,) their receivers
        self._slot = self._header_length = 0
        self._positions: Positions | None = None
        self._sent_positions = np.zeros((3, agents))  # of each agent's last message, m
        self._slotted, self._swarm = config.access in SLOTTED, None
        if config.access == "lease":
            swarm = SwarmConfig(agents, policy="lease", seed=config.seed, slot_ms=config.slot_ns / 1e6, extent_m=1e4)
            self._swarm, self._header_length = Swarm(swarm), swarm.frame_length
            self._active_until = np.full(agents, -1)  # slot until which each has something to send

    def check_length(self, length: int, name: str = "bytes") -> None:
        """Raise ConfigError if messages of some bytes cannot be sent."""
        if not 1 <= length <= self.config.longest:
            raise ConfigError(name, length, f"1 to {self.config.longest}, which is longest")
        on_air_ns, slot_ns = self._airtime.total_ns(length + self._header_length), self.config.slot_ns
        if self._slotted and on_air_ns > slot_ns:
            header = f" with a header of {self._header_length}" * bool(self._header_length)
            times = f"these{header} take {on_air_ns / 1e6:.3g} ms, a slot has {slot_ns / 1e6:g} ms"
            raise ConfigError(name, length, f"bytes that fit into a slot: {times}")

    def send(self, message: RadioMessage) -> None:
        """Give a message to its sender's radio; ConfigError: it is too long, and nothing has happened."""
        self.check_length(message.length)
        index = message.sender - 1
        queue = self._queues[index]
        self.counts["sent"][index] += message.receivers
        waiting = [other for other in queue if other.topic == message.topic]
        if len(waiting) >= self.config.queue and self.config.access != "unlimited":  # where none waits for the air
            queue.remove(waiting[0])
            self.counts["dropped"][index] += waiting[0].receivers
        queue.append(message)
        if self._begin_ns[index] == NEVER:
            self._schedule(index)

    def advance(self, until_ns: int, positions: Positions | None = None) -> list[tuple[RadioMessage, Mask]]:
        """Let time come to ``until_ns``; return what has arrived, in order, and its receivers, (N,)."""
        self._positions = positions
        while (now_ns := self._next_ns) <= until_ns:
            if self._slotted:
                self._begin_slot(now_ns)
            else:
                self._begin_radio(self._begin_ns.index(now_ns), now_ns)
        self._resolve(until_ns)
        arrived = self._arriving.pop(until_ns)
        for message, received in arrived:
            known = self.newest[:, message.sender - 1]
            is_newer = [other is None or other.at_ns <= message.at_ns for other in known]  # longer ones take longer
            known[received & is_newer] = message
        return arrived

    @property
    def due_ns(self) -> int:
        """Until when to advance next: before that nothing happens unless a message is sent."""
        return min(self._next_ns, self._air.due_ns, self._arriving.next_ns)

    # Access.

    @property
    def _next_ns(self) -> int:
        """When the next slot begins, or the next radio."""
        return self._slot * self.config.slot_ns if self._slotted else min(self._begin_ns)

    def _begin_slot(self, now_ns: int) -> None:
        self._resolve(now_ns)
        ready = [bool(queue) and queue[0].at_ns <= now_ns for queue in self._queues]
        for index in self._senders(ready, now_ns):
            silent = RadioMessage(index + 1, "", self._slot, 0, now_ns, np.zeros(len(ready), np.bool_))
            self._begin(now_ns, self._queues[index].popleft() if ready[index] else silent)
        self._slot += 1

    def _senders(self, ready: list[bool], now_ns: int) -> tuple[int, ...]:
        """Return the senders of the slot that begins now, indices; under lease also some with nothing to send."""
        slot, agents = self._slot, len(ready)
        if self._swarm is not None:
            if slot:
                self._swarm.end(slot - 1)
            # Agents that have something to send are far from their goals; not to change with each message, two rounds.
            self._active_until[ready] = slot + 2 * agents
            self._swarm.goal[:] = self._swarm.position + np.where(self._active_until >= slot, 1e3, 0.0)
            return self._swarm.begin(slot)
        if self.config.access == "tdma":
            return (slot % agents,) if ready[slot % agents] else ()
        # A coordinator that knows what was received: the agent that has been silent for longest, or has moved farthest.
        urgency = now_ns - self._heard_ns
        if self.config.access == "error" and self._positions is not None:
            urgency = np.linalg.norm(np.nan_to_num(self._positions) - self._sent_positions, axis=0)
        found = [index for index, is_ready in enumerate(ready) if is_ready]  # of equal ones the one that rested longer
        return (max(found, key=lambda index: (urgency[index], -self._free_ns[index])),) if found else ()

    def _begin_radio(self, index: int, now_ns: int) -> None:
        """Let a radio begin its message; under csma it listens first, and waits longer or gives up at a busy air."""
        message = self._queues[index][0]
        if self.config.access != "csma" or not self._air.busy(index + 1, now_ns, self._positions):
            self._begin(max(now_ns, message.at_ns), message)
        elif self._backoffs[index] < _MAX_BACKOFFS:
            self._schedule(index, now_ns + 1, self._backoffs[index] + 1)
            return
        else:
            self.counts["dropped"][index] += message.receivers
        self._queues[index].popleft()
        self._schedule(index, now_ns)

    def _schedule(self, index: int, from_ns: int = 0, backoffs: int = 0) -> None:
        """Say when a radio begins, or listens for, the next message that it has."""
        self._backoffs[index], self._begin_ns[index] = backoffs, NEVER
        if self._queues[index]:
            self._begin_ns[index] = max(self._queues[index][0].at_ns, self._free_ns[index], from_ns)
            if self.config.access == "csma":
                choices = 2 ** min(_MIN_EXPONENT + backoffs, _MAX_EXPONENT)
                unit_ns = round(self.config.backoff_ms * 1e6)
                self._begin_ns[index] += int(self._random[index].integers(choices)) * unit_ns

    # Delivery.

    def _begin(self, start_ns: int, message: RadioMessage) -> None:
        """Put a message on the air, behind a header under lease."""
        index, length = message.sender - 1, self._header_length + message.length
        if self.config.access == "unlimited":
            end_ns = start_ns + self._airtime.total_ns(length)
            self._account(message, None, start_ns, end_ns + self._airtime.from_radio_ns(length))
            return
        header = self._swarm.frame(index) if self._swarm else b""
        self._air.begin((message, header), message.sender, start_ns, length)
        self._free_ns[index] = start_ns + self._airtime.total_ns(length)
        if self._positions is not None:
            self._sent_positions[:, index] = np.nan_to_num(self._positions[:, index])

    def _resolve(self, until_ns: int) -> None:
        for verdict in self._air.resolve(until_ns, self._positions):
            message, header = verdict.frame_id
            received = self._account(message, verdict.received, verdict.start_ns, verdict.arrival_ns)
            if self._swarm is not None:
                self._swarm.hear(self._slot - 1, header, received.view(np.uint8))

    def _account(self, message: RadioMessage, undisturbed: Mask | None, start_ns: int, arrival_ns: int) -> Mask:
        """Count a message that has left the air, and let it arrive; return the agents that received it, (N,).

        ``undisturbed``: agents in reach where it did not collide, (N,); None: all in reach.
        """
        row, receivers, medium = message.sender - 1, message.receivers, self._medium_of(message.topic)
        reach = medium.reach(message.sender, self._positions)
        clear = reach if undisturbed is None else undisturbed
        noise = medium.losses.lost(message.number, message.sender)
        received: Mask = receivers & clear & ~noise
        arrival_ns += round(self.config.delay_ms * 1e6)
        for name, values in (
            ("out_of_range", receivers & ~reach), ("collided", receivers & reach & ~clear),
            ("lost", receivers & clear & noise), ("received", received),
            ("delayed", receivers * (start_ns > message.at_ns)), ("delay_ns", received * (arrival_ns - message.at_ns)),
        ):  # fmt: skip
            self.counts[name][row] += values
        if received.any():
            self._heard_ns[row] = max(self._heard_ns[row], message.at_ns)
            self._arriving.add(arrival_ns, (message, received))
        return clear & ~noise

    def _medium_of(self, topic: str) -> Medium:
        """Return the medium as messages of a topic find it: noise is drawn for each topic."""
        if topic not in self._media:
            digest = hashlib.sha256(f"{self.config.seed} {topic}".encode()).digest()
            self._media[topic] = Medium(replace(self.config, seed=int.from_bytes(digest[:8], "little") >> 1))
        return self._media[topic]
