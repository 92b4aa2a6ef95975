"""Does what is asked of the radios fit on the air?

A Crazyradio 2 carries about 1370 packets a second in all, and every packet to a Crazyflie has one back. Field
experience is that 4 Crazyflies at 50 Hz of commands and logs work on one radio and 8 at 20 Hz. That is what comes out
if each packet is counted three times: itself, the poll that fetches the answer, and room for a repetition.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from dtsa_agent.core.errors import ConfigError

RADIO_PACKETS = 1370  # packets/s of one Crazyradio 2
PACKET_COST = 3
PING_HZ = 10  # cflib measures the latency that often
WATCHDOG_HZ = 4  # how often the bridge keeps the emergency stop watchdog quiet
URI = re.compile(
    r"^(?:radio://(?P<radio>\d+|[0-9A-Fa-f]{10})(?:/\d+/(?:250K|1M|2M)(?:/[0-9A-Fa-f]{10})?)?"
    r"(?:\?[\w=&.]*)?|udp://[\w.-]+:\d{1,5}|usb://\d+)$"
)


@dataclass(frozen=True, slots=True)
class RadioLoad:
    """What one radio has to carry."""

    radio: str
    robots: tuple[str, ...]
    packets: float  # packets/s

    @property
    def fits(self) -> bool:
        """True when the radio can carry it."""
        return self.packets <= RADIO_PACKETS

    def __str__(self) -> str:
        verdict = "fits" if self.fits else "DOES NOT FIT"
        load = f"{len(self.robots)} Crazyflies, {self.packets:.0f} of {RADIO_PACKETS} packets/s"
        return f"radio {self.radio}: {load}: {verdict}"


def radio_of(uri: str) -> str | None:
    """Number or serial of the radio in a URI; None for a link that needs no radio (udp, usb).

    :raises ConfigError: not a URI that cflib understands.
    """
    match = URI.match(uri)
    if match is None:
        raise ConfigError(
            "uri",
            uri,
            "radio://RADIO/CHANNEL/RATE/ADDRESS such as radio://0/80/2M/E7E7E7E701, udp://HOST:PORT or usb://NUMBER",
        )
    return match["radio"]


def packet_rate(command_hz: float, log_hz: float) -> float:
    """Packets per second that one Crazyflie takes.

    :param command_hz: rate of the streamed commands. :param log_hz: rate of the log block.
    """
    return PACKET_COST * (command_hz + log_hz + PING_HZ + WATCHDOG_HZ)


def radio_loads(robots: Sequence[tuple[str, str, float, float]]) -> list[RadioLoad]:
    """What each radio has to carry.

    :param robots: name, URI, command rate (Hz) and log rate (Hz) of each.
    """
    names: dict[str, list[str]] = {}
    packets: dict[str, float] = {}
    for name, uri, command_hz, log_hz in robots:
        radio = radio_of(uri)
        if radio is not None:
            names.setdefault(radio, []).append(name)
            packets[radio] = packets.get(radio, 0.0) + packet_rate(command_hz, log_hz)
    return [RadioLoad(radio, tuple(names[radio]), packets[radio]) for radio in sorted(names)]


def check_budget(loads: Sequence[RadioLoad], *, force: bool) -> None:
    """Refuse what cannot fit.

    :param force: let it pass.
    :raises ConfigError: a radio has too much to carry.
    """
    for load in loads:
        if not load.fits and not force:
            per_robot = load.packets / len(load.robots)
            raise ConfigError(
                f"radio {load.radio}",
                f"{len(load.robots)} Crazyflies with {load.packets:.0f} packets/s",
                f"{RADIO_PACKETS} packets/s, {int(RADIO_PACKETS // per_robot)} Crazyflies at these rates: lower "
                "command_rate_hz and log_rate_hz, use more radios, or set force_budget",
            )
