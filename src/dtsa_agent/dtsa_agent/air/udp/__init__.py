"""The port that carries an agent's datagrams over a network: a multicast group on one interface."""

from .port import UdpPort
from .settings import UdpSettings

__all__ = ["UdpPort", "UdpSettings"]
