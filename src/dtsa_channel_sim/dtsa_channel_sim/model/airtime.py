"""How long a frame occupies the air (Crazyflie's nRF51 radio in its peer-to-peer mode)."""

from __future__ import annotations

from dataclasses import dataclass

#: Bits around the data: preamble, address, length and control fields, checksum.
OVERHEAD_BITS = 73
#: Bytes of peer-to-peer header (port, rssi) in front of the data.
HEADER_BYTES = 2
#: Longest frame that a length byte can name, bytes.
LONGEST_FRAME = 255


@dataclass(frozen=True, slots=True)
class Airtime:
    """Times of one transmission.

    :param bitrate: bit/s on air.
    :param ramp_up_ns: ns from the order to send until the first bit is on air; the sender is deaf, the air
        still free.
    """

    bitrate: int = 2_000_000
    ramp_up_ns: int = 130_000

    def on_air_ns(self, length: int) -> int:
        """Return the time that the bits of a frame of ``length`` bytes are on air, ns, rounded up.

        73 + 8 (n + 2) bits: 24 bytes take 0.14 ms, 60 bytes 0.28 ms at 2 Mbit/s.
        """
        bits = OVERHEAD_BITS + 8 * (length + HEADER_BYTES)
        return -(-bits * 1_000_000_000 // self.bitrate)

    def total_ns(self, length: int) -> int:
        """Return the time from the order to send until the last bit has left, ns.

        :param length: bytes of the frame.
        """
        return self.ramp_up_ns + self.on_air_ns(length)

    def shortest_slot_ns(self, length: int, *, guard_ns: int, link_delay_ns: int = 0, decide_ns: int = 0) -> int:
        """Return the shortest slot in which frames do not overlap, ns.

        Who needs the frame of a slot to know whether the next one is its own has to wait for it: the last two are for
        such policies. Others can order their frame ahead of time.

        :param length: bytes of a frame.
        :param guard_ns: ns, largest difference of any clock from the common one, either way.
        :param link_delay_ns: ns, between radio and flight processor, on each side.
        :param decide_ns: ns, longest time to decide and to make a frame.
        """
        return self.total_ns(length) + 2 * guard_ns + 2 * link_delay_ns + decide_ns
