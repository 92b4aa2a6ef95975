"""The Crazyradio that carries the frames of a swarm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from dtsa_agent.air.port import PortProperties
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, check, setting

from .packets import HIGHEST_CHANNEL, LONGEST_DATA, RATES

_URI = "radio://RADIO/CHANNEL/RATE, as radio://0/80/2M"
_BITS = 73 + 8 * 2  # on air beside the data: preamble, address, control, checksum; the header of peer-to-peer
_SHORTEST_SLOT_NS = 10_000_000  # when a frame leaves, nobody knows to a millisecond; for one more its sender is deaf


class Place(NamedTuple):
    """What a URI says."""

    radio: str  # number of the dongle among those plugged in, from 0, or its serial number
    channel: int  # 2400 MHz and so many more
    rate: str


@dataclass(frozen=True, slots=True)
class CrazyradioSettings(Settings):
    """Where the frames of a swarm go.

    :raises ConfigError: at creation, naming the field, the value and what is allowed.
    """

    uri: str = setting(REQUIRED, f"the dongle: {_URI}; RADIO is its number, from 0, or its serial number", custom=True)
    p2p_port: int = setting(7, "port of peer-to-peer communication between Crazyflies", minimum=0, maximum=15)
    send_time_ns: int = setting(
        1_100_000,
        "from the order to send a frame until its arrival at a receiver, without the time of its bits",
        unit="ns",
        minimum=0,
        maximum=10**8,
    )
    simulated_radio: str = setting(
        "", "simulation only: socket of `fake-crazyflie --simulated-radio SOCKET`, whose dongles take the place of real"
    )  # fmt: skip

    def __post_init__(self) -> None:
        check(self)
        _place(self.uri)

    @property
    def place(self) -> Place:
        """Dongle, channel and rate."""
        return _place(self.uri)

    @property
    def properties(self) -> PortProperties:
        """What agents, listeners and bags must know of it."""
        bit_ns = 1_000 // RATES[self.place.rate]  # the numbers of the rates are their Mbit/s
        return PortProperties(
            "crazyradio",
            self.send_time_ns + _BITS * bit_ns,
            8 * bit_ns,
            agreed_bytes=2,
            peers=0,
            longest=LONGEST_DATA,
            bare_sealed=True,
            shortest_slot_ns=_SHORTEST_SLOT_NS,
            varies=True,
        )

    @property
    def where(self) -> str:
        """Where the frames go, for people."""
        return f"{self.uri}, P2P port {self.p2p_port}"


def _place(uri: object) -> Place:
    words = str(uri).removeprefix("radio://").split("/")
    if not str(uri).startswith("radio://") or len(words) != 3 or not (words[0].isascii() and words[0].isalnum()):
        raise ConfigError("uri", uri, _URI)
    radio, channel, rate = words
    if not (channel.isascii() and channel.isdigit() and len(channel) < 4 and int(channel) <= HIGHEST_CHANNEL):
        raise ConfigError("uri", uri, f"{_URI}: channel 0 to {HIGHEST_CHANNEL}")
    if rate not in RATES:
        raise ConfigError("uri", uri, f"{_URI}: rate {' or '.join(RATES)}")
    return Place(radio, int(channel), rate)
