"""Names of the commands that only a checkout has. `tools/dtsa` reads this before anything is installed."""

from __future__ import annotations

from collections.abc import Sequence

COMMANDS = {
    "soak": "what is too long for the tests: kills, faults, load and memory over hours",
    "prove": "policy lease explored state by state, for all patterns of loss",
    "protocol": "the slot protocols alone, without flight: the tables of docs/evidence/protocol.md",
    "embedded": "the protocol on a simulated microcontroller: the same bits, and what it costs",
    "docs": "the documentation as a site, built strictly or served",
    "benchmark": "how fast the protocol, the nodes and the simulator are on this machine",
    "release": "the distribution: source and wheels, installed and tried in fresh environments; nothing is uploaded",
}
#: Sets of requirements that a command needs beyond those of every machine.
NEEDS = {"docs": ("docs",), "release": ("release",)}
EXAMPLES: dict[str, tuple[tuple[str, str], ...]] = {
    "release": (
        ("--out dist", "everything"),
        ("--out dist --skip 3.12 --skip aarch64", "on a machine without that Python and without a cross compiler"),
    ),
    "soak": (("--list", "what there is"), ("kill --sample", "a few minutes' part of one")),
    "benchmark": (("--json", "all parts, as JSON"),),
    "docs": (("", "into runs/site"), ("--serve", "on http://127.0.0.1:8000, built again after each change")),
    "prove": (("", "all worlds, then the broken rules"), ("--mutants", "the broken rules only")),
    "embedded": (
        ("", "needs a cross compiler and QEMU, see docs/evidence/embedded.md"),
        ("--board", "what a slot costs the app of Crazyflies"),
    ),
    "protocol": (("", "all tables, into runs/protocol"), ("--seeds 3 --slots 6000", "fewer and shorter runs")),
}


def add_commands() -> None:
    """Makes these commands known to the command line of `dtsa_bench`."""
    from dtsa_bench.commands import examples, registry

    registry.add("dtsa_dev.commands", COMMANDS)
    examples.EXAMPLES.update(EXAMPLES)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command, of `dtsa_bench` or of a checkout; see :func:`dtsa_bench.commands.cli.main`."""
    add_commands()
    from dtsa_bench.commands.cli import main as run

    return run(arguments)
