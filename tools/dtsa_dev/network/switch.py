"""The switch between the hosts of a trial: it is the channel model's medium.

A frame of a host is on the air for as long as its length takes; half duplex; frames that overlap at a receiver destroy
each other there. Losses, partitions and jamming are those of the channel's settings. Delivery may be delayed, and
doubled, by link. Everything but datagrams to the swarm's group is left out: nothing else is on the air.
"""

from __future__ import annotations

import heapq
import os
import random
import select
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from dtsa_agent.air.port import HEADER
from dtsa_agent.core.frame import named_in
from dtsa_agent.priority import wake_precisely
from dtsa_channel_sim import Air, Channel, ChannelConfig

from .hosts import EmulatedHost, arrived

_ETHERNET, _IPV4, _UDP = 14, 0x0800, 17
_SECOND = 1_000_000_000
_PAYLOAD = 14 + 20 + 8  # bytes of Ethernet, IP and UDP headers before a datagram
_CHECKSUM = slice(_PAYLOAD - 2, _PAYLOAD)  # of UDP; 0: none
_KEPT = 500  # frames that an intruder remembers
_FLOOD = 20  # frames at a time, now and then


@dataclass(frozen=True, slots=True)
class CarriedDatagram:
    """A datagram that was on the air."""

    start_ns: int  # since the switch began
    end_ns: int
    sender: int  # host
    agent: int  # id named in the frame
    slot: int  # named in the frame
    received: int  # hosts that got it
    lost: int  # to noise
    collided: int  # hosts at which it met another


@dataclass(frozen=True, slots=True)
class Links:
    """Effects of links on frames, besides those of the medium."""

    delay_ns: int = 0
    jitter_ns: int = 0  # more, evenly distributed
    double: float = 0.0  # share of frames that arrive twice


class Switch:
    """Joins hosts."""

    def __init__(
        self, joined: Sequence[EmulatedHost], group: tuple[str, int], config: ChannelConfig, links: Links | None = None
    ) -> None:
        self._hosts = {host.cable: host for host in joined}
        self._cables = {host.number: host.cable for host in joined}
        self._group = socket.inet_aton(group[0]) + group[1].to_bytes(2, "big")
        self.channel = Channel(config)
        self._air: Air[int] = Air(self.channel)
        self._links = links or Links()
        self._random = np.random.default_rng(config.seed)
        self._frames: dict[int, tuple[bytes, int, int]] = {}  # on the air: Ethernet frame, agent, slot
        self._ends: list[int] = []  # of frames on the air, ns: a heap
        self._due: list[tuple[int, int, int, bytes]] = []  # deliveries: when, number, cable, Ethernet frame: a heap
        self._count = 0
        self._zero = time.monotonic_ns()
        self.log: list[CarriedDatagram] = []
        #: Is told each Ethernet frame that has left the air.
        self.listener: Callable[[bytes], None] | None = None
        self.left_out = 0  # Ethernet frames that were nothing for the air
        wake_precisely()

    @property
    def now_ns(self) -> int:
        """Time since the switch began, ns."""
        return time.monotonic_ns() - self._zero

    def set(self, **values: object) -> None:
        """Changes the medium from the next slot on."""
        self.channel.set(**values)

    def run(self, until: Callable[[], bool], seconds: float) -> bool:
        """Carries frames."""
        end, ask = self.now_ns + round(seconds * _SECOND), 0
        while True:
            now = self.now_ns
            if now >= ask:
                if until():
                    return True
                ask = now + _SECOND // 100
            if now >= end:
                return False
            following = min(ask, end, *self._ends[:1], *(entry[0] for entry in self._due[:1]))
            ready, _, _ = select.select(list(self._hosts), [], [], max(0, following - self.now_ns) / _SECOND)
            settled = self.now_ns  # what begins before this is read now
            for cable in ready:
                self._read(cable)
            self._resolve(settled)
            self._deliver()

    def _read(self, cable: int) -> None:
        for frame in arrived(cable):
            payload = self._payload(frame)
            named = named_in(payload[HEADER:]) if payload else None
            if named is None:
                self.left_out += 1
                continue
            start, sender = self.now_ns, self._hosts[cable].number
            self._count += 1
            if self._air.begin(self._count, sender, start, min(len(payload), 255)):
                self._frames[self._count] = (frame, *named)
                heapq.heappush(self._ends, start + self.channel.config.airtime.total_ns(len(payload)))

    def _payload(self, frame: bytes) -> bytes:
        """Payload of a datagram to the group; empty: the frame is something else."""
        if len(frame) < _ETHERNET + 28 or int.from_bytes(frame[12:14], "big") != _IPV4:
            return b""
        packet = frame[_ETHERNET:]
        head = (packet[0] & 15) * 4
        if packet[9] != _UDP or packet[16:20] + packet[head + 2 : head + 4] != self._group:
            return b""
        return packet[head + 8 : head + int.from_bytes(packet[head + 4 : head + 6], "big")]

    def _resolve(self, until_ns: int) -> None:
        for verdict in self._air.resolve(until_ns):
            frame, agent, slot = self._frames.pop(verdict.frame_id)
            numbers = [int(k) + 1 for k in np.flatnonzero(verdict.received) if int(k) + 1 in self._cables]
            for number in numbers:
                times = 1 + bool(self._links.double and self._random.random() < self._links.double)
                for _ in range(times):
                    delay = self._links.delay_ns + round(self._links.jitter_ns * self._random.random())
                    self._count += 1
                    entry = (verdict.arrival_ns + delay, self._count, self._cables[number], frame)
                    heapq.heappush(self._due, entry)
            self.log.append(
                CarriedDatagram(
                    verdict.start_ns, verdict.end_ns, verdict.sender, agent, slot, len(numbers), verdict.lost,
                    verdict.collided,
                )
            )  # fmt: skip
            if self.listener is not None:
                self.listener(frame)
        while self._ends and self._ends[0] <= until_ns:
            heapq.heappop(self._ends)

    def _deliver(self) -> None:
        now = self.now_ns
        while self._due and self._due[0][0] <= now:
            *_, cable, frame = heapq.heappop(self._due)
            with suppress(OSError):
                os.write(cable, frame)

    def broadcast(self, frame: bytes) -> None:
        """Brings all hosts a frame that was never on the air."""
        for cable in self._hosts:
            with suppress(OSError):
                os.write(cable, frame)


class Intruder:
    """A stranger without a key: plays frames again, at once and later, changes them, makes some up.

    Each frame is answered; no transmission of the intruder disturbs another one.
    """

    def __init__(self, switch: Switch, seed: int) -> None:
        self._switch, self._random = switch, random.Random(seed)
        self._heard: deque[bytes] = deque(maxlen=_KEPT)
        self.sent_count = 0
        switch.listener = self.hear

    def hear(self, frame: bytes) -> None:
        """Answer an Ethernet frame that has left the air."""
        self._heard.append(frame)
        for _ in range(_FLOOD if self._random.random() < 0.01 else 1):
            self._switch.broadcast(self._forged(frame))
            self.sent_count += 1

    def _forged(self, frame: bytes) -> bytes:
        """A frame again; one of long ago; or one with a byte, all of the swarm's frame, or everything changed."""
        draw = self._random
        kind = draw.randrange(5)
        if kind < 2:
            return frame if kind else self._heard[0]
        data = bytearray(frame)
        data[_CHECKSUM] = b"\0\0"
        if kind == 2:
            data[draw.randrange(_PAYLOAD, len(data))] ^= 1 << draw.randrange(8)
        else:
            begin = _PAYLOAD + (HEADER if kind == 3 else 0)
            data[begin:] = draw.randbytes(len(data) - begin)
        return bytes(data)
