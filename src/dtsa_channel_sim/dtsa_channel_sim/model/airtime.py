"""How long a frame takes on the air, and between a flight processor and its radio; the radios by name.

Unless said otherwise the times are those of a Crazyflie's nRF51 in its peer-to-peer mode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

from dtsa_agent.air.serial_modems import FRAMING, MODEMS, NONE, Modem

#: Bits around the data: preamble, address, length and control fields, checksum.
OVERHEAD_BITS = 73
#: Bytes of peer-to-peer header (null packet, port) in front of the data.
HEADER_BYTES = 2
#: Longest frame that a length byte can name, bytes.
LONGEST_FRAME = 255


@dataclass(frozen=True, slots=True)
class Line:
    """The way between a flight processor and its radio."""

    to_fixed_ns: int = 0  # that any frame takes to the radio
    to_byte_ns: int = 0  # that each of its bytes adds
    from_fixed_ns: int = 0  # that any frame takes from the radio
    from_byte_ns: int = 0  # that each of its bytes adds
    waits: bool = False  # the radio does nothing else while it hands a reception over: frames of its own wait
    queue: int = 0  # receptions that a radio holds, with the one that it hands over; 0: any number. More are lost

    @property
    def serial(self) -> bool:
        """Whether bytes go over it one after the other. Else it is a constant delay, which moves arrivals alone."""
        return bool(self.to_byte_ns or self.from_byte_ns)


@dataclass(frozen=True, slots=True)
class Airtime:
    """Times of one transmission; lengths are the bytes of a frame."""

    bitrate: int = 2_000_000  # bit/s on air
    ramp_up_ns: int = 130_000  # from the order to send until the first bit is on air; the sender is deaf, the air free
    overhead_bits: int = OVERHEAD_BITS + 8 * HEADER_BYTES  # bits on air beside those of the frame
    line: Line = Line()
    longest: int = LONGEST_FRAME  # bytes of the longest frame that the radio takes
    formula: Callable[[int], int] | None = None  # ns on air by the bytes of a frame, where no multiple of a bit

    def on_air_ns(self, length: int) -> int:
        """Return the time that the bits of a frame are on air, ns, rounded up.

        nRF51: 73 + 8 (n + 2) bits; 24 bytes take 0.14 ms, 60 bytes 0.28 ms at 2 Mbit/s.
        """
        if self.formula is not None:
            return self.formula(length)
        bits = self.overhead_bits + 8 * length
        return -(-bits * 1_000_000_000 // self.bitrate)

    def total_ns(self, length: int) -> int:
        """Return the time from the order to send until the last bit has left, ns."""
        return self.ramp_up_ns + self.on_air_ns(length)

    def to_radio_ns(self, length: int) -> int:
        """Return the time that a frame takes from the flight processor to the radio, ns."""
        return self.line.to_fixed_ns + self.line.to_byte_ns * length

    def from_radio_ns(self, length: int) -> int:
        """Return the time that a frame takes from the radio to the flight processor, ns."""
        return self.line.from_fixed_ns + self.line.from_byte_ns * length

    def of_messages(self, longest: int) -> Airtime:
        """Return the times of messages of up to some bytes, and a header: the radio sends packets, back to back."""

        def on_air_ns(length: int) -> int:
            packets, rest = divmod(length, self.longest)
            total_ns = packets * self.total_ns(self.longest) + (self.total_ns(rest) if rest else 0)
            return total_ns - self.ramp_up_ns

        return replace(self, longest=longest + LONGEST_FRAME, formula=on_air_ns)

    def latest_ns(self, length: int) -> int:
        """Return the longest time from the order to send until a receiver's flight processor has a frame, ns."""
        line, from_ns = self.line, self.from_radio_ns(length)
        return from_ns * line.waits + from_ns * max(0, line.queue - 1) + self.total_ns(length) + from_ns

    def shortest_slot_ns(self, length: int, *, guard_ns: int, decide_ns: int = 0, needs_frame: bool = False) -> int:
        """Return the shortest slot in which no frame overlaps another one or waits for one, ns.

        A policy that needs the frame of a slot to know who sends in the next one waits for its way from the radio, for
        the decision, and for the own frame's way to the radio. Others order their frame ahead of time, and the line is
        at work while the next slot goes on; only a radio that does nothing else while it hands a reception over keeps
        the own frame waiting until then.

        :param guard_ns: ns, largest difference of any clock from the common one, either way.
        :param decide_ns: ns, longest time to decide and to make a frame.
        :param needs_frame: whether an agent must have a slot's frame before it knows who sends in the next one.
        """
        to_ns, from_ns = self.to_radio_ns(length), self.from_radio_ns(length)
        on_air_ns = self.total_ns(length) + 2 * guard_ns
        if needs_frame:
            return on_air_ns + from_ns + decide_ns + to_ns
        return max(on_air_ns + (from_ns if self.line.waits else 0), from_ns, to_ns, decide_ns)


@dataclass(frozen=True, slots=True)
class RadioRow:
    """A radio: all that differs between them."""

    airtime: Airtime
    text: str  # what it is, for a table
    source: str  # where its times are from
    tuned: bool = False  # ``bitrate`` and ``ramp_up_ns`` are settings of it; else they are the row's


# Source of both ways: ``src/syslink.c`` and ``src/main.c`` of crazyflie2-nrf-firmware. At 1 Mbaud a byte takes 10 us.
# Around a frame there are 6 bytes of syslink and the port; on the way back its signal strength, too. The main loop
# writes a reception to the line byte by byte before it looks for frames to be sent. The queue has eight places, of
# which one stays empty; a reception is copied out of it before it is handed over.
_BYTE_NS = 10_000
CRAZYFLIE_LINE = Line(7 * _BYTE_NS, _BYTE_NS, 8 * _BYTE_NS, _BYTE_NS, waits=True, queue=8)

_SECOND = 1_000_000_000
_BITS = 10  # of a byte on a modem's line


def _modem(modem: Modem) -> RadioRow:
    """Return a modem on a serial line; its frames carry a datagram's header and what marks them on the line."""
    byte_ns = _BITS * _SECOND // modem.baud
    line = Line((FRAMING + modem.gap_bytes) * byte_ns, byte_ns, FRAMING * byte_ns, byte_ns)
    longest, formula = modem.packet - FRAMING, lambda length: modem.on_air_ns(FRAMING + length)
    airtime = Airtime(modem.bitrate, modem.turn_round_ns, 0, line, longest, formula)
    return RadioRow(airtime, f"{modem.text}, line of {modem.baud} baud, without turns of its own", modem.source)


#: Radios by the name that the setting ``radio`` gives them.
RADIOS: dict[str, RadioRow] = {
    "plain": RadioRow(
        Airtime(), "air time alone; `link_delay_ns` each way to and from the flight processor", "settings", tuned=True
    ),
    "crazyflie": RadioRow(
        Airtime(line=CRAZYFLIE_LINE, longest=60),
        "Crazyflie, nRF51 behind a line of 1 Mbaud, peer to peer",
        "nRF51 reference manual; crazyflie2-nrf-firmware",
        tuned=True,
    ),
    **{name: _modem(modem) for name, modem in MODEMS.items() if name != NONE},
}


def airtime_of(radio: str, bitrate: int, ramp_up_ns: int, link_delay_ns: int) -> Airtime:
    """Return the times of a radio, by its name, under settings as :class:`ChannelConfig` has them."""
    row = RADIOS[radio]
    if not row.tuned:
        return row.airtime
    line = Line(link_delay_ns, 0, link_delay_ns, 0) if radio == "plain" else row.airtime.line
    return _tuned(row.airtime, bitrate, ramp_up_ns, line)


@lru_cache(maxsize=64)  # each flight asks several times
def _tuned(airtime: Airtime, bitrate: int, ramp_up_ns: int, line: Line) -> Airtime:
    return replace(airtime, bitrate=bitrate, ramp_up_ns=ramp_up_ns, line=line)
