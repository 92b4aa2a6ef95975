"""`dtsa prove`: policy lease explored state by state."""

from __future__ import annotations

import argparse

DESCRIPTION = """\
Runs libdtsa's own code for policy lease through the states that two or three agents can reach, for all patterns of
loss, and checks the protocol's invariants in each; then breaks one rule at a time and sees that the search finds it."""
EXAMPLES = (
    ("", "all worlds, then the broken rules"),
    ("--mutants", "the broken rules only"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("--mutants", action="store_true", help="the broken rules only")


def run(args: argparse.Namespace) -> int:
    """Explore."""
    import tempfile
    from pathlib import Path

    from dtsa_dev.proofs.prove import MUTANTS, WORLDS, build, explore

    failed = 0
    with tempfile.TemporaryDirectory() as directory:
        for world in () if args.mutants else WORLDS:
            found = explore(build(Path(directory), relay_reach=world.relay_reach), world)
            failed += bool(found.broken)
            end = found.broken or ("all states" if found.closed else "holds so far, not all states")
            print(f"{world.name:62} {found.states:9} states, depth {found.depth:3}: {end}", flush=True)
        for mutant in MUTANTS:
            found = explore(build(Path(directory), mutant), mutant.world)
            failed += not found.broken
            print(f"without {mutant.rule!r}: {found.broken or 'NOT FOUND'}; {found.states} states", flush=True)
    return 1 if failed else 0
