"""Where Crazyflies are reached: addresses as cflib has them, which of them name one link, and what each radio carries.

Everything over a Crazyradio is an exchange: a packet, and its acknowledgement, which may carry one back. It takes the
time of its bits on the air, the turns of both radios, and USB's; where a dongle has several Crazyflies, also a request
that tells it the address. Twice as many exchanges as packets are wanted: an answer waits for the next exchange, and
some are lost. Field experience is that one radio carries 4 Crazyflies at 50 Hz of commands and logs, and 8 at 20 Hz;
that is what comes out at 2 Mbit/s. Dongles on one channel disturb each other, so a channel carries no more than one.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Iterable, Sequence
from contextlib import suppress
from typing import NamedTuple

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


class Address(NamedTuple):
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
        host, port = match["host"].lower(), int(match["port"])
        if not 1 <= port <= LAST_PORT:
            raise ConfigError("uri", uri, f"a port from 1 to {LAST_PORT}")
        return Address(uri, match["scheme"], host="127.0.0.1" if host == "localhost" else host, port=port)
    if match := _WIRED.fullmatch(uri):
        return Address(uri, match["scheme"])
    raise ConfigError("uri", uri, _ALLOWED)


def check_distinct(robots: Sequence[tuple[str, Address]]) -> None:
    """Refuse one Crazyflie, or link, under two names (ConfigError); hosts that share a port are looked up."""
    ports = [(address.scheme, address.port) for _, address in robots]
    names: dict[str, str] = {}
    for name, address in robots:
        link = address.link
        if address.port and ports.count((address.scheme, address.port)) > 1:
            with suppress(OSError, UnicodeError):  # not known, or no name of a host
                link = f"{address.scheme} {socket.gethostbyname(address.host)}:{address.port}"
        if link in names:
            allowed = f"a Crazyflie of its own ({names[link]} is reached by the same link)"
            raise ConfigError(f"robots.{name}.uri", address.uri, allowed)
        names[link] = name


class RadioLoad(NamedTuple):
    """What one radio, or one channel of several radios, has to carry."""

    medium: str  # radio, or channel of several radios
    number: int  # of Crazyflies
    exchanges: float  # wanted, per second
    seconds: float  # that they take, per second
    fitting_hz: float  # Hz: rate of commands and logs with which it would fit

    @property
    def fits(self) -> bool:
        return self.seconds <= 1.0

    def __str__(self) -> str:
        capacity = self.exchanges / self.seconds
        load = f"{self.medium}: {self.number} Crazyflies, {self.exchanges:.0f} of {capacity:.0f} exchanges/s"
        return f"{load}: fits" if self.fits else f"{load}: DOES NOT FIT ({self.advice})"

    @property
    def advice(self) -> str:
        """Rates with which it would fit."""
        rate = int(self.fitting_hz)
        return f"command_rate_hz and log_rate_hz {rate} fit" if rate >= WATCHDOG_HZ else "no rate fits"


def exchange_s(rate: str, *, shared: bool) -> float:
    """Return how long an exchange takes, s, at a rate of BITRATES; `shared`: the radio has several Crazyflies."""
    bits = 2 * OVERHEAD_BITS + 8 * (UP_BYTES + DOWN_BYTES)
    return (REQUEST_S if shared else 0.0) + USB_S + 2 * TURN_S + bits / BITRATES[rate]


def radio_loads(users: Iterable[tuple[Address, float]]) -> list[RadioLoad]:
    """Return what each dongle has to carry, and what each channel has to that several dongles use.

    :param users: address of each Crazyflie, and the larger of the rates (Hz) of its packets each way.
    """
    media: dict[str, list[tuple[Address, float]]] = {}
    channels: dict[int, list[tuple[Address, float]]] = {}
    for address, rate in users:
        if address.radio:
            anywhere = f" on channel {address.channel}" if address.radio == ANY else ""
            media.setdefault(f"radio {address.radio}{anywhere}", []).append((address, rate))
            channels.setdefault(address.channel, []).append((address, rate))
    media = dict(sorted(media.items()))
    for channel, sharing in sorted(channels.items()):
        radios = sorted({address.radio for address, _ in sharing})
        if len(radios) > 1:
            media[f"channel {channel} of radios {', '.join(radios)}"] = sharing
    loads = []
    for medium, members in media.items():
        times = [EXCHANGES * exchange_s(address.rate, shared=len(members) > 1) for address, _ in members]
        rates = [rate + WATCHDOG_HZ + ORDERS_HZ for _, rate in members]
        seconds = sum(time * rate for time, rate in zip(times, rates, strict=True))
        fitting_hz = 1.0 / sum(times) - WATCHDOG_HZ - ORDERS_HZ
        loads.append(RadioLoad(medium, len(members), EXCHANGES * sum(rates), seconds, fitting_hz))
    return loads


def check_budget(loads: Iterable[RadioLoad], *, force: bool) -> None:
    """Refuse what cannot fit, unless that is forced; ConfigError: a radio or a channel has too much to carry."""
    for load in loads:
        if not load.fits and not force:
            most, capacity = int(load.number / load.seconds), load.exchanges / load.seconds
            raise ConfigError(
                load.medium, f"{load.number} Crazyflies with {load.exchanges:.0f} exchanges/s",
                f"{capacity:.0f} exchanges/s, {most} Crazyflies at these rates: {load.advice}, use more radios "
                "on channels of their own or a higher data rate, or set force_budget",
            )  # fmt: skip
