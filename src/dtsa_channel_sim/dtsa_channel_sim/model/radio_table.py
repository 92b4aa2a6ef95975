"""Radios by name: what a frame costs on the air, and on the line between flight processor and radio.

A row is all that differs: the medium, the shortest slot and the tables of the documents are made from it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from dtsa_agent.air.serial.lengths import FRAMING
from dtsa_agent.air.serial.modems import MODEMS, NONE, Modem

from .airtime import Airtime, Line


@dataclass(frozen=True, slots=True)
class RadioRow:
    """A radio.

    :param airtime: its times.
    :param text: what it is, for a table.
    :param source: where its times are from.
    :param tuned: whether ``bitrate`` and ``ramp_up_ns`` are settings of it; else they are the row's.
    """

    airtime: Airtime
    text: str
    source: str
    tuned: bool = False


# Source of both ways: ``src/syslink.c`` and ``src/main.c`` of crazyflie2-nrf-firmware. At 1 Mbaud a byte takes 10 us.
# Around a frame there are 6 bytes of syslink and the port; on the way back its signal strength, too. The main loop
# writes a reception to the line byte by byte before it looks for frames to be sent. The queue has eight places, of
# which one stays empty; a reception is copied out of it before it is handed over.
_BYTE_NS = 10_000
CRAZYFLIE_LINE = Line(7 * _BYTE_NS, _BYTE_NS, 8 * _BYTE_NS, _BYTE_NS, waits=True, queue=8)

_SECOND = 1_000_000_000
_BITS = 10  # of a byte on a modem's line


def _modem(modem: Modem) -> RadioRow:
    """Return a modem on a serial line; its frames carry a datagram's header and what marks them on the line.

    :param modem: its row among those that agents know.
    """
    byte_ns = _BITS * _SECOND // modem.baud
    line = Line((FRAMING + modem.gap_bytes) * byte_ns, byte_ns, FRAMING * byte_ns, byte_ns)
    airtime = Airtime(
        modem.bitrate,
        modem.turn_round_ns,
        0,
        line,
        modem.packet - FRAMING,
        lambda length: modem.on_air_ns(FRAMING + length),
    )
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
    """Return the times of a radio under settings.

    :param radio: its name in the table.
    :param bitrate: bit/s on air, where it is a setting of the radio.
    :param ramp_up_ns: ns from the order to send to the first bit, likewise.
    :param link_delay_ns: ns each way between flight processor and radio, with ``plain``.
    """
    row = RADIOS[radio]
    if not row.tuned:
        return row.airtime
    line = Line(link_delay_ns, 0, link_delay_ns, 0) if radio == "plain" else row.airtime.line
    return replace(row.airtime, bitrate=bitrate, ramp_up_ns=ramp_up_ns, line=line)
