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

from .air import BROADCAST, MAX_PAYLOAD, RATE_NAMES, RadioAir, Tuning, retry_delay_ns
from .sniffer_mode import FIRST_FIRMWARE, SnifferMode

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
    retries: int = 0


class DongleModel:
    """One Crazyradio; `radio` is its id on the air. Its sniffer joins the air's."""

    def __init__(self, radio: int, settings: RadioSettings, air: RadioAir) -> None:
        self._radio, self._settings, self._air, self._agenda = radio, settings, air, air.agenda
        self._half_ns = round(settings.usb_ms * 0.5e6)  # of a packet on USB, one way
        self._busy_ns = 0
        self.sniffer = SnifferMode(radio, air, self._half_ns, settings.seed)
        air.sniffers[radio] = self.sniffer.receive
        self.reset()

    def reset(self) -> None:
        """As after plugging in."""
        self._tuning = Tuning(2, "2M", (b"\xe7" * 5, b"\xc2" * 5))
        self._ard, self._arc, self._ack = 0xA0, 3, True
        self.sniffer.stop()

    def request(self, number: int, value: int, data: bytes, now: int) -> None:
        """A vendor request from the host; what is not known is ignored."""
        self._busy_ns = max(now, self._busy_ns) + round(self._settings.request_ms * 1e6)
        first, second = self._tuning.addresses
        if number == SET_CHANNEL and value <= 125:
            self._tuning = self._tuning._replace(channel=value)
        elif number == SET_RATE and value < len(RATE_NAMES):
            self._tuning = self._tuning._replace(rate=RATE_NAMES[value])
        elif number in (SET_ADDRESS, SET_SNIFFER_ADDRESS) and len(data) == 5:
            if number == SET_ADDRESS or value == 0:
                self._tuning = self._tuning._replace(addresses=(data, second))
            elif value == 1:
                self._tuning = self._tuning._replace(addresses=(first, data))
        elif number == SET_ARD:
            self._ard = value & 0xFF
        elif number == SET_ARC:
            self._arc = value & 0x0F
        elif number == ACK_ENABLE:
            self._ack = bool(value)
        elif number == SET_RADIO_MODE and DEVICES[self._settings.device] >= FIRST_FIRMWARE:
            if value == 0:
                self.sniffer.stop()
            elif value == 1 and self.sniffer.tuning is None:
                self.sniffer.start(now, self._tuning)
        if self.sniffer.tuning is not None:
            self.sniffer.tuning = self._tuning

    @property
    def _can_send(self) -> bool:
        device = self._settings.device
        slow = self._tuning.rate == "250K" and device == "2"  # a Crazyradio 2.0 cannot
        return not (slow or self._tuning.channel > HIGHEST_CHANNEL[device])

    # -- a packet ---------------------------------------------------------------------------------------------------
    def transfer(self, packet: bytes, now: int, answer: Callable[[bytes], None]) -> None:
        """Send a packet; `answer` gets what the host reads. Without acknowledgements there is nothing to read.

        In sniffer mode a packet begins with the address to which it goes.
        """
        if self.sniffer.tuning is not None:
            if self._can_send:
                self.sniffer.order(packet, now)
            return
        start = max(now, self._busy_ns) + self._half_ns
        if self._ack:
            parts = [packet[:MAX_PAYLOAD]]
        elif len(packet) > MAX_PAYLOAD:  # two of the same length
            parts = [packet[: len(packet) // 2], packet[len(packet) // 2 : len(packet) // 2 * 2]]
        else:
            parts = [packet]
        if not self._can_send:
            if self._ack:  # a Crazyradio 2.0 reports that no answer came
                self._finish(answer, start, b"\0")
            return
        for part in parts:
            start = self._attempt(_Transfer(part, answer, self._ack), start)
        self._busy_ns = start

    def _attempt(self, transfer: _Transfer, start: int) -> int:
        tuning = self._tuning
        frame = self._air.send(tuning.channel, tuning.rate, self._radio, start, len(transfer.packet))
        self._agenda.at(frame.end_ns, lambda: self._arrived(transfer, frame, tuning))
        return frame.end_ns

    def _arrived(self, transfer: _Transfer, frame: OnAir, tuning: Tuning) -> None:
        """Find the receivers of a packet that has left the air."""
        heard, address = self._air.receivers_of(tuning.channel, frame), tuning.addresses[0]
        self._air.sniff(heard, address, transfer.packet, tuning, frame)
        seconds = frame.end_ns / 1e9
        replies = []
        for radio, receiver in self._air.reached(heard, tuning, address):
            if address == BROADCAST:
                receiver.receive_broadcast(transfer.packet, seconds)
            else:
                payload = receiver.receive(transfer.packet, seconds)
                reply = self._air.send(tuning.channel, tuning.rate, radio, frame.end_ns, len(payload))
                replies.append((reply, radio, payload))
        if not transfer.acknowledged:
            return
        device = self._settings.device
        over = frame.end_ns + (ACK_TIMEOUT_NS if device == "2" else retry_delay_ns(self._ard, tuning.rate))
        over = max([over, *(reply.end_ns for reply, _, _ in replies)])
        if len(replies) == 1:
            reply, radio, payload = replies[0]
            self._agenda.at(reply.end_ns, lambda: self._answered(transfer, reply, radio, payload, tuning, over))
        else:
            self._agenda.at(over, lambda: self._missed(transfer, over))

    def _answered(
        self, transfer: _Transfer, reply: OnAir, radio: int, payload: bytes, tuning: Tuning, over: int
    ) -> None:
        """The acknowledgement has left the air."""
        heard = self._air.receivers_of(tuning.channel, reply)
        self._air.sniff(heard, self._air.receivers[radio].address, payload, tuning, reply)
        if self._radio in heard and self._air.passes(radio, False):
            status = transfer.retries << 4 | POWER_DETECTED | ACKNOWLEDGED
            self._finish(transfer.answer, reply.end_ns, bytes((status,)) + payload)
        else:
            self._agenda.at(over, lambda: self._missed(transfer, over))

    def _missed(self, transfer: _Transfer, now: int) -> None:
        if transfer.retries >= self._arc:
            self._finish(transfer.answer, now, b"\0")
        else:
            transfer.retries += 1
            self._attempt(transfer, now)

    def _finish(self, answer: Callable[[bytes], None], now: int, data: bytes) -> None:
        done = now + self._half_ns
        self._busy_ns = max(self._busy_ns, done)
        self._agenda.at(done, lambda: answer(data))
