"""`dtsa embedded`: libdtsa on a simulated microcontroller."""

from __future__ import annotations

import argparse

DESCRIPTION = """\
Compiles libdtsa for a Cortex-M4F, flies 200 slots of tdma, dtsa and lease with 12 and 18 agents and loss on it (in
QEMU) and on this machine, compares every bit, and prints what memory, stack, code and calls cost."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    subparsers.add_parser("embedded", help="the protocol on a simulated microcontroller", description=DESCRIPTION)


def run(args: argparse.Namespace) -> int:
    """Fly and compare."""
    import tempfile
    from pathlib import Path

    from dtsa_dev.proofs.embedded import code_size, fly_here, fly_on_cortex, table

    with tempfile.TemporaryDirectory() as directory:
        here, cortex = fly_here(Path(directory)), fly_on_cortex(Path(directory))
        print(table(here, cortex, code_size(Path(directory))))
    return 0 if [flight.digest for flight in here] == [flight.digest for flight in cortex] else 1
