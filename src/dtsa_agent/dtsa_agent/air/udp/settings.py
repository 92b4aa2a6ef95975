"""The network that carries the frames of a swarm."""

from __future__ import annotations

import socket
from dataclasses import dataclass

from dtsa_agent.air.port import PortProperties
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, check, setting

_GROUP = "a multicast group and a port, as 239.68.84.83:7583"


@dataclass(frozen=True, slots=True)
class UdpSettings(Settings):
    """Where the frames of a swarm go.

    :raises ConfigError: at creation, naming the field, the value and what is allowed.
    """

    interface: str = setting(REQUIRED, "network interface that leads to the others, as eth0; lo: all on this computer")
    group: str = setting("239.68.84.83:7583", _GROUP, custom=True)
    ttl: int = setting(1, "routers that a frame may pass, and one", minimum=1, maximum=255)
    flight_time_ns: int = setting(
        30_000,
        "from the order to send a frame until its arrival at a receiver, without the time of its bytes",
        unit="ns",
        minimum=0,
        maximum=10**9,
    )
    byte_time_ns: int = setting(
        0, "what each byte of a frame adds to that, as on a slow radio", unit="ns", minimum=0, maximum=10**8
    )

    def __post_init__(self) -> None:
        check(self)
        _address(self.group)
        self.interface_index()

    @property
    def properties(self) -> PortProperties:
        """What agents, listeners and bags must know of it."""
        return PortProperties("udp", self.flight_time_ns, self.byte_time_ns)

    @property
    def where(self) -> str:
        """Where the frames go, for people."""
        return f"{self.group} on {self.interface}"

    @property
    def address(self) -> tuple[str, int]:
        """The group and its port."""
        return _address(self.group)

    def interface_index(self) -> int:
        """The number that the kernel gives the interface.

        :raises ConfigError: if there is no such interface.
        """
        try:
            return socket.if_nametoindex(self.interface)
        except (OSError, ValueError):
            known = ", ".join(name for _, name in socket.if_nameindex())
            raise ConfigError("interface", self.interface, known or "none: there is no network") from None


def _address(text: object) -> tuple[str, int]:
    host, colon, port = str(text).rpartition(":")
    try:
        first, *_ = socket.inet_pton(socket.AF_INET, host)
    except (OSError, ValueError):
        raise ConfigError("group", text, _GROUP) from None
    if not (colon and port.isascii() and port.isdigit() and 0 < int(port) < 65536 and first >> 4 == 14):
        raise ConfigError("group", text, f"{_GROUP}: 224.0.0.0 to 239.255.255.255, port 1 to 65535")
    return host, int(port)
