"""A multicast group as the port of an agent."""

from __future__ import annotations

import socket

from . import _socket
from .settings import UdpSettings
from .sockets import MulticastSocket


class UdpPort(MulticastSocket):
    """See the module; a :class:`~dtsa_agent.air.port.DatagramPort`.

    :param settings: interface, group and times under way.
    :raises ConfigError: if the interface cannot be used.
    """

    def __init__(self, settings: UdpSettings) -> None:
        super().__init__(settings)
        self.properties = settings.properties
        host, number = self.address
        self.compiled = _socket.open_port(self.fileno(), socket.inet_aton(host), number)

    def look(self) -> bool:
        """See :class:`MulticastSocket`; the compiled part learns from which address own datagrams come."""
        joined_again = super().look()
        if joined_again:
            host, number = self.address
            _socket.set_address(self.compiled, socket.inet_aton(host), number)
        return joined_again

    def counts(self) -> dict[str, int]:
        """Failed reads, how often the clock has been set, and how often the interface was another one."""
        unreadable, clock_steps = _socket.counts(self.compiled)
        return {"unreadable": unreadable, "clock_steps": clock_steps, "interface_changes": self.interface_changes}
