"""`dtsa benchmark`: how fast everything is on this machine, beside other implementations of the same."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

DESCRIPTION = """\
Measures kernels, whole slots, whole flights, environments for learning, nodes in lockstep and the Crazyflie bridge
(with cflib), and beside them, in the same run, pyrvo's ORCA step and RotorPy's multirotor. Times depend on the
machine and on what else runs on it; the ratios much less."""
EXAMPLES = (("--json", "all parts, as JSON"),)
PARTS = ("kernels", "avoidance", "slots", "flights", "environments", "cost", "nodes", "crazyflie")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument(
        "--parts",
        metavar="NAME[,NAME...]",
        default=",".join(PARTS),
        help=f"what to measure, of {', '.join(PARTS)} [all]",
    )
    parser.add_argument(
        "--out", metavar="DIR", help="directory for benchmark.json and the figure of the cost of a slot"
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of tables")


def run(args: argparse.Namespace) -> int:
    """Measure."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.runs.options import new_directory

    chosen = [name.strip() for name in args.parts.split(",")]
    for name in chosen:
        if name not in PARTS:
            raise ConfigError("parts", name, ", ".join(PARTS))
    directory = None if args.out is None else new_directory(args.out)
    from dtsa_bench.experiments.batch.made_with import made_with
    from dtsa_dev.benchmark import parts
    from dtsa_dev.benchmark.tables import machine, table_text

    result: dict[str, Any] = {**made_with(), "machine": machine()}
    load, cores = result["machine"]["load"], result["machine"]["cores"]
    if load > 0.5 * cores:
        print(
            f"benchmark: the machine is busy (load {load:.1f}, {cores} cores): times will be too long", file=sys.stderr
        )
    if set(chosen) != set(PARTS):
        result["parts"] = chosen
    rows: list[dict[str, Any]] = []
    for name in PARTS:
        if name not in chosen:
            continue
        print(f"benchmark: {name} ...", file=sys.stderr)
        make = getattr(parts, name)
        result[name] = list(make(result.get("avoidance", [])) if name == "slots" else make())
        rows += result[name]
        if not args.json:
            print(f"\n{table_text(result[name])}", flush=True)
    result["targets"] = parts.targets(rows)
    text = json.dumps(result, indent=2) + "\n"
    if args.json:
        print(text, end="")
    elif result["targets"]:
        print(f"\n{table_text(result['targets'])}")
    if directory is not None:
        _write(directory, text, result)
    return 0


def _write(directory: Path, text: str, result: dict[str, Any]) -> None:
    (directory / "benchmark.json").write_text(text, encoding="utf-8")
    if "cost" in result:
        from dtsa_bench.drawing.style import save, style
        from dtsa_dev.benchmark.cost_figure import cost_figure

        with style():
            figure = cost_figure(result["cost"], result.get("avoidance", []))
        save(figure, directory, "cost")
    print(f"results: {directory}", file=sys.stderr)
