"""A simulated Crazyradio: settings by requests, packets out, and what came back.

Times are ns on the fleet's clock. A packet is on the air when the dongle is free of what came before; its answer goes
to the host when it has left the air and USB has turned round. Sources: the documents and firmware of Crazyradio PA and
Crazyradio 2.0 (compatible-usb-protocol.md, legacy_usb.c, esb.c, radio.c).
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass

from dtsa_channel_sim.model.medium import OnAir

from . import esb
from .air import RadioAir
from .receiver import Receiver
from .settings import RadioSettings

SET_CHANNEL, SET_ADDRESS, SET_RATE, SET_POWER, SET_ARD, SET_ARC = range(1, 7)
ACK_ENABLE, SET_CARRIER, SCAN_CHANNELS = 0x10, 0x20, 0x21
ACKNOWLEDGED, POWER_DETECTED = 0x01, 0x02
ACK_TIMEOUT_NS = 500_000  # of a Crazyradio 2.0, from the end of the packet to the address of the acknowledgement
HIGHEST_CHANNEL = {"pa": 125, "2": 100}
SCAN_RESULTS = 63


class Agenda:
    """What happens when, in the order of times."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        """Do something at a time.

        :param when_ns: ns, the time.
        """
        self._count += 1
        heapq.heappush(self._heap, (when_ns, self._count, action))

    @property
    def next_ns(self) -> int | None:
        """Time of the next thing; None: there is nothing."""
        return self._heap[0][0] if self._heap else None

    def run(self, until_ns: int) -> None:
        """Do all that is due.

        :param until_ns: ns, up to and with this time.
        """
        while self._heap and self._heap[0][0] <= until_ns:
            heapq.heappop(self._heap)[2]()


@dataclass(slots=True)
class _Transfer:
    packet: bytes
    answer: Callable[[bytes], None]
    acknowledged: bool  # wanted
    retries: int = 0
    reply: tuple[OnAir, bytes] | None = None  # the acknowledgement to this dongle


class Dongle:
    """One Crazyradio.

    :param radio: its id on the air.
    :param settings: its kind and times.
    :param air: where it sends.
    :param agenda: what happens when.
    :param receivers: the Crazyflies by their ids on the air.
    :param passes: says whether a packet to (True) or from a Crazyflie passes the faults of its link.
    """

    def __init__(
        self,
        radio: int,
        settings: RadioSettings,
        air: RadioAir,
        agenda: Agenda,
        receivers: dict[int, Receiver],
        passes: Callable[[int, bool], bool],
    ) -> None:
        self._radio, self._settings, self._air, self._agenda = radio, settings, air, agenda
        self._receivers, self._passes = receivers, passes
        self.packets = 0  # transfers since the start
        self._busy_ns = 0
        self._scanned = b""
        self.reset()

    def reset(self) -> None:
        """As after plugging in."""
        self._channel, self._rate, self._address = 2, "2M", b"\xe7" * 5
        self._ard, self._arc, self._ack, self._carrier = 0xA0, 3, True, False

    def request(self, number: int, value: int, index: int, data: bytes, now: int) -> None:
        """A vendor request from the host; what is not known is ignored.

        :param now: ns, the time.
        """
        self._busy_ns = max(now, self._busy_ns) + round(self._settings.request_ms * 1e6)
        if number == SET_CHANNEL and value <= 125:
            self._channel = value
        elif number == SET_ADDRESS and len(data) == 5:
            self._address = bytes(data)
        elif number == SET_RATE and value < len(esb.RATE_NAMES):
            self._rate = esb.RATE_NAMES[value]
        elif number == SET_ARD:
            self._ard = value & 0xFF
        elif number == SET_ARC:
            self._arc = value & 0x0F
        elif number == ACK_ENABLE:
            self._ack = bool(value)
        elif number == SET_CARRIER:
            self._carrier = bool(value)
        elif number == SCAN_CHANNELS:
            self._scan(value, index, bytes(data))

    def _scan(self, first: int, last: int, packet: bytes) -> None:
        """Which channels answer: without the air, at once."""
        step = 2 if self._rate == "2M" and self._settings.device == "pa" else 1
        there = {r.station.channel for r in self._receivers.values() if self._hears(r) and packet}
        found = []
        for self._channel in range(first, last + 1, step):
            if self._can_send and self._channel in there:
                found.append(self._channel)
        self._scanned = bytes(found)

    def _hears(self, receiver: Receiver) -> bool:
        return receiver.station.rate == self._rate and receiver.station.address == self._address

    @property
    def scanned(self) -> bytes:
        """Result of the last scan."""
        return self._scanned[:SCAN_RESULTS]

    @property
    def _can_send(self) -> bool:
        device = self._settings.device
        slow = self._rate == "250K" and device == "2"  # a Crazyradio 2.0 cannot
        return not (self._carrier or slow or self._channel > HIGHEST_CHANNEL[device])

    # -- a packet ---------------------------------------------------------------------------------------------------
    def transfer(self, packet: bytes, now: int, answer: Callable[[bytes], None]) -> None:
        """Send a packet; `answer` gets what the host reads. Without acknowledgements there is nothing to read.

        :param now: ns, the time.
        """
        self.packets += 1
        half = round(self._settings.usb_ms * 0.5e6)
        start = max(now, self._busy_ns) + half
        if self._ack:
            parts = [packet[: esb.MAX_PAYLOAD]]
        elif len(packet) > esb.MAX_PAYLOAD:  # two of the same length
            parts = [packet[: len(packet) // 2], packet[len(packet) // 2 : len(packet) // 2 * 2]]
        else:
            parts = [packet]
        if not self._can_send:
            if self._ack:  # a Crazyradio 2.0 says that nobody has answered
                self._finish(_Transfer(packet, answer, True), start, b"\0")
            return
        for part in parts:
            start = self._attempt(_Transfer(part, answer, self._ack), start)
        self._busy_ns = start

    def _attempt(self, transfer: _Transfer, start: int) -> int:
        frame = self._air.send(self._channel, self._rate, self._radio, start, len(transfer.packet))
        channel, rate, address = self._channel, self._rate, self._address
        self._agenda.at(frame.end_ns, lambda: self._arrived(transfer, frame, channel, rate, address))
        return frame.end_ns

    def _arrived(self, transfer: _Transfer, frame: OnAir, channel: int, rate: str, address: bytes) -> None:
        """The packet has left the air: who has it?"""
        heard = self._air.heard(channel, frame)
        seconds = frame.end_ns / 1e9
        replies = []
        for radio in heard & self._receivers.keys():
            receiver = self._receivers[radio]
            station = receiver.station
            if station.channel != channel or station.rate != rate or address not in (station.address, esb.BROADCAST):
                continue
            if not self._passes(radio, True):
                continue
            if address == esb.BROADCAST:
                receiver.hear_all(transfer.packet, seconds)
            else:
                payload = receiver.hear(transfer.packet, seconds)
                replies.append((self._air.send(channel, rate, radio, frame.end_ns, len(payload)), radio, payload))
        if not transfer.acknowledged:
            return
        late = frame.end_ns + self._patience_ns(rate)
        over = max([late, *(reply.end_ns for reply, _, _ in replies)]) if replies else late
        first = min((reply.end_ns for reply, _, _ in replies), default=over)
        if len(replies) == 1:
            reply, radio, payload = replies[0]
            self._agenda.at(first, lambda: self._answered(transfer, reply, radio, payload, channel, over))
        else:
            self._agenda.at(over, lambda: self._missed(transfer, over))

    def _patience_ns(self, rate: str) -> int:
        return ACK_TIMEOUT_NS if self._settings.device == "2" else esb.retry_delay_ns(self._ard, rate)

    def _answered(self, transfer: _Transfer, reply: OnAir, radio: int, payload: bytes, channel: int, over: int) -> None:
        """The acknowledgement has left the air."""
        if self._radio in self._air.heard(channel, reply) and self._passes(radio, False):
            status = transfer.retries << 4 | POWER_DETECTED | ACKNOWLEDGED
            self._finish(transfer, reply.end_ns, bytes((status,)) + payload)
        else:
            self._agenda.at(over, lambda: self._missed(transfer, over))

    def _missed(self, transfer: _Transfer, now: int) -> None:
        if transfer.retries >= self._arc:
            self._finish(transfer, now, b"\0")
        else:
            transfer.retries += 1
            self._attempt(transfer, now)

    def _finish(self, transfer: _Transfer, now: int, data: bytes) -> None:
        done = now + round(self._settings.usb_ms * 0.5e6)
        self._busy_ns = max(self._busy_ns, done)
        self._agenda.at(done, lambda: transfer.answer(data))
