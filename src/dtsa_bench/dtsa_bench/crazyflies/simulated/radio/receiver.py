"""The radio of one simulated Crazyflie: its nRF51, and the queue of packets behind it.

What is followed is the firmware of August 2026 (crazyflie2-nrf-firmware's esb.c, crtp.c, radiolink.c, log.c). The
answer to a packet goes out with the acknowledgement of a later one. With safelink a bit in each direction tells a
repetition from a new packet. What was not fetched waits in a queue; it is old when it is fetched after a gap.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from dtsa_agent.crazyflie.addresses import Address

QUEUE = 200  # packets that wait for the ground station; more are lost
CHIP_QUEUE = 7  # of these on the radio chip; one more goes there with each packet that comes
ACTIVITY_S = 1.0  # after that long without a packet the log is switched off, and the queue forgotten
NULL, MASK = 0xF3, 0xF3  # header of an empty packet but for the bits of the link
RSSI = 45  # -dBm
UP, DOWN = 0x08, 0x04


class RadioReceiver:
    """Radio link of one Crazyflie; `deliver` gets each new packet, and the time (s)."""

    def __init__(self, station: Address, deliver: Callable[[bytes, float], None]) -> None:
        self.channel, self.rate, self.address = station.channel, station.rate, bytes.fromhex(station.node)
        self._deliver = deliver
        #: Called with the time (s) of each packet: it goes over the line to the flight processor.
        self.on_packet: Callable[[float], None] = lambda t: None
        self.reset()

    def reset(self) -> None:
        """Power on."""
        self.last_heard = float("-inf")  # s
        self._queue: deque[bytes] = deque()
        self._chip: deque[bytes] = deque()
        self._safelink = False
        self._up = self._down = True
        self._sent = b""  # payload of the last acknowledgement
        self._sent_from_chip = False

    def connected(self, t: float) -> bool:
        """Whether a packet came in the last second (t: s); if not, what waits is forgotten."""
        if t - self.last_heard < ACTIVITY_S:
            return True
        self._queue.clear()
        return False

    def push(self, packet: bytes) -> None:
        """A packet for the ground station; lost if too many wait."""
        if len(self._queue) < QUEUE:
            self._queue.append(packet)

    @property
    def waiting(self) -> int:
        """Packets that have not been fetched."""
        return len(self._queue) + len(self._chip)

    def receive(self, packet: bytes, t: float) -> bytes:
        """A packet to its own address came at t (s); the payload of the acknowledgement."""
        header = packet[0]
        self.on_packet(t)
        if len(packet) == 3 and header & MASK == NULL and packet[1] == 0x05:
            self._safelink = bool(packet[2])
            self._up = self._down = True
            self._sent, self._sent_from_chip = packet, False
            return packet
        fresh = not self._safelink or bool(header & UP) != self._up
        if fresh:
            self._up = not self._up
        if not self._safelink or bool(header & DOWN) != self._down:
            self._down = not self._down
            self._next()
        if fresh:
            self._accept(packet, t)
        return self._sent

    def receive_broadcast(self, packet: bytes, t: float) -> None:
        """A packet to all came at t (s); it is not acknowledged."""
        self.on_packet(t)
        self._accept(packet, t)

    def _accept(self, packet: bytes, t: float) -> None:
        self.last_heard = t
        if self._queue and len(self._chip) < CHIP_QUEUE:
            self._chip.append(self._queue.popleft())
        if packet[0] & MASK != NULL:
            self._deliver(packet, t)

    def _next(self) -> None:
        """The last acknowledgement has arrived: prepare the next one."""
        if self._sent_from_chip:
            self._chip.popleft()
        bit = DOWN if self._down else 0
        self._sent_from_chip = bool(self._chip)
        if self._chip:
            packet = self._chip[0]
            self._sent = bytes((packet[0] & MASK | bit,)) + packet[1:] if self._safelink else packet
        else:
            self._sent = bytes((NULL | bit, 0x01, RSSI))
