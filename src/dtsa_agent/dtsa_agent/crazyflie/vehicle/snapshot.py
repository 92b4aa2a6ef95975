"""State of one Crazyflie for those who watch: status, diagnostics, summaries."""

from __future__ import annotations

from dataclasses import dataclass

from dtsa_agent.crazyflie.positions.motion_capture import PositionNumbers
from dtsa_agent.crazyflie.state.conversions import VehicleState
from dtsa_agent.crazyflie.state.state_machine import State


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of one vehicle for those who watch."""

    name: str
    id: int
    state: State
    reason: str
    vehicle: VehicleState | None
    log_age: float  # s; infinite before the first packet
    command_age: float  # s; infinite before the first command
    link_quality: float  # 0..1
    rssi: int
    sent: int
    received: int
    refused: int  # streamed commands that were not for this state
    replaced: int  # streamed commands that a newer one overtook
    latency_p99: float  # s; 0 before the first command
    command_hz: float
    positions: PositionNumbers | None = None  # None: there is no motion capture
