"""`dtsa peer-lab`: copies of a Crazyflie app fly on this machine, in virtual time."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dtsa_agent.core import SwarmConfig

DESCRIPTION = """\
Flies copies of a Crazyflie app (C, a function appMain) on this machine, in virtual time, on simulated Crazyflies over
one medium with the radio's true times. The app is compiled against own declarations of the firmware's documented
functions. The same seed gives the same bits: the digest says so. Apps that come with it: beacons, dtr, and `protocol`:
policies tdma, dtsa, age, aloha and lease on board, with a bag for each agent in --out, for `dtsa merge`."""
EXAMPLES = (
    ("beacons --agents 12 --seconds 20", "twelve vehicles that broadcast their states"),
    ("dtr --loss 0.1 --polls 10", "a token ring with lost frames, beside a ground station that polls"),
    ("my_app --source lib/more.c --include lib --out runs/lab", "an app of your own, with files"),
)
PROTOCOL = "protocol"
_OF_PROTOCOL = ("policy", "slot_ms", "moving", "auth_session")

_SETTINGS = ("agents", "seed", "loss", "boot_s", "drift_ppm", "polls", "arming", "radius_m", "channel", "rate")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    from dtsa_agent.core.settings.declaration import settings_of
    from dtsa_bench.crazyflies.peer_lab.app import LabSettings
    from dtsa_bench.runs.options import add_options

    parser.add_argument("app", metavar="APP", help="directory of the app, or the name of one that comes with it")
    for name in _OF_PROTOCOL:
        text = "frames are sealed, the key is in DTSA_AUTH_KEY" if name == "auth_session" else "as for `dtsa simulate`"
        parser.add_argument(f"--{name.replace('_', '-')}", metavar="X", help=f"with {PROTOCOL}: {text}")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="virtual time [60]")
    add_options(parser, LabSettings, "lab", skip={spec.name for spec in settings_of(LabSettings)} - set(_SETTINGS))
    parser.add_argument("--source", action="append", default=[], metavar="FILE", help="a further C file of the app")
    parser.add_argument("--include", action="append", default=[], metavar="DIR", help="a further directory of headers")
    parser.add_argument("--flag", action="append", default=[], metavar="F", help="a flag for the compiler: --flag=-O0")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=X", help="a parameter of the app")
    parser.add_argument("--out", metavar="DIR", help="directory for summary.json, packets.jsonl and truth.jsonl")
    parser.add_argument("--json", action="store_true", help="print summary.json instead of lines")


def run(args: argparse.Namespace) -> int:
    """Fly and print what came of it."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.crazyflies.peer_lab.app import LabSettings
    from dtsa_bench.crazyflies.peer_lab.process import fly
    from dtsa_bench.runs.options import given_options, new_directory

    if not 0.0 < args.seconds <= 1e6:
        raise ConfigError("seconds", args.seconds, "more than 0, up to 1000000")
    settings = LabSettings(**given_options(args, LabSettings, "lab"))
    parameters = dict(map(_parameter, args.set))
    out = None if args.out is None else new_directory(args.out)
    swarm, place = None, args.app
    of_protocol = {name: getattr(args, name) for name in _OF_PROTOCOL if getattr(args, name) is not None}
    if args.app == PROTOCOL:
        swarm, place = _swarm(of_protocol, settings), _folder()
    elif of_protocol:
        name, value = next(iter(of_protocol.items()))
        raise ConfigError(name, value, f"only with {PROTOCOL}")
    summary = fly(
        place, args.seconds, settings, sources=tuple(args.source), include=tuple(args.include),
        flags=tuple(args.flag), parameters=parameters, out=out, swarm=swarm,
    )  # fmt: skip
    console, warnings, logs = (summary.pop(key) for key in ("console", "warnings", "logs"))
    if out is not None:
        _write(out, {**summary, "logs": logs}, console)
    if warnings:
        print(warnings, end="", file=sys.stderr)
    print(json.dumps(summary, indent=2) if args.json else _lines(summary, len(console)))
    return 0


def _swarm(given: dict[str, str], settings: Any) -> SwarmConfig:
    """Settings of the swarm that flies the protocol."""
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.core.settings.declaration import settings_of
    from dtsa_agent.crazyflie.onboard import check_onboard_swarm, key_of

    specs = {spec.name: spec for spec in settings_of(SwarmConfig)}
    values = {"policy": "lease", **{name: specs[name].parse(text) for name, text in given.items()}}
    values |= {"agents": settings.agents, "seed": settings.seed, "auth": "auth_session" in given}
    swarm = SwarmConfig.from_dict(values)
    check_onboard_swarm(swarm)
    key_of(swarm)
    return swarm


def _folder() -> str:
    from dtsa_bench.crazyflies.peer_lab.onboard import APP

    return str(APP)


def _parameter(text: str) -> tuple[str, float]:
    from dtsa_agent.core.errors import ConfigError

    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise ConfigError("set", text, "GROUP.NAME=NUMBER") from None


def _write(out: Path, summary: dict[str, Any], console: list[Any]) -> None:
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    lines = (f"{time:.6f} {agent} {line}\n" for time, agent, line in console)
    (out / "console.txt").write_text("".join(lines), encoding="utf-8")


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
        ("printed", f"{printed} lines"),
        ("digest", summary["digest"]),
    )  # fmt: skip
    return "\n".join(f"{name:<9} {text}" for name, text in rows)
