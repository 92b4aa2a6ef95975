"""The port that carries an agent's datagrams over a network: a multicast group on one interface."""

from .port import UdpPort
from .settings import UdpSettings
from .sockets import MulticastSocket

__all__ = ["MulticastSocket", "UdpPort", "UdpSettings"]
