"""`dtsa embedded`: libdtsa on a simulated microcontroller."""

from __future__ import annotations

import argparse

from dtsa_agent.core.errors import ConfigError

DESCRIPTION = """\
Compiles libdtsa for a Cortex-M4F, flies 200 slots of tdma, dtsa and lease with 12 and 18 agents and loss on it (in
QEMU) and on this machine, compares every bit, and prints what memory, stack, code and calls cost. With --board the app
of docs/how-to/on-board.md runs there instead, with 12 and 20 agents: what a slot costs it."""
EXAMPLES = (
    ("", "needs a cross compiler and QEMU, see docs/evidence/embedded.md"),
    ("--board", "what a slot costs the app of Crazyflies"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("--board", action="store_true", help="the app of Crazyflies, instead of libdtsa alone")
    parser.add_argument("--out", metavar="FILE", help="with --board: its record, as docs/evidence/board-cost.json")


def run(args: argparse.Namespace) -> int:
    """Fly and compare."""
    import tempfile
    from pathlib import Path

    if args.board:
        return _board(args)
    if args.out:
        raise ConfigError("out", args.out, "only with --board")
    from dtsa_dev.proofs.embedded import code_size, fly_here, fly_on_cortex, table

    with tempfile.TemporaryDirectory() as directory:
        here, cortex = fly_here(Path(directory)), fly_on_cortex(Path(directory))
        print(table(here, cortex, code_size(Path(directory))))
    return 0 if [flight.digest for flight in here] == [flight.digest for flight in cortex] else 1


def _board(args: argparse.Namespace) -> int:
    import json
    import tempfile
    from pathlib import Path

    from dtsa_dev.documents.evidence_tables import board_cost
    from dtsa_dev.proofs.board_cost import fly_app_on_cortex, memory, record

    with tempfile.TemporaryDirectory() as directory:
        found = record(fly_app_on_cortex(Path(directory)), memory(Path(directory)))
    print(board_cost(found))
    if args.out:
        Path(args.out).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    return 0
