"""Where Crazyflies are reached: addresses as cflib has them, which of them name one link, and what each radio carries.

Everything over a Crazyradio is an exchange: a packet, and its acknowledgement, which may carry one back. An exchange
takes the time of its bits on the air, the turns of both radios, and USB's turn-round; the dongle is told the address by
a request of its own, about 1 ms more whenever the Crazyflie is another one than before. Twice as many exchanges as
packets are wanted: an answer waits for the next exchange, and some are lost. Field experience is that 4 Crazyflies at
50 Hz of commands and logs work on one radio and 8 at 20 Hz; that is what comes out at 2 Mbit/s.

Dongles on one channel disturb each other, so a channel carries no more than one dongle.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from dtsa_agent.core.errors import ConfigError, DtsaError

BITRATES = {"250K": 250_000, "1M": 1_000_000, "2M": 2_000_000}
ANY = "*"  # any dongle
LAST_CHANNEL, LAST_PORT = 125, 65535
OVERHEAD_BITS = 73  # of a packet: preamble, address, control, checksum
TURN_S = 130e-6  # until a radio sends
USB_S = 0.2e-3  # there and back: a Crazyradio 2 is known to carry about 1370 exchanges a second with one Crazyflie
REQUEST_S = 1e-3  # a request that changes the address, as its documentation says
UP_BYTES, DOWN_BYTES = 18, 25  # a velocity command, the state log
WATCHDOG_HZ = 4  # how often the bridge keeps the emergency stop watchdog quiet
ORDERS_HZ = 10  # orders have up to three packets, and are repeated until they are answered
EXCHANGES = 2  # for each packet
_ALLOWED = (
    "an address of cflib: radio://RADIO/CHANNEL/RATE/ADDRESS such as radio://0/80/2M/E7E7E7E701 (RADIO: number, serial "
    "or *), udp://HOST:PORT, tcp://HOST:PORT, usb://NUMBER, serial://PORT"
)
_RADIO = re.compile(
    r"radio://(?P<radio>\*|\d{1,9}|[0-9A-Fa-f]{10})"
    r"(?:/(?P<channel>\d{1,3})(?:/(?P<rate>250K|1M|2M)(?:/(?P<node>[0-9A-Fa-f]{1,10}))?)?)?/?(?:\?[\w=&.]*)?"
)
_NETWORK = re.compile(r"(?P<scheme>udp|tcp)://(?P<host>[\w.-]+):(?P<port>\d{1,6})/?")
_WIRED = re.compile(r"(?P<scheme>usb|serial|prrt)://[\w./:-]+")


class LinkError(DtsaError):
    """A connection could not be made; the text says why."""


@dataclass(slots=True)
class LinkCounters:
    """What a link says about itself."""

    sent: int = 0  # packets but for polls
    quality: float = 1.0  # 0..1, of the radio
    rssi: int = 0  # -dBm; 0: the link does not say
    acknowledged: float = float("-inf")  # s, monotonic: when anything last came, or was acknowledged


@dataclass(frozen=True, slots=True)
class Address:
    """One Crazyflie's address, with cflib's defaults written out."""

    uri: str
    scheme: str
    radio: str = ""  # number or serial of the dongle, `ANY`; empty: no radio
    channel: int = 2
    rate: str = "2M"
    node: str = "E7E7E7E7E7"  # address on the air
    host: str = ""
    port: int = 0

    @property
    def link(self) -> str:
        """Text that two addresses of one Crazyflie have in common, whatever dongle reaches it."""
        if self.radio:
            return f"radio {self.channel}/{self.rate}/{self.node}"
        if self.port:
            return f"{self.scheme} {self.host}:{self.port}"
        return self.uri.lower().rstrip("/")


def parse_address(uri: str) -> Address:
    """Read an address; ConfigError: cflib would not understand it."""
    if match := _RADIO.fullmatch(uri):
        channel, node = int(match["channel"] or 2), (match["node"] or "E7E7E7E7E7").upper().rjust(10, "0")
        if channel > LAST_CHANNEL:
            raise ConfigError("uri", uri, f"a channel from 0 to {LAST_CHANNEL}")
        return Address(uri, "radio", match["radio"].upper(), channel, match["rate"] or "2M", node)
    if match := _NETWORK.fullmatch(uri):
        if not 1 <= int(match["port"]) <= LAST_PORT:
            raise ConfigError("uri", uri, f"a port from 1 to {LAST_PORT}")
        host = match["host"].lower()
        return Address(uri, match["scheme"], host="127.0.0.1" if host == "localhost" else host, port=int(match["port"]))
    if match := _WIRED.fullmatch(uri):
        return Address(uri, match["scheme"])
    raise ConfigError("uri", uri, _ALLOWED)


def check_distinct(robots: Sequence[tuple[str, Address]]) -> None:
    """Refuse one Crazyflie under two names; hosts that share a port are looked up.

    :param robots: name and address of each.
    :raises ConfigError: two addresses are of one link.
    """
    ports = [(address.scheme, address.port) for _, address in robots]
    names: dict[str, str] = {}
    for name, address in robots:
        link = address.link
        if address.port and ports.count((address.scheme, address.port)) > 1:
            link = f"{address.scheme} {_resolve(address.host)}:{address.port}"
        if link in names:
            allowed = f"a Crazyflie of its own ({names[link]} is reached by the same link)"
            raise ConfigError(f"robots.{name}.uri", address.uri, allowed)
        names[link] = name


def _resolve(host: str) -> str:
    try:
        return socket.gethostbyname(host)
    except OSError:
        return host


# -- what radios carry ------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class RadioUser:
    """What one Crazyflie asks of its radio."""

    name: str
    address: Address
    command_hz: float  # Hz, streamed commands and positions
    log_hz: float  # Hz, state log


@dataclass(frozen=True, slots=True)
class RadioLoad:
    """What one radio, or one channel of several radios, has to carry."""

    medium: str  # radio, or channel of several radios
    robots: tuple[str, ...]
    exchanges: float  # wanted, per second
    seconds: float  # that they take, per second
    fitting_hz: float  # Hz: rate of commands and logs with which it would fit

    @property
    def fits(self) -> bool:
        """True when the radio can carry it."""
        return self.seconds <= 1.0

    @property
    def capacity(self) -> float:
        """Exchanges per second that the radio can carry with these Crazyflies."""
        return self.exchanges / self.seconds

    def __str__(self) -> str:
        load = f"{len(self.robots)} Crazyflies, {self.exchanges:.0f} of {self.capacity:.0f} exchanges/s"
        return f"{self.medium}: {load}: {'fits' if self.fits else f'DOES NOT FIT ({self.advice})'}"

    @property
    def advice(self) -> str:
        """Rates with which it would fit."""
        rate = int(self.fitting_hz)
        return f"command_rate_hz and log_rate_hz {rate} fit" if rate >= WATCHDOG_HZ else "no rate fits"


def exchange_s(rate: str, up: int = UP_BYTES, down: int = DOWN_BYTES, *, shared: bool = False) -> float:
    """Return how long an exchange takes, s.

    :param rate: a key of BITRATES.
    :param up: bytes of the packet.
    :param down: bytes of what the acknowledgement carries.
    :param shared: the radio has several Crazyflies.
    """
    bits = 2 * OVERHEAD_BITS + 8 * (up + down)
    return (REQUEST_S if shared else 0.0) + USB_S + 2 * TURN_S + bits / BITRATES[rate]


def radio_loads(users: Iterable[RadioUser]) -> list[RadioLoad]:
    """Return what each dongle has to carry, and what each channel has to that several dongles use."""
    dongles: dict[str, list[RadioUser]] = {}
    channels: dict[int, list[RadioUser]] = {}
    for user in users:
        if user.address.radio:
            anywhere = f" on channel {user.address.channel}" if user.address.radio == ANY else ""
            dongles.setdefault(f"radio {user.address.radio}{anywhere}", []).append(user)
            channels.setdefault(user.address.channel, []).append(user)
    loads = [_load(medium, dongles[medium]) for medium in sorted(dongles)]
    for channel, sharing in sorted(channels.items()):
        radios = sorted({user.address.radio for user in sharing})
        if len(radios) > 1:
            loads.append(_load(f"channel {channel} of radios {', '.join(radios)}", sharing))
    return loads


def _load(medium: str, users: list[RadioUser]) -> RadioLoad:
    times = [EXCHANGES * exchange_s(user.address.rate, shared=len(users) > 1) for user in users]
    rates = [max(user.command_hz, user.log_hz) + WATCHDOG_HZ + ORDERS_HZ for user in users]
    return RadioLoad(
        medium, tuple(user.name for user in users), EXCHANGES * sum(rates),
        sum(time * rate for time, rate in zip(times, rates, strict=True)), 1.0 / sum(times) - WATCHDOG_HZ - ORDERS_HZ,
    )  # fmt: skip


def check_budget(loads: Sequence[RadioLoad], *, force: bool) -> None:
    """Refuse what cannot fit.

    :param force: let it pass.
    :raises ConfigError: a radio or a channel has too much to carry.
    """
    for load in loads:
        if not load.fits and not force:
            most = int(len(load.robots) / load.seconds)
            raise ConfigError(
                load.medium,
                f"{len(load.robots)} Crazyflies with {load.exchanges:.0f} exchanges/s",
                f"{load.capacity:.0f} exchanges/s, {most} Crazyflies at these rates: {load.advice}, use more radios "
                "on channels of their own or a higher data rate, or set force_budget",
            )
