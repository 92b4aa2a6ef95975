"""The air between Crazyradios and Crazyflies: times and sizes of packets (Nordic's Enhanced ShockBurst), the channel
model's medium on each radio channel, and what happens when.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import NamedTuple

from dtsa_channel_sim.model.airtime import OVERHEAD_BITS
from dtsa_channel_sim.model.config import ChannelConfig
from dtsa_channel_sim.model.medium import Medium, OnAir

from .receiver import RadioReceiver

BITRATES = {"250K": 250_000, "1M": 1_000_000, "2M": 2_000_000}
RATE_NAMES = tuple(BITRATES)  # by the number of the dongle's request SET_DATA_RATE
TURN_NS = 130_000  # a radio turns from receiving to sending, or starts to send
MAX_PAYLOAD = 32  # bytes of a packet, and of an acknowledgement
MAX_SNIFFED = 63  # bytes of a packet in sniffer mode: all that its length field can name
BROADCAST = bytes.fromhex("FFE7E7E7E7")  # every Crazyflie listens to it, and acknowledges nothing
PEER_HEAD, PEER_PORT = 0xF3, 0x80  # bits of the first two bytes of a broadcast between Crazyflies
# Payload of an acknowledgement that fits into 1, 2, ... steps of the nRF24LU1+'s retry delay, by data rate.
_ARD_STEPS = {"250K": (0, 0, 8, 16, 24, 32), "1M": (15, 32), "2M": (5, 32)}
_ARD_STEP_NS = 250_000
_FORGET_NS = 20_000_000  # longer than any packet


def on_air_ns(length: int, rate: str) -> int:
    """Time that the bits of a packet (0 to 63 bytes of payload) are on air, ns; the rate is a key of BITRATES."""
    return (OVERHEAD_BITS + 8 * length) * 1_000_000_000 // BITRATES[rate]


def retry_delay_ns(ard: int, rate: str) -> int:
    """How long a Crazyradio PA waits for an acknowledgement, ns from the end of its packet.

    :param ard: value of the request SET_RADIO_ARD: steps of 250 us, or with bit 7 the bytes of an acknowledgement.
    """
    if not ard & 0x80:
        return _ARD_STEP_NS * ((ard & 0x0F) + 1)
    wanted = min(ard & 0x7F, MAX_PAYLOAD)
    steps = next(i for i, fits in enumerate(_ARD_STEPS[rate]) if fits >= wanted)
    return _ARD_STEP_NS * (steps + 1)


class Tuning(NamedTuple):
    """To what a dongle is tuned."""

    channel: int
    rate: str
    addresses: tuple[bytes, bytes]  # of its pipes; the second one is for sniffer mode


class Agenda:
    """What happens when, in the order of times (ns)."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        """Do something at a time."""
        self._count += 1
        heapq.heappush(self._heap, (when_ns, self._count, action))

    @property
    def next_ns(self) -> int | None:
        """Time of the next action; None: there is none."""
        return self._heap[0][0] if self._heap else None

    def run(self, until_ns: int) -> None:
        """Do all that is due, up to and with this time."""
        while self._heap and self._heap[0][0] <= until_ns:
            heapq.heappop(self._heap)[2]()


class RadioAir:
    """Transmissions on all channels (0 to 125), which do not disturb each other, and the radios that hear them.

    Ids of radios (dongles and Crazyflies) are 1 to their number. A receiver loses a share of packets to noise.
    """

    def __init__(self, radios: int, loss: float, seed: int) -> None:
        self.agenda = Agenda()
        self.receivers: dict[int, RadioReceiver] = {}  # of Crazyflies, by id
        #: Of dongles, by id: receive an address, a packet to it, the tuning of its sender and its time on the air.
        self.sniffers: dict[int, Callable[[bytes, bytes, Tuning, OnAir], None]] = {}
        #: Whether a packet to (True) or from a Crazyflie (id) passes the faults of its link.
        self.passes: Callable[[int, bool], bool] = lambda radio, up: True
        #: Receives what a dongle sent as between Crazyflies, ids of its receivers, its tuning and its time on the air.
        self.peer_packet: Callable[[bytes, set[int], Tuning, OnAir], None] = lambda *_: None
        self._config = ChannelConfig(agents=radios, loss=loss, seed=seed)
        self._medium = Medium(self._config)
        self._by_channel: dict[int, list[OnAir]] = {}
        self._resolved = 0  # each transmission has random numbers of its own

    def set_loss(self, loss: float) -> None:
        """From now on another share of packets is lost to noise."""
        self._medium = Medium(self._config.changed({"loss": loss}))

    def send(self, channel: int, rate: str, sender: int, start_ns: int, length: int, turn_ns: int = TURN_NS) -> OnAir:
        """A transmission (bytes of payload) begins: its radio turns to sending, and hears nothing meanwhile."""
        air = start_ns + turn_ns
        frame = OnAir(sender, start_ns, air, air + on_air_ns(length, rate))
        frames = self._by_channel.setdefault(channel, [])
        if frames and frames[0].end_ns < start_ns - _FORGET_NS:
            frames[:] = [f for f in frames if f.end_ns >= start_ns - _FORGET_NS]
        frames.append(frame)
        return frame

    def receivers_of(self, channel: int, frame: OnAir) -> set[int]:
        """Ids of the radios that can decode a transmission that has ended, if they listen."""
        self._resolved += 1
        others = [f for f in self._by_channel[channel] if f is not frame and f.end_ns > frame.start_ns]
        received = self._medium.resolve(self._resolved, frame, others).received
        return {int(index) + 1 for index in received.nonzero()[0]}

    def reached(self, heard: set[int], tuning: Tuning, address: bytes) -> list[tuple[int, RadioReceiver]]:
        """Crazyflies that have a packet to an address, of those that can decode it, and their ids."""
        found = []
        for radio in heard & self.receivers.keys():
            own = self.receivers[radio]
            listens = (own.channel, own.rate) == tuning[:2] and address in (own.address, BROADCAST)
            if listens and self.passes(radio, True):
                found.append((radio, self.receivers[radio]))
        return found

    def sniff(self, heard: set[int], address: bytes, packet: bytes, tuning: Tuning, frame: OnAir) -> None:
        """Dongles in sniffer mode have a packet."""
        for radio in sorted(heard & self.sniffers.keys()):
            self.sniffers[radio](address, packet, tuning, frame)

    def broadcast(self, address: bytes, packet: bytes, tuning: Tuning, frame: OnAir) -> None:
        """A packet that a dongle in sniffer mode has sent has left the air."""
        heard = self.receivers_of(tuning.channel, frame)
        self.sniff(heard, address, packet, tuning, frame)
        if len(packet) > 1 and packet[0] & PEER_HEAD == PEER_HEAD and packet[1] & 0xF0 == PEER_PORT:
            self.peer_packet(packet, heard, tuning, frame)  # the radio chip does not take it for the ground station's
        else:
            for _, receiver in self.reached(heard, tuning, address):
                receiver.receive_broadcast(packet, frame.end_ns / 1e9)
