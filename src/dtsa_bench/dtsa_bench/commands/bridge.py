"""`dtsa bridge`: connect the swarm to real or simulated Crazyflies."""

from __future__ import annotations

import argparse
import os
import tempfile
from contextlib import ExitStack
from pathlib import Path

FILE, ALL = "file", "all"
DESCRIPTION = """\
The bridge to the Crazyflies of a swarm.yaml: topics /cfN/..., services /cfN/... and /all/..., as in Crazyswarm2.
The first Ctrl-C lands all, the second stops all motors."""
EXAMPLES = (
    ("--config swarm.yaml --check", "is everything there that a flight needs?"),
    ("--places 10 > swarm.yaml", "a file to begin with: where ten begin, and rates for one dongle"),
    ("--config swarm.yaml --backend sim", "simulated Crazyflies in place of real ones"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.add_argument("--config", type=Path, help="swarm.yaml: robots, types, defaults, station")
    parser.add_argument(
        "--places", metavar="N", help="print a swarm.yaml for a mission of N on one dongle: places and rates; and end"
    )
    parser.add_argument(
        "--backend",
        choices=("cflib", "sim"),
        default="cflib",
        help="cflib: the Crazyflies of the file; sim: simulated ones in their place (default %(default)s)",
    )
    add_simulated_radio(parser)
    parser.add_argument(
        "--check",
        nargs="?",
        const=ALL,
        choices=(FILE, ALL),
        help="connect, list what a flight needs (links, firmware, batteries, positions, clocks, geofence, budget, "
        "priority), and end; exit code 1 if something is missing. file: the file and the budget alone",
    )


def add_simulated_radio(parser: argparse._ActionsContainer) -> None:
    """Add the option that puts simulated Crazyradios in the place of real ones."""
    parser.add_argument(
        "--simulated-radio",
        type=Path,
        metavar="SOCKET",
        help="simulation only: radio:// goes to the Crazyradios of `fake-crazyflie --simulated-radio SOCKET`",
    )


def use_simulated_radio(args: argparse.Namespace) -> None:
    """Tell this process and those that it starts."""
    from dtsa_agent.crazyflie.link import SIMULATED_RADIO

    if args.simulated_radio is not None:
        os.environ[SIMULATED_RADIO] = str(args.simulated_radio.resolve())


def run(args: argparse.Namespace) -> int:
    """Run the bridge until Ctrl-C."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_agent.crazyflie.addresses import check_budget
    from dtsa_agent.crazyflie.link import require_cflib
    from dtsa_agent.crazyflie.settings import load_swarm
    from dtsa_bench.crazyflies.missions.places import example_swarm, place_lines
    from dtsa_bench.runs.options import whole_number

    if args.places is not None:
        print(example_swarm(whole_number(args.places, "places", 1, 100)))
        return 0
    if args.config is None:
        raise ConfigError("config", None, "--config FILE, the swarm.yaml of the Crazyflies")
    use_simulated_radio(args)
    settings = load_swarm(args.config)
    if args.check is not None:
        print("\n".join([f"{args.config}: {len(settings.robots)} Crazyflies", *settings.summary()]), flush=True)
        for line in place_lines(settings):
            print(f"for a mission: {line}", flush=True)
    if args.check == FILE:
        check_budget(settings.loads, force=settings.station.force_budget)
        return 0
    require_cflib()
    with ExitStack() as stack:
        config = simulated(args.config, stack) if args.backend == "sim" else args.config
        return run_bridge(config, check=args.check == ALL)


def run_bridge(config: Path, *, check: bool = False) -> int:
    """The bridge in this process; `check`: only connect, and say what a flight would lack."""
    from dtsa_agent.crazyflie.node import bridge_node

    arguments = ["crazyflie_bridge", "--ros-args", "-p", f"config:={config.resolve()}"]
    if check:
        # Too many for a radio is a line of the list here, not the end.
        arguments += ["--log-level", "error"]
        return bridge_node.main(arguments, lambda node: bridge_node.check_node(node, print))
    return bridge_node.main(arguments)


def simulated(config: Path, stack: ExitStack) -> Path:
    """Start simulated Crazyflies in place of a file's real ones.

    :param config: the swarm's YAML.
    """
    import yaml

    from dtsa_agent.crazyflie.settings import load_swarm
    from dtsa_bench.crazyflies.simulated.process import FIRST, FleetError, free_base_port, running_fleet

    data = yaml.safe_load(config.read_text(encoding="utf-8"))
    robots = load_swarm(config).robots
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="dtsa-bridge-")))
    path = folder / config.name
    for first in (FIRST, None):
        base = free_base_port(len(robots), first)
        for index, robot in enumerate(robots):
            data["robots"][robot.name]["uri"] = f"udp://127.0.0.1:{base + index}"
        path.write_text(yaml.safe_dump(data), encoding="utf-8")
        try:
            line = stack.enter_context(running_fleet(["--config", str(path)]))
            break
        except FleetError as error:  # their process has said why
            if first is None or free_base_port(len(robots), base) == base:
                raise SystemExit(error.code) from None
            # Others that started just now have taken the ports: any other ones will do.
    print(line.partition("; Ctrl-C")[0], flush=True)
    return path
