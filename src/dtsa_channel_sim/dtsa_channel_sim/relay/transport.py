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
from heapq import heappop, heappush
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Settings, setting, settings_of
from dtsa_agent.core.swarm import Swarm
from dtsa_channel_sim.model.air import NEVER, Air
from dtsa_channel_sim.model.airtime import Airtime
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.config import ChannelConfig
from dtsa_channel_sim.model.losses import Losses, NoiseSource
from dtsa_channel_sim.model.medium import Mask, Positions

SLOTTED = ("tdma", "age", "error", "lease")
ACCESS = ("unlimited", *SLOTTED, "csma", "aloha")
MAX_AGENTS = 255  # ids in the header of lease have 8 bits
#: What becomes of messages. dropped: newer ones came, or a radio found no free air; delayed: waited for the air.
COUNTS = ("sent", "received", "lost", "collided", "out_of_range", "dropped", "delayed")
_FIXED = ("agents", "slot_ns", "jam", "schedule")  # settings of the channel that messages do not have
_MAX_BACKOFFS, _MIN_EXPONENT, _MAX_EXPONENT = 4, 3, 5  # CSMA/CA without slots of IEEE 802.15.4


@dataclass(frozen=True, slots=True)
class AccessSettings(Settings):
    """How agents share the medium."""

    access: str = setting(
        "unlimited", "which node sends when; unlimited: messages do not disturb each other", choices=ACCESS
    )
    slot_ms: float = setting(10.0, "length of a slot", unit="ms", minimum=0.3, maximum=1000.0)
    queue: int = setting(4, "messages of a topic that wait; newer ones replace the oldest", minimum=1, maximum=1000)
    longest: int = setting(4096, "longest message", unit="bytes", minimum=1, maximum=1 << 20)
    delay_ms: float = setting(0.0, "added to every delivery", unit="ms", minimum=0.0, maximum=60_000.0)
    backoff_ms: float = setting(0.32, "csma: unit of random waits", unit="ms", minimum=0.001, maximum=1000.0)


def read_settings(values: Mapping[str, Any], agents: int) -> tuple[AccessSettings, ChannelConfig]:
    """Return settings of access and channel, given in one mapping, for a number of agents; or raise ConfigError."""
    if not 2 <= agents <= MAX_AGENTS:
        raise ConfigError("robots", agents, f"2 to {MAX_AGENTS}")
    for name in values.keys() & set(_FIXED):
        raise ConfigError(name, values[name], "no such setting of messages")
    channel = dict(values)
    own = {spec.name: channel.pop(spec.name) for spec in settings_of(AccessSettings) if spec.name in values}
    access = AccessSettings(**own)
    return access, ChannelConfig.from_dict({**channel, "agents": agents, "slot_ms": access.slot_ms})


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

    def __init__(self, access: AccessSettings, config: ChannelConfig) -> None:
        agents, self.access, self.config = config.agents, access, config
        self.counts = {name: np.zeros((agents, agents), np.int64) for name in (*COUNTS, "delay_ns")}  # delay: sum
        self.newest_ns = np.full((agents, agents), -1)  # [receiver, sender]: when its newest message was sent; -1: none
        # Noise is drawn by messages, not by slots.
        channel = Channel(replace(config, loss=0.0, burst_length=0.0, link_loss=(), loss_matrix=(), losses=""))
        self._medium, self._airtime = channel.medium(0), _airtime_of_messages(config.airtime, access.longest)
        # A frame's key: slot, index of the sender, header, message.
        self._air: Air[tuple[int, int, bytes, RadioMessage | None]] = Air(channel, self._airtime)
        self._noise: dict[str, Losses] = {}  # by topic
        self._queues: list[deque[RadioMessage]] = [deque() for _ in range(agents)]
        self._free_ns = [0] * agents  # when each radio has done with its last message
        self._now_ns = self._arrival_count = self._slot = 0
        self._arriving: list[tuple[int, int, RadioMessage, Mask]] = []  # a heap by arrival
        self._positions: Positions | None = None
        self._sent_positions = np.zeros((3, agents))  # of each agent's last message, m
        self._slotted, self._swarm, self._header_length = access.access in SLOTTED, None, 0
        if access.access == "lease":
            settings = SwarmConfig(
                agents=agents, policy="lease", seed=config.seed, slot_ms=access.slot_ms, extent_m=1e4
            )
            self._swarm, self._header_length = Swarm(settings), settings.frame_length
            self._received_headers: list[tuple[bytes, Mask]] = []  # in this slot
            self._active_until = np.full(agents, -1)  # slot until which each has something to send
        self._random = [np.random.default_rng([config.seed, 802, agent]) for agent in range(agents)]
        self._backoffs = [0] * agents  # of csma, for the message at hand
        self._listen_ns = [NEVER] * agents  # when each radio listens, under csma

    def fault_of(self, length: int) -> str:
        """Return why messages of some bytes cannot be sent; empty: they can."""
        if not 1 <= length <= self.access.longest:
            return f"{length} bytes; longest allows 1 to {self.access.longest}"
        on_air_ns = self._airtime.total_ns(length + self._header_length)
        if self._slotted and on_air_ns > self.config.slot_ns:
            header = f" and the header of {self._header_length}" * bool(self._header_length)
            return f"{length} bytes{header} take {on_air_ns / 1e6:.3g} ms, a slot has {self.access.slot_ms:g} ms"
        return ""

    def send(self, message: RadioMessage) -> None:
        """Give a message, which ``fault_of`` lets through, to its sender's radio."""
        queue = self._queues[message.sender - 1]
        self.counts["sent"][message.sender - 1] += message.receivers
        waiting = [other for other in queue if other.topic == message.topic]
        if len(waiting) >= self.access.queue and self.access.access != "unlimited":  # where none waits for the air
            queue.remove(waiting[0])
            self._drop(waiting[0])
        queue.append(message)

    def _drop(self, message: RadioMessage) -> None:
        self.counts["dropped"][message.sender - 1] += message.receivers

    def advance(self, until_ns: int, positions: Positions | None = None) -> list[tuple[RadioMessage, Mask]]:
        """Let time come to ``until_ns``; return what has arrived, in order, and its receivers, (N,)."""
        self._positions = positions
        csma = self.access.access == "csma"
        (self._run_slots if self._slotted else self._run_csma if csma else self._run_unscheduled)(until_ns)
        self._resolve(until_ns)
        self._now_ns = until_ns
        arrived = []
        while self._arriving and self._arriving[0][0] <= until_ns:
            arrived.append(heappop(self._arriving)[2:])
        return arrived

    @property
    def due_ns(self) -> int:
        """Until when to advance next: before that nothing happens unless a message is sent."""
        due = [self._air.due_ns, self._arriving[0][0] if self._arriving else NEVER]
        if self._slotted:
            return min(*due, self._slot * self.config.slot_ns)
        radios = zip(self._queues, self._free_ns, self._listen_ns, strict=True)
        waiting = (max(queue[0].at_ns, free) if ns == NEVER else ns for queue, free, ns in radios if queue)
        return min(*due, *waiting)

    # Access.

    def _run_slots(self, until_ns: int) -> None:
        while (now_ns := self._slot * self.config.slot_ns) <= until_ns:
            self._resolve(now_ns)
            ready = [bool(queue) and queue[0].at_ns <= now_ns for queue in self._queues]
            for index in self._senders(ready, now_ns):
                self._begin(index, now_ns, self._queues[index].popleft() if ready[index] else None)
            self._slot += 1

    def _senders(self, ready: list[bool], now_ns: int) -> tuple[int, ...]:
        """Return the senders of the slot that begins now, indices; under lease also some with nothing to send."""
        slot, agents = self._slot, len(ready)
        if self._swarm is not None:
            for header, received in self._received_headers:
                self._swarm.hear(slot - 1, header, received.astype(np.uint8))
            self._received_headers.clear()
            if slot:
                self._swarm.end(slot - 1)
            # Agents that have something to send are far from their goals; not to change with each message, two rounds.
            self._active_until[ready] = slot + 2 * agents
            self._swarm.goal[:] = self._swarm.position + np.where(self._active_until >= slot, 1e3, 0.0)
            return self._swarm.begin(slot)
        if self.access.access == "tdma":
            return (slot % agents,) if ready[slot % agents] else ()
        # A coordinator that knows what was received: the agent that has been silent for longest, or has moved farthest.
        urgency = now_ns - self.newest_ns.max(axis=0)
        if self.access.access == "error" and self._positions is not None:
            urgency = np.linalg.norm(np.nan_to_num(self._positions) - self._sent_positions, axis=0)
        return (int(np.where(ready, urgency, -np.inf).argmax()),) if any(ready) else ()

    def _run_unscheduled(self, until_ns: int) -> None:
        """Messages begin as soon as the radio has done with the one before; without limits, all at once."""
        for index, queue in enumerate(self._queues):
            while queue and (start_ns := max(queue[0].at_ns, self._free_ns[index], self._now_ns)) <= until_ns:
                message = queue.popleft()
                if self.access.access == "aloha":
                    self._begin(index, start_ns, message)
                else:
                    on_air_ns = self._airtime.total_ns(message.length) + self._airtime.from_radio_ns(message.length)
                    self._account(message, None, start_ns, start_ns + on_air_ns)

    def _run_csma(self, until_ns: int) -> None:
        """Radios listen after a random wait and begin if they find the air free; else they wait longer, or give up."""
        while True:
            for index, queue in enumerate(self._queues):
                if queue and self._listen_ns[index] == NEVER:
                    self._backoffs[index] = 0
                    self._back_off(index, max(queue[0].at_ns, self._free_ns[index], self._now_ns))
            if (now_ns := min(self._listen_ns)) > until_ns:
                return
            index = self._listen_ns.index(now_ns)
            if not self._air.busy(index + 1, now_ns, self._positions):
                self._begin(index, now_ns, self._queues[index].popleft())
                self._listen_ns[index] = NEVER
                continue
            self._backoffs[index] += 1
            self._back_off(index, now_ns + 1)
            if self._backoffs[index] > _MAX_BACKOFFS:
                self._drop(self._queues[index].popleft())
                self._listen_ns[index] = NEVER

    def _back_off(self, index: int, now_ns: int) -> None:
        exponent = min(_MIN_EXPONENT + self._backoffs[index], _MAX_EXPONENT)
        unit_ns = round(self.access.backoff_ms * 1e6)
        self._listen_ns[index] = now_ns + int(self._random[index].integers(2**exponent)) * unit_ns

    # Delivery.

    def _begin(self, index: int, start_ns: int, message: RadioMessage | None) -> None:
        """Put a message, a header or both on the air."""
        length = self._header_length + (message.length if message else 0)
        header = self._swarm.frame(index) if self._swarm else b""
        self._air.begin((self._slot, index, header, message), index + 1, start_ns, length)
        self._free_ns[index] = start_ns + self._airtime.total_ns(length)
        if self._positions is not None:
            self._sent_positions[:, index] = np.nan_to_num(self._positions[:, index])

    def _resolve(self, until_ns: int) -> None:
        for verdict in self._air.resolve(until_ns, self._positions):
            slot, _, header, message = verdict.frame_id
            if message is None:
                received = verdict.received & ~self._lost("", verdict.sender, slot)
            else:
                received = self._account(message, verdict.received, verdict.start_ns, verdict.arrival_ns)
            if self._swarm is not None:
                self._received_headers.append((header, received))

    def _account(self, message: RadioMessage, clear: Mask | None, start_ns: int, arrival_ns: int) -> Mask:
        """Count a message that left the air and let it arrive, where it did not collide (``clear``; None: everywhere).

        Return the agents that received it, addressed or not, (N,).
        """
        row, receivers = message.sender - 1, message.receivers
        reach = self._medium.reach(message.sender, self._positions)
        clear = reach if clear is None else clear
        noise = self._lost(message.topic, message.sender, message.number)
        received: Mask = receivers & clear & ~noise
        arrival_ns += round(self.access.delay_ms * 1e6)
        for name, values in (
            ("out_of_range", receivers & ~reach), ("collided", receivers & reach & ~clear),
            ("lost", receivers & clear & noise), ("received", received),
            ("delayed", receivers * (start_ns > message.at_ns)), ("delay_ns", received * (arrival_ns - message.at_ns)),
        ):  # fmt: skip
            self.counts[name][row] += values
        if received.any():
            self.newest_ns[received, row] = np.maximum(self.newest_ns[received, row], message.at_ns)
            self._arrival_count += 1
            heappush(self._arriving, (arrival_ns, self._arrival_count, message, received))
        return clear & ~noise

    def _lost(self, topic: str, sender: int, number: int) -> Mask:
        """Return which receivers lose a message to noise, (N,)."""
        if topic not in self._noise:
            digest = hashlib.sha256(f"{self.config.seed} {topic}".encode()).digest()
            source = NoiseSource(int.from_bytes(digest[:8], "little") >> 1, self.config.agents)
            self._noise[topic] = Losses(self.config, source)
        mask: Mask = self._noise[topic].lost(number, sender)[0]
        return mask


def _airtime_of_messages(radio: Airtime, longest: int) -> Airtime:
    """Return the times of whole messages: the radio sends them in packets, back to back."""

    def on_air_ns(length: int) -> int:
        full, rest = divmod(length, radio.longest)
        packets = [radio.longest] * full + [rest] * bool(rest)
        return sum(map(radio.total_ns, packets)) - radio.ramp_up_ns

    return replace(radio, longest=longest + 255, formula=on_air_ns)  # a header at most beside the message
