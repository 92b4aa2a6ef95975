"""Simulated Crazyflies over UDP: unmodified cflib connects to them.

They fly the project's own vehicle model behind the firmware's commander, high-level commander and supervisor, with its
watchdogs, and fail on command. For tests of the bridge, and a training ground for its users.
"""

from .fleet import Fleet
from .fleet_config import FleetConfig
from .process import send_fault

__all__ = ["Fleet", "FleetConfig", "send_fault"]
