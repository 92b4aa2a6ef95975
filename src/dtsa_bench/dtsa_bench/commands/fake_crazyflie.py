"""`dtsa fake-crazyflie`: simulated Crazyflies over UDP."""

from dtsa_bench.crazyflies.simulated.cli import DESCRIPTION, add_arguments, run

EXAMPLES = (("--count 12", "twelve vehicles for the official library"),)

__all__ = ["DESCRIPTION", "EXAMPLES", "add_arguments", "run"]
