"""How long a frame takes: on the air, and between a flight processor and its radio.

One class says it for every radio; the rows are in :mod:`dtsa_channel_sim.model.radio_table`. Unless said otherwise the
times are those of a Crazyflie's nRF51 in its peer-to-peer mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

#: Bits around the data: preamble, address, length and control fields, checksum.
OVERHEAD_BITS = 73
#: Bytes of peer-to-peer header (null packet, port) in front of the data.
HEADER_BYTES = 2
#: Longest frame that a length byte can name, bytes.
LONGEST_FRAME = 255


@dataclass(frozen=True, slots=True)
class Line:
    """The way between a flight processor and its radio.

    :param to_fixed_ns: ns that any frame takes to the radio.
    :param to_byte_ns: ns that each of its bytes adds.
    :param from_fixed_ns: ns that any frame takes from the radio.
    :param from_byte_ns: ns that each of its bytes adds.
    :param waits: whether the radio does nothing else while it hands a reception over: a frame of its own that comes
        meanwhile is sent afterwards.
    :param queue: receptions that a radio holds, with the one that it hands over; 0: any number. More are lost.
    """

    to_fixed_ns: int = 0
    to_byte_ns: int = 0
    from_fixed_ns: int = 0
    from_byte_ns: int = 0
    waits: bool = False
    queue: int = 0

    @property
    def serial(self) -> bool:
        """Whether bytes go over it one after the other. Else it is a constant delay, which moves arrivals alone."""
        return bool(self.to_byte_ns or self.from_byte_ns)

    def to_radio_ns(self, length: int) -> int:
        """Return the time that a frame takes from the flight processor to the radio, ns.

        :param length: bytes of the frame.
        """
        return self.to_fixed_ns + self.to_byte_ns * length

    def from_radio_ns(self, length: int) -> int:
        """Return the time that a frame takes from the radio to the flight processor, ns.

        :param length: bytes of the frame.
        """
        return self.from_fixed_ns + self.from_byte_ns * length


@dataclass(frozen=True, slots=True)
class Airtime:
    """Times of one transmission.

    :param bitrate: bit/s on air.
    :param ramp_up_ns: ns from the order to send until the first bit is on air; the sender is deaf, the air
        still free.
    :param overhead_bits: bits on air beside those of the frame.
    :param line: the way between flight processor and radio.
    :param longest: bytes of the longest frame that the radio takes.
    :param formula: ns on air by the bytes of a frame, for radios whose times are no multiple of a bit; None: by
        ``overhead_bits`` and ``bitrate``.
    """

    bitrate: int = 2_000_000
    ramp_up_ns: int = 130_000
    overhead_bits: int = OVERHEAD_BITS + 8 * HEADER_BYTES
    line: Line = Line()
    longest: int = LONGEST_FRAME
    formula: Callable[[int], int] | None = None

    def on_air_ns(self, length: int) -> int:
        """Return the time that the bits of a frame of ``length`` bytes are on air, ns, rounded up.

        nRF51: 73 + 8 (n + 2) bits; 24 bytes take 0.14 ms, 60 bytes 0.28 ms at 2 Mbit/s.
        """
        if self.formula is not None:
            return self.formula(length)
        bits = self.overhead_bits + 8 * length
        return -(-bits * 1_000_000_000 // self.bitrate)

    def total_ns(self, length: int) -> int:
        """Return the time from the order to send until the last bit has left, ns.

        :param length: bytes of the frame.
        """
        return self.ramp_up_ns + self.on_air_ns(length)

    def to_radio_ns(self, length: int) -> int:
        """Return the time that a frame takes from the flight processor to the radio, ns.

        :param length: bytes of the frame.
        """
        return self.line.to_radio_ns(length)

    def from_radio_ns(self, length: int) -> int:
        """Return the time that a frame takes from the radio to the flight processor, ns.

        :param length: bytes of the frame.
        """
        return self.line.from_radio_ns(length)

    def latest_ns(self, length: int) -> int:
        """Return the longest time from the order to send until a receiver's flight processor has a frame, ns.

        :param length: bytes of the longest frame on the air.
        """
        line = self.line
        waiting = self.from_radio_ns(length) * line.waits + self.from_radio_ns(length) * max(0, line.queue - 1)
        return waiting + self.total_ns(length) + self.from_radio_ns(length)

    def shortest_slot_ns(self, length: int, *, guard_ns: int, decide_ns: int = 0, needs_frame: bool = False) -> int:
        """Return the shortest slot in which no frame overlaps another one or waits for one, ns.

        A policy that needs the frame of a slot to know who sends in the next one waits for its way from the radio, for
        the decision, and for the own frame's way to the radio. Others order their frame ahead of time, and the line is
        at work while the next slot goes on; only a radio that does nothing else while it hands a reception over keeps
        the own frame waiting until then.

        :param length: bytes of a frame.
        :param guard_ns: ns, largest difference of any clock from the common one, either way.
        :param decide_ns: ns, longest time to decide and to make a frame.
        :param needs_frame: whether an agent must have a slot's frame before it knows who sends in the next one.
        """
        to_ns, from_ns = self.to_radio_ns(length), self.from_radio_ns(length)
        on_air_ns = self.total_ns(length) + 2 * guard_ns
        if needs_frame:
            return on_air_ns + from_ns + decide_ns + to_ns
        return max(on_air_ns + (from_ns if self.line.waits else 0), from_ns, to_ns, decide_ns)
