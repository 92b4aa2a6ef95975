"""A single lithium cell: charge, and the voltage that it shows under load."""

from __future__ import annotations

FULL_V = 4.15
EMPTY_V = 3.25
SAG_V = 0.15  # while the motors run
FLIGHT_S = 420.0  # a full cell's time in the air
IDLE_S = 7200.0


class Battery:
    """State of charge of one cell."""

    def __init__(self, charge: float = 1.0) -> None:
        self.charge = charge  # 1 full; may go below 0 by force, to show what the firmware makes of it
        self.voltage = FULL_V
        self.update(0.0, motors=False)

    def update(self, dt: float, *, motors: bool) -> None:
        """Use energy for dt seconds."""
        if dt and self.charge > 0:
            self.charge = max(0.0, self.charge - dt / (FLIGHT_S if motors else IDLE_S))
        self.voltage = EMPTY_V + (FULL_V - EMPTY_V) * self.charge - (SAG_V if motors else 0.0)

    def force(self, voltage: float, *, motors: bool) -> None:
        """Set the charge so that this voltage (V) is shown at the present load."""
        self.charge = (voltage + (SAG_V if motors else 0.0) - EMPTY_V) / (FULL_V - EMPTY_V)
        self.update(0.0, motors=motors)
