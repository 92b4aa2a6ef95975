"""Command line of the simulated fleet: `dtsa fake-crazyflie`."""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.priority import set_realtime
from dtsa_bench.runs.options import add_options, option_values, whole_number

from .fleet import Fleet
from .fleet_config import FleetConfig, RadioSettings
from .process import DIRECTIONS, FAULTS, NUMBERS, send_fault

DESCRIPTION = """\
Simulated Crazyflies over UDP: cflib, its client and the Crazyflie bridge connect to them as to real ones.
They fly, drain their batteries and fail on command; Ctrl-C ends them."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    add_options(parser, FleetConfig, "fleet")
    parser.add_argument("--config", type=Path, help="swarm.yaml: count, ports and start positions come from its robots")
    parser.add_argument("--truth", type=Path, metavar="FILE", help="record of what really happened (JSON lines)")
    parser.add_argument(
        "--priority",
        metavar="N",
        default="30",
        help="real-time priority, 0 to 90: the simulated world does not wait [30]",
    )
    parser.add_argument("--quiet", action="store_true", help="no status line")
    parser.add_argument(
        "--ignore-interrupt",
        action="store_true",
        help="Ctrl-C does not end them: the program that flies them has to land them first; SIGTERM ends them",
    )
    radio = parser.add_argument_group("simulated radios", "Crazyradios in place of UDP; simulation only")
    radio.add_argument(
        "--simulated-radio",
        type=Path,
        metavar="SOCKET",
        help="new Unix socket, for `bridge` and `agent --air crazyradio` with `--simulated-radio SOCKET`",
    )
    radio.add_argument(
        "--dongles-only", action="store_true", help="with --simulated-radio: Crazyradios on an air without Crazyflies"
    )
    add_options(radio, RadioSettings, "radio", prefix="radio-")
    faults = parser.add_argument_group("faults", "sent to a fleet that is already running, instead of starting one")
    faults.add_argument("--fault", choices=FAULTS, help="; ".join(f"{k}: {v}" for k, v in FAULTS.items()))
    faults.add_argument("--cf", default="all", help="id of the vehicle (default: all)")
    faults.add_argument("--rate", type=float, help="drop: share of the datagrams that is lost")
    faults.add_argument("--direction", choices=DIRECTIONS, help="drop: up is from the host")
    faults.add_argument("--distance", type=float, help="estimate_jump: m")
    faults.add_argument("--dongle", type=int, help="unplug: number of the dongle")
    faults.add_argument("--voltage", type=float, help="battery: V")
    faults.add_argument("--seconds", type=float, help="heals by itself after that long")


def fleet_config(args: argparse.Namespace) -> FleetConfig:
    """Configuration from the command line."""
    radio = RadioSettings(**option_values(args, RadioSettings, "radio"), path=args.simulated_radio)
    options = {**option_values(args, FleetConfig, "fleet"), "truth": args.truth, "radio": radio}
    if args.dongles_only:
        if radio.path is None or args.config is not None:
            raise ConfigError("dongles_only", True, "with --simulated-radio SOCKET, and without --config")
        options["count"] = 0
    elif args.config is not None:
        options |= _robots_of(args.config, radio, options.get("count"))
    elif radio.path is not None:
        allowed = "--config FILE with --simulated-radio: its URIs say where they listen; or --dongles-only"
        raise ConfigError("config", None, allowed)
    return FleetConfig(**options)


def _robots_of(path: Path, radio: RadioSettings, count: int | None) -> dict[str, Any]:
    """The settings that a swarm's YAML gives; `count`: what the user wants, too."""
    import numpy as np

    from dtsa_agent.crazyflie.settings import load_swarm

    robots = load_swarm(path).robots
    found = {"count": len(robots), "start": np.array([robot.initial_position for robot in robots]).T}
    scheme, form = ("udp", "udp://HOST:PORT") if radio.path is None else ("radio", "radio://RADIO/CHANNEL/RATE/ADDRESS")
    for robot in robots:
        if robot.address.scheme != scheme:
            raise ConfigError(f"robots.{robot.name}.uri", robot.uri, f"{form} for a simulated Crazyflie")
    if radio.path is not None:
        stations = tuple(robot.address for robot in robots)
        return {**found, "radio": dataclasses.replace(radio, stations=stations)}
    ports = [robot.address.port for robot in robots]
    if ports != list(range(ports[0], ports[0] + len(ports))):
        raise ConfigError("robots", ports, "ports that follow each other, in the order of the robots")
    if count not in (None, len(ports)):
        raise ConfigError("count", count, f"{len(ports)}, as in {path}")
    return {**found, "base_port": ports[0]}


def request_fault(args: argparse.Namespace) -> None:
    """Send a fault to a running fleet; ConfigError: no fleet listens, or it was refused."""
    if args.cf != "all" and not args.cf.isdecimal():
        raise ConfigError("cf", args.cf, "an id, or all")
    cf = args.cf if args.cf == "all" else int(args.cf)
    given = {name: getattr(args, name) for name in (*NUMBERS, "direction") if getattr(args, name) is not None}
    port = FleetConfig(**option_values(args, FleetConfig, "fleet")).control_port
    send_fault(("127.0.0.1", port), fault=args.fault, cf=cf, **given)
    print(f"{args.fault}: cf {args.cf}")


def status_line(fleet: Fleet) -> str:
    """One line about the fleet."""
    states = Counter(firmware.supervisor.state for firmware in fleet.firmware)
    lowest = min(firmware.battery.voltage for firmware in fleet.firmware)
    text = ", ".join(f"{number} {state}" for state, number in sorted(states.items()))
    return f"{fleet.time:7.1f} s  {text}; lowest battery {lowest:.2f} V"


def run(args: argparse.Namespace) -> int:
    """Fly the fleet until Ctrl-C; exit code."""
    if args.fault is not None:
        request_fault(args)
        return 0
    if "DTSA_SUPERVISOR" in os.environ:  # the bridge started this fleet for itself, and has rclpy
        from dtsa_agent.ros.common.node_process import follow_supervisor

        follow_supervisor()
    priority = whole_number(args.priority, "priority", 0, 90)
    fleet = Fleet(fleet_config(args))
    config, radio = fleet.config, fleet.config.radio
    set_realtime(priority)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: fleet.stop())
    if args.ignore_interrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    for uri in config.uris:
        print(uri)
    text = f"{radio.dongles} simulated Crazyradios at {radio.path}"
    if count := config.count:
        text = f"{count} simulated Crazyflies, protocol {config.protocol}; faults: UDP port {config.control_port}"
    print(f"{text}; Ctrl-C ends", flush=True)
    quiet = args.quiet or not count
    if not quiet:
        _show_status(fleet)
    fleet.run()
    if not quiet:
        print(status_line(fleet))
    return 0


def _show_status(fleet: Fleet) -> None:
    """Refresh the status line every half second on a terminal, every ten seconds in a file."""
    terminal = sys.stdout.isatty()
    period, end = (0.5, "") if terminal else (10.0, "\n")
    last = time.monotonic()

    def show() -> None:
        nonlocal last
        if time.monotonic() - last >= period:
            last = time.monotonic()
            line = status_line(fleet)
            print(f"\r{line}          " if terminal else line, end=end, flush=True)

    fleet.shown = show
