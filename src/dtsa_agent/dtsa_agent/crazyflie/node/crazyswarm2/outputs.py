"""What Crazyswarm2's programs hear: places in the world's frame, and its status."""

from __future__ import annotations

from typing import Any

from rclpy.node import Node

from dtsa_agent.crazyflie.node.outputs import Outputs
from dtsa_agent.crazyflie.settings.config import SwarmSettings
from dtsa_agent.crazyflie.state.conversions import Vector, VehicleState
from dtsa_agent.crazyflie.vehicle.snapshot import Snapshot

from .interfaces import Interfaces

LOW_POWER = 3  # pm_state
SUPERVISOR_BITS = 0xFFFF


class Crazyswarm2Outputs(Outputs):
    """Publishers of all vehicles, with Crazyswarm2's messages.

    :param node: publishes.
    :param settings: the swarm's.
    :param interfaces: Crazyswarm2's messages.
    """

    frame = "world"

    def __init__(self, node: Node, settings: SwarmSettings, interfaces: Interfaces) -> None:
        self.status_type = interfaces.msg.Status
        self._critical = {robot.name: robot.battery.voltage_critical for robot in settings.robots}
        self._counted: dict[str, tuple[int, int]] = {}
        super().__init__(node, settings)

    def _place(self, state: VehicleState) -> Vector:
        return state.position

    def _status_message(self, s: Snapshot, stamp: Any) -> Any:
        """Its status; the packets are those since the one before."""
        sent, received = self._counted.get(s.name, (0, 0))
        self._counted[s.name] = s.sent, s.received
        volts = s.vehicle.battery if s.vehicle else 0.0
        message = self.status_type(
            supervisor_info=s.vehicle.info & SUPERVISOR_BITS if s.vehicle else 0,
            battery_voltage=volts,
            pm_state=LOW_POWER if s.vehicle and volts < self._critical[s.name] else 0,
            rssi=s.rssi,
            num_tx_unicast=s.sent - sent,
            num_rx_unicast=s.received - received,
            latency_unicast=min(round(s.latency_p99 * 1000), SUPERVISOR_BITS),
        )
        message.header.stamp = stamp
        message.header.frame_id = self.frame
        return message
