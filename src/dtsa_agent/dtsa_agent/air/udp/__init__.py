"""Agents whose frames go over a network: one process each, no channel node, no start signal, no ROS."""

from .agent import UdpAgent
from .record import Heard, SlotRecord, Watcher
from .settings import AgentSettings, UdpSettings
from .sockets import MulticastSocket
from .vehicle import SimulatedVehicle, Vehicle

__all__ = [
    "AgentSettings", "Heard", "MulticastSocket", "SimulatedVehicle", "SlotRecord", "UdpAgent", "UdpSettings", "Vehicle",
    "Watcher",
]  # fmt: skip
