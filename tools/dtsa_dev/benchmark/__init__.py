"""`dtsa benchmark`: how fast everything is here, as ratios to other implementations that are timed in the same run."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from dtsa_bench.commands.registry import Command

#: Parts by name, with the modules that have a function of that name.
PARTS = {"kernels": "core", "slots": "core", "flights": "core", "nodes": "nodes", "agents": "agents"}
HEADS = ("what", "here", "beside it", "ratio", "target")


class Measurement(NamedTuple):
    """One measurement."""

    what: str
    ours: str
    other: str = ""
    ratio: float | None = None
    target: str = ""
    met: bool = True

    def cells(self) -> tuple[str, ...]:
        """The row of a table."""
        ratio = "" if self.ratio is None else f"{self.ratio:.3g}"
        return self.what, self.ours, self.other, ratio, self.target + ", NOT MET" * (not self.met)


class BenchmarkCommand(Command):
    description = """\
Times kernels, whole slots, whole flights, nodes in lockstep and agents over UDP, and beside them, in the same run,
NumPy, pyrvo's ORCA step, bare messages, and the same agents as ROS nodes. Times depend on the machine and on what else
runs on it; the ratios much less. A ratio is our time over the other one: smaller is better."""
    examples = (("--out speed.json", "all parts, and a record"), ("--parts slots,flights", "some"))

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--parts", metavar="NAME[,NAME...]", default=",".join(PARTS), help=f"of {', '.join(PARTS)}")
        parser.add_argument("--out", metavar="FILE", help="write the rows as JSON, as docs/evidence/speed.json")

    def run(self, args: argparse.Namespace) -> int:
        """Measure."""
        from dtsa_agent.core.errors import ConfigError
        from dtsa_dev.records import load, write_record

        chosen = [name.strip() for name in args.parts.split(",")]
        for name in chosen:
            if name not in PARTS:
                raise ConfigError("parts", name, ", ".join(PARTS))
        before, cores = load(), len(os.sched_getaffinity(0))
        if before > 0.5 * cores:
            print(
                f"benchmark: the machine is busy (load {before}, {cores} cores): times will be too long",
                file=sys.stderr,
            )
        rows: list[Measurement] = []
        for name in chosen:
            print(f"benchmark: {name} ...", file=sys.stderr)
            measure: Callable[[], Iterator[Measurement]] = getattr(
                importlib.import_module(f"dtsa_dev.benchmark.{PARTS[name]}"), name
            )
            for row in measure():
                rows.append(row)
                print("{:58} {:>12}  {:36} {:>7}  {}".format(*row.cells()), flush=True)
        if args.out:
            command = f"benchmark{f' --parts {args.parts}' if len(chosen) < len(PARTS) else ''} --out FILE"
            write_record(Path(args.out), command, HEADS, [row.cells() for row in rows], {"load": [before, load()]})
        return 0
