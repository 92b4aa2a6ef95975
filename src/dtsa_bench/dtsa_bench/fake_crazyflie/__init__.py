"""Simulated Crazyflies over UDP: unmodified cflib connects to them.

They fly the project's own vehicle model behind the firmware's commander, high-level commander and supervisor, with its
watchdogs, and fail on command. For tests of the bridge, and a training ground for its users.
"""

from dtsa_bench.fake_crazyflie.control import send_fault
from dtsa_bench.fake_crazyflie.fleet import Fleet
from dtsa_bench.fake_crazyflie.fleet_config import FleetConfig

__all__ = ["Fleet", "FleetConfig", "send_fault"]
