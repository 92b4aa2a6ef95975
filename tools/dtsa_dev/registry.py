"""Names of the commands that only a checkout has. `tools/dtsa` reads this before anything is installed."""

from __future__ import annotations

from collections.abc import Sequence

COMMANDS = {
    "soak": "what is too long for the tests: kills, faults, missions, fuzzing; run by pytest",
    "prove": "policy lease explored state by state, for all patterns of loss",
    "embedded": "the protocol on a simulated microcontroller: the same bits, and what it costs",
    "docs": "the documentation as a site, built strictly or served",
    "benchmark": "how fast the protocol, the nodes and the simulator are on this machine, as ratios",
    "release": "the distribution: source and wheels, installed and tried in fresh environments; nothing is uploaded",
}


def add_commands() -> None:
    """Make these commands known to the command line of `dtsa_bench`."""
    from dtsa_bench.commands import registry

    registry.add_commands("dtsa_dev", COMMANDS)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, of `dtsa_bench` or of a checkout; see :func:`dtsa_bench.commands.cli.main`."""
    add_commands()
    from dtsa_bench.commands.cli import main as run

    return run(arguments)
