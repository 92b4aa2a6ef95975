"""Commands about Crazyflies: bridge, fake-crazyflie, peer-lab."""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .registry import Command, Row, add_rows

if TYPE_CHECKING:
    from dtsa_agent.core import SwarmConfig


FILE, ALL = "file", "all"  # of bridge --check
PROTOCOL = "protocol"  # app of peer-lab, and its settings
_OF_PROTOCOL = ("policy", "slot_ms", "moving", "auth_session")
_SETTINGS = ("agents", "seed", "loss", "boot_s", "drift_ppm", "polls", "arming", "radius_m", "channel", "rate")
#: Option that puts simulated Crazyradios in the place of real ones.
SIMULATED_RADIO: Row = (
    "--simulated-radio SOCKET",
    "simulation only: radio:// goes to the Crazyradios of `fake-crazyflie --simulated-radio SOCKET`", {"type": Path},
)  # fmt: skip


class BridgeCommand(Command):
    description = """\
The bridge to the Crazyflies of a swarm.yaml: topics /cfN/..., services /cfN/... and /all/..., as in Crazyswarm2.
The first Ctrl-C lands all, the second stops all motors."""
    examples = (
        ("--config swarm.yaml --check", "is everything there that a flight needs?"),
        ("--places 10 > swarm.yaml", "a file to begin with: where ten begin, and rates for one dongle"),
        ("--config swarm.yaml --backend sim", "simulated Crazyflies in place of real ones"),
    )
    options = (
        ("--config CONFIG", "swarm.yaml: robots, types, defaults, station", {"type": Path}),
        ("--places N", "print a swarm.yaml for a mission of N on one dongle: places and rates; and end"),
        ("--backend", "cflib: the Crazyflies of the file; sim: simulated ones in their place (default %(default)s)",
         {"choices": ("cflib", "sim"), "default": "cflib"}),
        SIMULATED_RADIO,
        ("--check", "connect, list what a flight needs (links, firmware, batteries, positions, clocks, geofence, "
         "budget, priority), and end; exit code 1 if something is missing. file: the file and the budget alone",
         {"nargs": "?", "const": ALL, "choices": (FILE, ALL)}),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
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
            print("\n".join([f"{args.config}: {len(settings.robots)} Crazyflies", *settings.describe()]), flush=True)
            for line in place_lines(settings):
                print(f"for a mission: {line}", flush=True)
        if args.check == FILE:
            check_budget(settings.loads, force=settings.station.force_budget)
            return 0
        require_cflib()
        with ExitStack() as stack:
            config = simulated(args.config, stack) if args.backend == "sim" else args.config
            return run_bridge(config, check=args.check == ALL)


def use_simulated_radio(args: argparse.Namespace) -> None:
    """Tell this process and those that it starts."""
    from dtsa_agent.crazyflie.link import SIMULATED_RADIO

    if args.simulated_radio is not None:
        os.environ[SIMULATED_RADIO] = str(args.simulated_radio.resolve())


def run_bridge(config: Path, *, check: bool = False) -> int:
    """The bridge in this process; `check`: only connect, and say what a flight would lack."""
    from dtsa_agent.crazyflie.node import bridge_node

    arguments = ["crazyflie_bridge", "--ros-args", "-p", f"config:={config.resolve()}"]
    if check:
        # Too many for a radio is a line of the list here, not the end.
        arguments += ["--log-level", "error"]
        return bridge_node.main(arguments, bridge_node.check_bridge)
    return bridge_node.main(arguments)


def simulated(config: Path, stack: ExitStack) -> Path:
    """Start simulated Crazyflies in place of the real ones of a swarm's YAML; returns the file that names them."""
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


class FakeCrazyflieCommand(Command):
    examples = (("--count 12", "twelve vehicles for the official library"),)

    @property
    def description(self) -> str:
        from dtsa_bench.crazyflies.simulated.cli import DESCRIPTION

        return DESCRIPTION

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        from dtsa_bench.crazyflies.simulated.cli import add_arguments

        add_arguments(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Fly the fleet until Ctrl-C."""
        from dtsa_bench.crazyflies.simulated.cli import run

        return run(args)


class PeerLabCommand(Command):
    description = """\
Flies copies of a Crazyflie app (C, a function appMain) on this machine, in virtual time, on simulated Crazyflies over
one medium with the radio's true times. The app is compiled against own declarations of the firmware's documented
functions. The same seed gives the same bits: the digest says so. Apps that come with it: beacons, dtr, and `protocol`:
policies tdma, dtsa, age, aloha and lease on board, with a bag for each agent in --out, for `dtsa merge`."""
    examples = (
        ("beacons --agents 12 --seconds 20", "twelve vehicles that broadcast their states"),
        ("dtr --loss 0.1 --polls 10", "a token ring with lost frames, beside a ground station that polls"),
        ("my_app --source lib/more.c --include lib --out runs/lab", "an app of your own, with files"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        from dtsa_agent.core.settings.declaration import settings_of
        from dtsa_bench.crazyflies.peer_lab.app import LabSettings
        from dtsa_bench.runs.options import add_options

        parser.add_argument("app", metavar="APP", help="directory of the app, or the name of one that comes with it")
        for name in _OF_PROTOCOL:
            sealed = name == "auth_session"
            text = "frames are sealed, the key is in DTSA_AUTH_KEY" if sealed else "as for `dtsa simulate`"
            parser.add_argument(f"--{name.replace('_', '-')}", metavar="X", help=f"with {PROTOCOL}: {text}")
        parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="virtual time [60]")
        add_options(parser, LabSettings, "lab", skip={spec.name for spec in settings_of(LabSettings)} - set(_SETTINGS))
        add_rows(parser, (
            ("--source FILE", "a further C file of the app", {"action": "append", "default": []}),
            ("--include DIR", "a further directory of headers", {"action": "append", "default": []}),
            ("--flag F", "a flag for the compiler: --flag=-O0", {"action": "append", "default": []}),
            ("--set NAME=X", "a parameter of the app", {"action": "append", "default": []}),
            ("--out DIR", "directory for summary.json, packets.jsonl and truth.jsonl"),
            ("--json", "print summary.json instead of lines"),
        ))  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Fly and print what came of it."""
        from dtsa_agent.core.errors import ConfigError
        from dtsa_agent.core.settings.declaration import parse_values
        from dtsa_bench.crazyflies.peer_lab.app import LabSettings, read_app
        from dtsa_bench.crazyflies.peer_lab.process import fly
        from dtsa_bench.runs.options import new_directory, option_values

        if not 0.0 < args.seconds <= 1e6:
            raise ConfigError("seconds", args.seconds, "more than 0, up to 1000000")
        settings = LabSettings(**option_values(args, LabSettings, "lab"))
        parameters = {}
        for text in args.set:
            try:
                ((name, value),) = parse_values(text).items()
            except ValueError:
                raise ConfigError("set", text, "GROUP.NAME=NUMBER") from None
            parameters[name] = value
        out = None if args.out is None else new_directory(args.out)
        swarm, place = None, args.app
        of_protocol = {name: getattr(args, name) for name in _OF_PROTOCOL if getattr(args, name) is not None}
        if args.app == PROTOCOL:
            from dtsa_bench.crazyflies.peer_lab.onboard import APP

            swarm, place = _swarm(of_protocol, settings), str(APP)
        elif of_protocol:
            name, value = next(iter(of_protocol.items()))
            raise ConfigError(name, value, f"only with {PROTOCOL}")
        app = read_app(place, sources=tuple(args.source), include=tuple(args.include), flags=tuple(args.flag))
        summary = fly(app, args.seconds, settings, parameters=parameters, out=out, swarm=swarm)
        console, warnings, logs = (summary.pop(key) for key in ("console", "warnings", "logs"))
        if out is not None:
            text = json.dumps({**summary, "logs": logs}, indent=2) + "\n"
            (out / "summary.json").write_text(text, encoding="utf-8")
            lines = (f"{time:.6f} {agent} {line}\n" for time, agent, line in console)
            (out / "console.txt").write_text("".join(lines), encoding="utf-8")
        if warnings:
            print(warnings, end="", file=sys.stderr)
        print(json.dumps(summary, indent=2) if args.json else _lines(summary, len(console)))
        return 0


def _swarm(options: dict[str, str], settings: Any) -> SwarmConfig:
    """Settings of the swarm that flies the protocol."""
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.core.settings.declaration import settings_of
    from dtsa_agent.crazyflie.onboard import check_onboard_swarm, key_of

    specs = {spec.name: spec for spec in settings_of(SwarmConfig)}
    values = {"policy": "lease", **{name: specs[name].parse(text) for name, text in options.items()}}
    values |= {"agents": settings.agents, "seed": settings.seed, "auth": "auth_session" in options}
    swarm = SwarmConfig.from_dict(values)
    check_onboard_swarm(swarm)
    key_of(swarm)
    return swarm


def _lines(summary: dict[str, Any], printed: int) -> str:
    near, mean = summary["min_distance_m"], summary["mean_age_ms"]
    pair = " and ".join(map(str, summary["min_distance_pair"] or ()))
    rows = (
        ("app", f"{summary['app']}, {summary['agents']} agents, {summary['seconds']:g} s, seed {summary['seed']}"),
        ("ages", "no states were heard" if mean is None else f"{mean:.1f} ms on average, "
         f"{summary['largest_age_ms']:.1f} at most; {100 * summary['pairs_known']:.0f} % of pairs known"),
        ("packets", f"{summary['sent']} sent, {summary['heard']} heard, {summary['queue_overflows']} lost in full "
         f"queues; {100 * summary['share_of_air']:.1f} % of the air"),
        ("nearest", "fewer than two flew" if near is None
         else f"{near:.3f} m (agents {pair} at {summary['min_distance_time_s']:.2f} s)"),
        ("crashed", f"{len(summary['crashed'])}/{summary['agents']}" + "".join(f" {k}" for k in summary["crashed"])),
        ("console", f"{printed} lines printed by the apps"),
        ("digest", summary["digest"]),
    )  # fmt: skip
    return "\n".join(f"{name:<9} {text}" for name, text in rows)
