"""Sniffer mode of a simulated Crazyradio 2.0: it hears all packets to two addresses, and sends without acknowledgement.

Source: crazyradio2-firmware 5.4 (docs/development/compatible-usb-protocol.md, legacy_usb.c, esb.c). One thread of the
firmware does all: it waits for a packet that was heard, a tick longer than 1 ms at most, and only in between checks
whether there is something to send. So the moment when a packet leaves is unknown. While it sends, its radio hears
nothing.
"""

from __future__ import annotations

import random
import struct
from collections import deque
from collections.abc import Callable

from dtsa_channel_sim.model.medium import OnAir

from .air import MAX_SNIFFED, TURN_NS, RadioAir, Tuning

FIRST_FIRMWARE = 0x0504  # that has this mode
ADDRESS = 5  # bytes before the payload of a packet that is to be sent
QUEUE = 8  # packets that wait for USB; more are lost, and counted
_ORDERS = 10  # packets that wait for the thread
_POLL_NS = 1_040_000  # longest wait for a packet that was heard: 1 ms, and a tick of 1/32768 s
_TICK_NS = 30_518
_OFF_NS = 214_000  # the radio is switched off, and the thread sleeps for 200 us, in whole ticks
_ON_NS = 170_000  # after sending, until the radio hears again
_HEAD = struct.Struct("<BBBI")
_RSSI = 45  # -dBm
_MOST_DRIFT = 20e-6  # of its crystal


class SnifferMode:
    """A dongle in this mode. Times (`now`) are ns; a packet takes `half_ns` on USB, one way."""

    def __init__(self, radio: int, air: RadioAir, half_ns: int, seed: int) -> None:
        self._radio, self._air, self._agenda, self._half_ns = radio, air, air.agenda, half_ns
        self._random = random.Random(f"{seed} {radio}")
        self._rate = 1.0 + self._random.uniform(-_MOST_DRIFT, _MOST_DRIFT)
        self.give: Callable[[bytes], None] | None = None  # to the host
        self.tuning: Tuning | None = None  # None: another mode
        self._wake = 0  # number of the wake-up that counts
        self.stop()

    def stop(self) -> None:
        """Another mode, or unplugged."""
        self.tuning = self.give = None
        self.dropped = 0
        self._began_ns = self._deaf_ns = 0
        self._orders: deque[bytes] = deque()
        self._received: deque[bytes] = deque()
        self._wake += 1
        self._wanted = False  # the host reads

    def start(self, now: int, tuning: Tuning) -> None:
        """Begin to listen."""
        self.stop()
        self._began_ns, self.tuning = now, tuning

    # -- sending ----------------------------------------------------------------------------------------------------
    def order(self, transfer: bytes, now: int) -> None:
        """The host has written: address and payload."""
        if len(transfer) <= ADDRESS or len(self._orders) == _ORDERS:
            return
        self._orders.append(transfer)
        if len(self._orders) == 1:
            self._schedule_poll(max(now + self._half_ns, self._deaf_ns) + round(self._random.uniform(0, _POLL_NS)))

    def _schedule_poll(self, when: int) -> None:
        self._wake += 1
        number = self._wake
        self._agenda.at(when, lambda: self._poll(when) if number == self._wake else None)

    def _poll(self, now: int) -> None:
        """The thread looks whether there is something to send."""
        tuning = self.tuning
        if not self._orders or tuning is None:
            return
        transfer = self._orders.popleft()
        address, packet = transfer[:ADDRESS], transfer[ADDRESS:][:MAX_SNIFFED]
        turn = _OFF_NS + round(self._random.uniform(0, _TICK_NS)) + TURN_NS
        frame = self._air.send(tuning.channel, tuning.rate, self._radio, now, len(packet), turn)
        self._deaf_ns = frame.end_ns + _ON_NS
        self._agenda.at(frame.end_ns, lambda: self._air.broadcast(address, packet, tuning, frame))
        if self._orders:
            self._schedule_poll(self._deaf_ns + round(self._random.uniform(0, _POLL_NS)))

    # -- hearing ----------------------------------------------------------------------------------------------------
    def receive(self, address: bytes, packet: bytes, tuning: Tuning, frame: OnAir) -> None:
        """A packet has left the air, and nothing has disturbed it here."""
        own = self.tuning
        if own is None or own[:2] != tuning[:2] or address not in own.addresses or frame.air_ns < self._deaf_ns:
            return
        now = frame.end_ns
        if len(self._received) == QUEUE:
            self.dropped = (self.dropped + 1) & 0xFFFFFFFF
        else:
            stamp = round((now - self._began_ns) * self._rate) // 1000 & 0xFFFFFFFF
            head = _HEAD.pack(_HEAD.size + len(packet), _RSSI, own.addresses.index(address), stamp)
            self._received.append(head + packet)
            self._agenda.at(now + self._half_ns, self._deliver)
        if self._orders:
            self._schedule_poll(now)

    def read(self) -> None:
        """The host is ready for a transfer."""
        self._wanted = True
        self._deliver()

    def _deliver(self) -> None:
        if self._wanted and self._received and self.give is not None:
            self._wanted = False
            self.give(self._received.popleft())
