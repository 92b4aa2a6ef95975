"""Simulated Crazyflies: unmodified cflib connects to them.

They fly the project's vehicle model behind the firmware's commander and supervisor, and fail on command.
"""

from .fleet import Fleet
from .fleet_config import FleetConfig
from .process import send_fault

__all__ = ["Fleet", "FleetConfig", "send_fault"]
