"""A simulated Crazyradio: settings by requests, packets out, and what came back.

Times are ns on the fleet's clock. A packet is on the air when the dongle is free of what came before; its answer goes
to the host when it has left the air and USB has turned round. Sources: the documents and firmware of Crazyradio PA and
Crazyradio 2.0 (compatible-usb-protocol.md, legacy_usb.c, esb.c, radio.c).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dtsa_bench.crazyflies.simulated.fleet_config import DEVICES, RadioSettings
from dtsa_channel_sim.model.medium import OnAir

from .air import BROADCAST, MAX_PAYLOAD, RATE_NAMES, Agenda, RadioAir, between_crazyflies, retry_delay_ns
from .receiver import RadioReceiver
from .sniffer_mode import FIRST_FIRMWARE, SnifferMode, Tuned

SET_CHANNEL, SET_ADDRESS, SET_RATE, SET_POWER, SET_ARD, SET_ARC = range(1, 7)
ACK_ENABLE = 0x10
SET_RADIO_MODE, SET_SNIFFER_ADDRESS = 0x24, 0x25
ACKNOWLEDGED, POWER_DETECTED = 0x01, 0x02
ACK_TIMEOUT_NS = 500_000  # of a Crazyradio 2.0, from the end of the packet to the address of the acknowledgement
HIGHEST_CHANNEL = {"pa": 125, "2": 100}


@dataclass(slots=True)
class _Transfer:
    packet: bytes
    answer: Callable[[bytes], None]
    acknowledged: bool  # wanted
    rate: str = ""
    retries: int = 0
    reply: tuple[OnAir, bytes] | None = None  # the acknowledgement to this dongle


class DongleModel:
    """One Crazyradio; radios are named by their ids on the air. It adds its own sniffer to those of all dongles.

    :param passes: says whether a packet to (True) or from a Crazyflie passes the faults of its link.
    """

    def __init__(
        self,
        radio: int,
        settings: RadioSettings,
        air: RadioAir,
        agenda: Agenda,
        receivers: dict[int, RadioReceiver],
        passes: Callable[[int, bool], bool],
        sniffers: dict[int, SnifferMode],
    ) -> None:
        self._radio, self._settings, self._air, self._agenda = radio, settings, air, agenda
        self._receivers, self._passes = receivers, passes
        self.packets = 0  # transfers since the start
        self._busy_ns = 0
        self.sniffer = SnifferMode(radio, air, agenda, round(settings.usb_ms * 0.5e6), settings.seed)
        self.sniffer.arrived = self._broadcast
        sniffers[radio] = self.sniffer
        #: Takes a packet as between vehicles, ids of those that hear it, and how it was sent: for apps on board.
        self.between: Callable[[bytes, set[int], Tuned, OnAir], None] = lambda *_: None
        self._sniffers = sniffers
        self.reset()

    def reset(self) -> None:
        """As after plugging in."""
        self._channel, self._rate, self._address = 2, "2M", b"\xe7" * 5
        self._second = b"\xc2" * 5  # address of the second pipe in sniffer mode
        self._ard, self._arc, self._ack = 0xA0, 3, True
        self.sniffer.stop()

    def request(self, number: int, value: int, index: int, data: bytes, now: int) -> None:
        """A vendor request from the host; what is not known is ignored."""
        self._busy_ns = max(now, self._busy_ns) + round(self._settings.request_ms * 1e6)
        if number == SET_CHANNEL and value <= 125:
            self._channel = value
        elif number == SET_ADDRESS and len(data) == 5:
            self._address = bytes(data)
        elif number == SET_RATE and value < len(RATE_NAMES):
            self._rate = RATE_NAMES[value]
        elif number == SET_ARD:
            self._ard = value & 0xFF
        elif number == SET_ARC:
            self._arc = value & 0x0F
        elif number == ACK_ENABLE:
            self._ack = bool(value)
        elif number == SET_SNIFFER_ADDRESS and len(data) == 5:
            if value == 0:
                self._address = bytes(data)
            elif value == 1:
                self._second = bytes(data)
        elif number == SET_RADIO_MODE and DEVICES[self._settings.device] >= FIRST_FIRMWARE:
            self._set_mode(value, now)
        if self.sniffer.tuned is not None:
            self.sniffer.tuned = self._tuned

    @property
    def _tuned(self) -> Tuned:
        return Tuned(self._channel, self._rate, (self._address, self._second))

    def _set_mode(self, mode: int, now: int) -> None:
        if mode == 0:
            self.sniffer.stop()
        elif mode == 1 and self.sniffer.tuned is None:
            self.sniffer.start(now, self._tuned)

    @property
    def _can_send(self) -> bool:
        device = self._settings.device
        slow = self._rate == "250K" and device == "2"  # a Crazyradio 2.0 cannot
        return not (slow or self._channel > HIGHEST_CHANNEL[device])

    # -- a packet ---------------------------------------------------------------------------------------------------
    def transfer(self, packet: bytes, now: int, answer: Callable[[bytes], None]) -> None:
        """Send a packet; `answer` gets what the host reads. Without acknowledgements there is nothing to read.

        In sniffer mode a packet begins with the address to which it goes.
        """
        self.packets += 1
        if self.sniffer.tuned is not None:
            if self._can_send:
                self.sniffer.order(packet, now)
            return
        half = round(self._settings.usb_ms * 0.5e6)
        start = max(now, self._busy_ns) + half
        if self._ack:
            parts = [packet[:MAX_PAYLOAD]]
        elif len(packet) > MAX_PAYLOAD:  # two of the same length
            parts = [packet[: len(packet) // 2], packet[len(packet) // 2 : len(packet) // 2 * 2]]
        else:
            parts = [packet]
        if not self._can_send:
            if self._ack:  # a Crazyradio 2.0 reports that no answer came
                self._finish(_Transfer(packet, answer, True), start, b"\0")
            return
        for part in parts:
            start = self._attempt(_Transfer(part, answer, self._ack), start)
        self._busy_ns = start

    def _attempt(self, transfer: _Transfer, start: int) -> int:
        frame = self._air.send(self._channel, self._rate, self._radio, start, len(transfer.packet))
        channel, rate, address = self._channel, self._rate, self._address
        transfer.rate = rate
        self._agenda.at(frame.end_ns, lambda: self._arrived(transfer, frame, channel, rate, address))
        return frame.end_ns

    def _arrived(self, transfer: _Transfer, frame: OnAir, channel: int, rate: str, address: bytes) -> None:
        """Find the receivers of a packet that has left the air."""
        heard = self._air.receivers_of(channel, frame)
        self.overheard(heard, address, transfer.packet, channel, rate, frame)
        seconds = frame.end_ns / 1e9
        replies = []
        for radio, receiver in self._reached(heard, channel, rate, address):
            if address == BROADCAST:
                receiver.receive_broadcast(transfer.packet, seconds)
            else:
                payload = receiver.receive(transfer.packet, seconds)
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

    def _reached(self, heard: set[int], channel: int, rate: str, address: bytes) -> list[tuple[int, RadioReceiver]]:
        """Crazyflies that have a packet, and their ids on the air."""
        found = []
        for radio in heard & self._receivers.keys():
            receiver = self._receivers[radio]
            station = receiver.station
            tuned = station.channel == channel and station.rate == rate and address in (station.address, BROADCAST)
            if tuned and self._passes(radio, True):
                found.append((radio, receiver))
        return found

    def overheard(self, heard: set[int], address: bytes, packet: bytes, channel: int, rate: str, frame: OnAir) -> None:
        """Dongles in sniffer mode have a packet."""
        for radio in sorted(heard & self._sniffers.keys()):
            tuned = self._sniffers[radio].tuned
            if tuned is not None and (tuned.channel, tuned.rate) == (channel, rate):
                self._sniffers[radio].receive(address, packet, frame)

    def _broadcast(self, address: bytes, packet: bytes, tuned: Tuned, frame: OnAir) -> None:
        """A packet that this dongle has sent in sniffer mode has left the air."""
        heard = self._air.receivers_of(tuned.channel, frame)
        self.overheard(heard, address, packet, tuned.channel, tuned.rate, frame)
        if between_crazyflies(packet):
            self.between(packet, heard, tuned, frame)
        else:
            for _, receiver in self._reached(heard, tuned.channel, tuned.rate, address):
                receiver.receive_broadcast(packet, frame.end_ns / 1e9)

    def _patience_ns(self, rate: str) -> int:
        return ACK_TIMEOUT_NS if self._settings.device == "2" else retry_delay_ns(self._ard, rate)

    def _answered(self, transfer: _Transfer, reply: OnAir, radio: int, payload: bytes, channel: int, over: int) -> None:
        """The acknowledgement has left the air."""
        heard = self._air.receivers_of(channel, reply)
        self.overheard(heard, self._receivers[radio].station.address, payload, channel, transfer.rate, reply)
        if self._radio in heard and self._passes(radio, False):
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
