"""Settings of a live agent that its swarm need not share, and of the ports that carry its datagrams.

Each class is validated at creation: ConfigError names the field, the value and what is allowed.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass
from typing import NamedTuple

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import MAX_AGENTS
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, check, setting
from dtsa_agent.core.station import ALL_BUT_ONE, QUORUMS, parse_quorum

from .port import PortProperties
from .serial_modems import LONGEST, MODEMS, NONE, OVERHEAD

_SECOND = 1_000_000_000


@dataclass(frozen=True, slots=True)
class AgentSettings(Settings):
    """One agent of a swarm, and its clock."""

    id: int = setting(REQUIRED, "id of this agent, 1 to agents", minimum=1, maximum=MAX_AGENTS)
    duration_s: float = setting(
        0.0, "it ends by itself after this time; 0: with a signal only", unit="s", minimum=0, maximum=1e6
    )
    quorum: str = setting(
        ALL_BUT_ONE, f"it hovers unless it hears, and is heard by, so many of the others: {QUORUMS}", custom=True
    )
    priority: int = setting(20, "real-time priority, where allowed; 0: none", minimum=0, maximum=90)
    clock_offset_ns: int = setting(
        0, "for trials: its clock shows this much more at the start", unit="ns", minimum=-(10**15), maximum=10**15
    )
    clock_drift_ppb: int = setting(
        0, "for trials: its clock runs fast by this many parts per billion", minimum=-(10**6), maximum=10**6
    )

    def __post_init__(self) -> None:
        check(self)
        if type(self.quorum) is int:  # as YAML and ROS have numbers
            object.__setattr__(self, "quorum", str(self.quorum))
        parse_quorum(self.quorum)


_GROUP = "a multicast group and a port, as 239.68.84.83:7583"
_FLIGHT = "from the order to send a frame until its arrival at a receiver, without the time of its"


@dataclass(frozen=True, slots=True)
class UdpSettings(Settings):
    """The network interface and multicast group that carry the frames of a swarm."""

    interface: str = setting(REQUIRED, "network interface that leads to the others, as eth0; lo: all on this computer")
    group: str = setting("239.68.84.83:7583", _GROUP, custom=True)
    ttl: int = setting(1, "routers that a frame may pass, and one", minimum=1, maximum=255)
    flight_time_ns: int = setting(30_000, f"{_FLIGHT} bytes", unit="ns", minimum=0, maximum=10**9)
    byte_time_ns: int = setting(
        0, "what each byte of a frame adds to that, as on a slow radio", unit="ns", minimum=0, maximum=10**8
    )

    def __post_init__(self) -> None:
        check(self)
        _parse_group(self.group)
        self.interface_index()

    @property
    def properties(self) -> PortProperties:
        return PortProperties("udp", self.flight_time_ns, self.byte_time_ns)

    @property
    def destination(self) -> str:
        return f"{self.group} on {self.interface}"

    @property
    def address(self) -> tuple[str, int]:
        """The group and its port."""
        return _parse_group(self.group)

    def interface_index(self) -> int:
        """Return the number that the kernel gives the interface; ConfigError: there is none of this name."""
        try:
            return socket.if_nametoindex(self.interface)
        except (OSError, ValueError):
            known = ", ".join(name for _, name in socket.if_nameindex())
            raise ConfigError("interface", self.interface, known or "none: there is no network") from None


def _parse_group(text: object) -> tuple[str, int]:
    parts = re.fullmatch(r"([0-9.]+):([0-9]{1,5})", str(text))
    try:
        if parts and ipaddress.IPv4Address(parts[1]).is_multicast and 0 < int(parts[2]) < 65536:
            return parts[1], int(parts[2])
    except ValueError:  # no address
        pass
    raise ConfigError("group", text, f"{_GROUP}: 224.0.0.0 to 239.255.255.255, port 1 to 65535")


_RADIO_BITS = 73 + 8 * 2  # on air beside the data: preamble, address, control, checksum; the header of peer-to-peer
_RATES_MBPS = {"1M": 1, "2M": 2}  # a Crazyradio 2.0 has no 250K
_HIGHEST_CHANNEL = 100
_URI = "radio://RADIO/CHANNEL/RATE, as radio://0/80/2M"
_URI_ALLOWED = f"{_URI}: channel 0 to {_HIGHEST_CHANNEL}, rate {' or '.join(_RATES_MBPS)}"
_LONGEST_BROADCAST = 60  # bytes between Crazyflies
_SHORTEST_RADIO_SLOT_NS = 10_000_000  # when a frame leaves is known to 1 ms; for one more its sender is deaf


class DongleAddress(NamedTuple):
    """The parts of a Crazyradio's URI."""

    radio: str  # number of the dongle among those plugged in, from 0, or its serial number
    channel: int  # 2400 MHz and so many more
    rate_mbps: int  # as the dongle numbers its rates


@dataclass(frozen=True, slots=True)
class CrazyradioSettings(Settings):
    """The Crazyradio that carries the frames of a swarm, as broadcasts between Crazyflies."""

    uri: str = setting(REQUIRED, f"the dongle: {_URI}; RADIO is its number, from 0, or its serial number", custom=True)
    p2p_port: int = setting(7, "port of peer-to-peer communication between Crazyflies", minimum=0, maximum=15)
    send_time_ns: int = setting(1_100_000, f"{_FLIGHT} bits", unit="ns", minimum=0, maximum=10**8)
    simulated_radio: str = setting(
        "", "simulation only: socket of `fake-crazyflie --simulated-radio SOCKET`, whose dongles take the place of real"
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self)
        _ = self.address

    @property
    def address(self) -> DongleAddress:
        """Dongle, channel and rate."""
        parts = re.fullmatch(r"radio://([0-9A-Za-z]+)/([0-9]{1,3})/(\w+)", str(self.uri))
        if parts is None or int(parts[2]) > _HIGHEST_CHANNEL or parts[3] not in _RATES_MBPS:
            raise ConfigError("uri", self.uri, _URI_ALLOWED)
        return DongleAddress(parts[1], int(parts[2]), _RATES_MBPS[parts[3]])

    @property
    def properties(self) -> PortProperties:
        bit_ns = 1_000 // self.address.rate_mbps
        return PortProperties(
            "crazyradio", self.send_time_ns + _RADIO_BITS * bit_ns, 8 * bit_ns, agreed_bytes=2, peers=0,
            longest=_LONGEST_BROADCAST, bare_sealed=True, shortest_slot_ns=_SHORTEST_RADIO_SLOT_NS, varies=True,
        )  # fmt: skip

    @property
    def destination(self) -> str:
        return f"{self.uri}, P2P port {self.p2p_port}"


_LINE_BITS = 10  # of a byte on the line
_SHORT, _LONG = 40, 140  # bytes between which the time of a byte on the air is measured: LoRa sends blocks of them


@dataclass(frozen=True, slots=True)
class SerialSettings(Settings):
    """The modem that carries the frames of a swarm, and the serial line to it. It was never run on hardware."""

    device: str = setting(REQUIRED, "the serial device of the modem, as /dev/ttyUSB0", custom=True)
    baud: int = setting(57_600, "speed of the line to the modem", unit="bit/s", minimum=1200, maximum=4_000_000)
    modem: str = setting(NONE, "the modem, from whose times arrivals are corrected", choices=tuple(MODEMS))
    modem_time_ns: int | None = setting(
        None, "what the modem takes for a packet without the time of its bytes; default: as of its kind", unit="ns",
        minimum=0, maximum=10 * _SECOND,
    )  # fmt: skip
    air_byte_ns: int | None = setting(
        None, "what each byte takes on the air; default: as of its kind", unit="ns", minimum=0, maximum=_SECOND
    )

    def __post_init__(self) -> None:
        check(self)
        if not isinstance(self.device, str) or not self.device or "\0" in self.device:
            raise ConfigError("device", self.device, "the serial device of the modem, as /dev/ttyUSB0")

    @property
    def line_byte_ns(self) -> int:
        """What a byte takes on the line."""
        return _LINE_BITS * _SECOND // self.baud

    @property
    def properties(self) -> PortProperties:
        modem, line_ns = MODEMS[self.modem], self.line_byte_ns
        byte_ns = (modem.on_air_ns(_LONG) - modem.on_air_ns(_SHORT)) // (_LONG - _SHORT)
        modem_ns = modem.turn_round_ns + modem.on_air_ns(_SHORT) - byte_ns * _SHORT
        byte_ns = byte_ns if self.air_byte_ns is None else self.air_byte_ns
        modem_ns = modem_ns if self.modem_time_ns is None else self.modem_time_ns
        each_ns = 2 * line_ns + byte_ns  # a modem sends what it has whole, and so does the one that receives it
        fixed_ns = modem_ns + modem.gap_bytes * line_ns + OVERHEAD * each_ns
        longest = min(LONGEST, modem.packet - OVERHEAD)
        return PortProperties(
            "serial", fixed_ns, each_ns, agreed_bytes=2, peers=1, longest=longest, turn_ns=modem.turn_ns,
            slots_hold_flights=True, varies=True,
        )  # fmt: skip

    @property
    def destination(self) -> str:
        return f"{self.device} at {self.baud} baud, modem {self.modem}"
