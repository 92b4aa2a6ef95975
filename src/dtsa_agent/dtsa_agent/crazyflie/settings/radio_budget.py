"""Does what is asked of the radios fit on the air?

Everything over a Crazyradio is an exchange: a packet, and its acknowledgement, which may carry one back. An exchange
takes the time of its bits on the air, the turns of both radios, and USB's turn-round; as cflib tells the dongle the
address by a request of its own, about 1 ms more whenever the Crazyflie is another one than before. Twice as many
exchanges as packets are wanted: an answer waits for the next exchange, and some are lost. Field experience is that 4
Crazyflies at 50 Hz of commands and logs work on one radio and 8 at 20 Hz; that is what comes out at 2 Mbit/s.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from dtsa_agent.core.errors import ConfigError

BITRATES = {"250K": 250_000, "1M": 1_000_000, "2M": 2_000_000}
OVERHEAD_BITS = 73  # of a packet: preamble, address, control, checksum
TURN_S = 130e-6  # until a radio sends
USB_S = 0.2e-3  # there and back: a Crazyradio 2 is known to carry about 1370 exchanges a second with one Crazyflie
REQUEST_S = 1e-3  # a request that changes the address, as its documentation says
UP_BYTES, DOWN_BYTES = 18, 25  # a velocity command, the state log
WATCHDOG_HZ = 4  # how often the bridge keeps the emergency stop watchdog quiet
ORDERS_HZ = 10  # orders have up to three packets, and are repeated until they are answered
EXCHANGES = 2  # for each packet
URI = re.compile(
    r"^(?:radio://(?P<radio>\d+|[0-9A-Fa-f]{10})(?:/\d+/(?P<rate>250K|1M|2M)(?:/[0-9A-Fa-f]{10})?)?"
    r"(?:\?[\w=&.]*)?|udp://[\w.-]+:\d{1,5}|usb://\d+)$"
)


@dataclass(frozen=True, slots=True)
class RadioLoad:
    """What one radio has to carry."""

    radio: str
    robots: tuple[str, ...]
    exchanges: float  # wanted, per second
    seconds: float  # that they take, per second

    @property
    def fits(self) -> bool:
        """True when the radio can carry it."""
        return self.seconds <= 1.0

    @property
    def capacity(self) -> float:
        """Exchanges per second that the radio can carry with these Crazyflies."""
        return self.exchanges / self.seconds

    def __str__(self) -> str:
        verdict = "fits" if self.fits else "DOES NOT FIT"
        load = f"{len(self.robots)} Crazyflies, {self.exchanges:.0f} of {self.capacity:.0f} exchanges/s"
        return f"radio {self.radio}: {load}: {verdict}"


def radio_of(uri: str) -> str | None:
    """Number or serial of the radio in a URI; None for a link that needs no radio (udp, usb).

    :raises ConfigError: not a URI that cflib understands.
    """
    return _parts(uri)["radio"]


def _parts(uri: str) -> re.Match[str]:
    match = URI.match(uri)
    if match is None:
        raise ConfigError(
            "uri",
            uri,
            "radio://RADIO/CHANNEL/RATE/ADDRESS such as radio://0/80/2M/E7E7E7E701, udp://HOST:PORT or usb://NUMBER",
        )
    return match


def exchange_s(rate: str, up: int = UP_BYTES, down: int = DOWN_BYTES, *, shared: bool = False) -> float:
    """How long an exchange takes, s.

    :param rate: a key of BITRATES.
    :param up: bytes of the packet. :param down: bytes of what the acknowledgement carries.
    :param shared: the radio has several Crazyflies.
    """
    bits = 2 * OVERHEAD_BITS + 8 * (up + down)
    return (REQUEST_S if shared else 0.0) + USB_S + 2 * TURN_S + bits / BITRATES[rate]


def exchange_rate(command_hz: float, log_hz: float) -> float:
    """Exchanges per second that one Crazyflie wants.

    :param command_hz: Hz, rate of the streamed commands. :param log_hz: Hz, rate of the log block.
    """
    return EXCHANGES * (max(command_hz, log_hz) + WATCHDOG_HZ + ORDERS_HZ)


def radio_loads(robots: Sequence[tuple[str, str, float, float]]) -> list[RadioLoad]:
    """What each radio has to carry.

    :param robots: name, URI, command rate (Hz) and log rate (Hz) of each.
    """
    found: dict[str, list[tuple[str, str, float]]] = {}
    for name, uri, command_hz, log_hz in robots:
        match = _parts(uri)
        if match["radio"] is not None:
            wanted = exchange_rate(command_hz, log_hz)
            found.setdefault(match["radio"], []).append((name, match["rate"] or "2M", wanted))
    return [_load(radio, found[radio]) for radio in sorted(found)]


def _load(radio: str, robots: list[tuple[str, str, float]]) -> RadioLoad:
    shared = len(robots) > 1
    exchanges = sum(wanted for _, _, wanted in robots)
    seconds = sum(wanted * exchange_s(rate, shared=shared) for _, rate, wanted in robots)
    return RadioLoad(radio, tuple(name for name, _, _ in robots), exchanges, seconds)


def check_budget(loads: Sequence[RadioLoad], *, force: bool) -> None:
    """Refuse what cannot fit.

    :param force: let it pass.
    :raises ConfigError: a radio has too much to carry.
    """
    for load in loads:
        if not load.fits and not force:
            most = int(len(load.robots) / load.seconds)
            raise ConfigError(
                f"radio {load.radio}",
                f"{len(load.robots)} Crazyflies with {load.exchanges:.0f} exchanges/s",
                f"{load.capacity:.0f} exchanges/s, {most} Crazyflies at these rates: lower command_rate_hz and "
                "log_rate_hz, use more radios or a higher data rate, or set force_budget",
            )
