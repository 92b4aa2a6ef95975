"""`fly`: one flight with real ROS 2 nodes, recorded to a bag."""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_agent.stop import Stop
from dtsa_bench.flights.options import FlightOptions
from dtsa_bench.runs.options import (
    add_mode_options,
    add_options,
    add_run_options,
    option_values,
    run_config,
    whole_number,
)

from .crazyflies import SIMULATED_RADIO, use_simulated_radio
from .registry import INTERRUPTED, Command, add_rows, warn

if TYPE_CHECKING:
    from dtsa_bench.pages.view.process import PageOptions


LONGEST_END_S = 60.0  # after a signal, and of the middleware without one; it takes a second
_LATER = ("respawn",)  # options of a flight that concern real time alone
_CRAZYFLIE_OPTIONS = (
    ("--backend", "cflib: the Crazyflies of --config, in real time [sim]",
     {"choices": ("sim", "cflib"), "default": "sim"}),
    ("--config FILE", "swarm.yaml of the Crazyflies, for --backend cflib"),
    SIMULATED_RADIO,
    ("--attach", "by the bridge that runs already (dtsa bridge) on the ROS domain of --domain or ROS_DOMAIN_ID, "
     "and goes on: for several missions in a row"),
)  # fmt: skip


class FlyCommand(Command):
    description = """\
Starts the channel and the agents as ROS 2 nodes, records the flight, and ends them all."""
    examples = (
        ("--out runs/a", "twelve agents, a process each, as in the paper"),
        ("--out runs/b --agents 18 --policy lease --loss 0.1 --processes 2", "lost frames, two processes"),
        ("--out runs/c --mode realtime --policy lease --respawn 1", "clocks of their own; the dead come back"),
        ("--out runs/e --mode realtime --policy lease --view --control", "in a browser, which may kill agents and jam"),
        ("--out runs/d --backend cflib --config swarm.yaml", "Crazyflies"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.usage = "%(prog)s --out DIR [OPTIONS]"
        group = parser.add_argument_group("the flight")
        add_rows(group, (
            ("--out DIR", "new directory for the bag, summary.json and trajectories.png", {"required": True}),
            ("--processes per-agent|K", "one process an agent, or all agents in K processes [per-agent]",
             {"default": "per-agent"}),
            ("--domain N", "ROS_DOMAIN_ID of the flight [a free one]"),
            ("--picture", "draw trajectories.png", {"action": argparse.BooleanOptionalAction, "default": True}),
            ("--json", "print summary.json instead of lines"),
            ("--view", "show the flight in a browser on this machine, see docs/how-to/view.md"),
            ("--view-port N", "port of the page [a free one]"),
            ("--control", "the page may kill and start agents and change the channel; land and stop Crazyflies"),
        ))  # fmt: skip
        add_options(group, FlightOptions, "flight", skip=(*_LATER, "startup_s", "processes", "domain", "pictures"))
        add_rows(parser.add_argument_group("Crazyflies"), _CRAZYFLIE_OPTIONS)
        add_run_options(parser)
        clocks = add_mode_options(parser)
        kept = {setting.name for setting in settings_of(FlightOptions)} - set(_LATER)
        add_options(clocks, FlightOptions, "flight", skip=kept)
        text = "real time: agents whose processes are started S seconds after slot 0 only [none]"
        clocks.add_argument("--late", metavar="cfK=S,...", help=text)

    def run(self, args: argparse.Namespace) -> int:
        """Flies; 1 when the flight was cut short or its agents did not hear each other, 130 when it was interrupted."""
        if args.backend == "cflib":
            return run_crazyflies(args)
        config = run_config(args)
        if args.config is not None:
            raise ConfigError("config", args.config, "a swarm.yaml together with --backend cflib")
        domain = None if args.domain is None else whole_number(args.domain, "domain", 0, 232)
        directory = Path(args.out)

        from dtsa_bench.flights.domain import clear_hindrances

        clear_hindrances(os.environ)
        from dtsa_bench.flights.flight import fly
        from dtsa_bench.flights.options import process_count

        options = FlightOptions(
            processes=process_count(args.processes, config.swarm.agents), domain=domain, pictures=args.picture,
            late=late_agents(args.late), **option_values(args, FlightOptions, "flight"),
        )  # fmt: skip
        page = page_options(args)
        with Stop(LONGEST_END_S) as stop, ExitStack() as pages:
            process = None

            def show(domain: int, environment: Mapping[str, str]) -> None:
                nonlocal process
                from dtsa_bench.pages.view.process import view_process

                if page is not None:
                    process = pages.enter_context(view_process(domain, environment, page))

            flight = fly(config, directory, options, stop, on_domain=show)
            interrupted = bool(stop)
            _print_result(args, flight)
            picture = directory / "trajectories.png"
            if not args.json and picture.exists():
                print(f"picture: {picture}", flush=True)
            if process is not None and sys.stdin.isatty() and not stop:
                print("the flight is over; the page stays until Ctrl-C", file=sys.stderr, flush=True)
                while not stop and process.poll() is None:
                    time.sleep(0.1)
        if flight.summary.get("warning"):
            warn(f"warning: {flight.summary['warning']}")
        cut_short = flight.summary.get("cut_short")
        if interrupted:
            warn("the flight was interrupted; its bag is complete up to that point")
            _report_missing_frames(flight.summary)
            return INTERRUPTED
        if cut_short:
            warn(f"the flight was cut short: {cut_short}")
        return 1 if _report_missing_frames(flight.summary) or cut_short else 0


def page_options(args: argparse.Namespace) -> PageOptions | None:
    """The page that is wanted; None: none is."""
    if not (args.view or args.view_port or args.control):
        return None
    from dtsa_bench.pages.view.process import PageOptions

    return PageOptions(whole_number(args.view_port or "0", "view_port", 0, 65535), args.control)


def late_agents(text: str | None) -> dict[int, float]:
    """Seconds by agent, from ``cf5=3,cf6=4.5``."""
    parts = [] if text is None else text.split(",")
    matches = [re.fullmatch(r"\s*cf(\d{1,4})=(\d+\.?\d*)\s*", part) for part in parts]
    if not all(matches):
        raise ConfigError("late", text, "cfK=S,...: agents, and seconds after slot 0")
    return {int(match[1]): float(match[2]) for match in matches if match}


def run_crazyflies(args: argparse.Namespace) -> int:
    """A mission; 1 when a vehicle cut the exchange short or agents did not hear each other, 130 when interrupted."""
    from dtsa_agent.crazyflie.settings import load_swarm

    if args.config is None:
        raise ConfigError("config", None, "--config FILE, the swarm.yaml of the Crazyflies")
    use_simulated_radio(args)
    path = Path(args.config)
    settings = load_swarm(path)
    from dtsa_bench.crazyflies.missions.mission_flight import fly_crazyflies
    from dtsa_bench.crazyflies.missions.places import MissionError, mission_defaults

    if getattr(args, "run.mode") is None:
        setattr(args, "run.mode", "realtime")
    chosen = {key.partition(".")[2]: value for key, value in vars(args).items() if key.startswith("swarm.")}
    config = run_config(args, **mission_defaults(settings, chosen))
    domain = None if args.domain is None else whole_number(args.domain, "domain", 0, 232)
    options = FlightOptions(domain=domain, pictures=args.picture)
    page = page_options(args)
    with Stop() as stop:
        try:
            flight = fly_crazyflies(config, settings, path, args.out, options, stop, attach=args.attach, page=page)
        except MissionError as error:
            if not stop:
                raise
            warn(f"no exchange: {error}")
            return INTERRUPTED
    _print_result(args, flight)
    unheard, cut_short = _report_missing_frames(flight.summary), flight.summary["cut_short"]
    not_landed = [] if stop and not cut_short else flight.summary.get("not_landed", [])
    if problem := mission_problem(cut_short, not_landed):
        warn(problem)
        return 1
    return INTERRUPTED if stop else int(unheard)


def mission_problem(cut_short: str, not_landed: Sequence[str]) -> str:
    """A mission's problem in words; empty: none. ``cut_short``: why the exchange was, if it was."""
    exchange = f"the exchange was cut short: {cut_short}" if cut_short else "the exchange is complete"
    end = f"not known to have landed: {', '.join(not_landed)}" if not_landed else "all have landed"
    return f"{exchange}; {end}" if cut_short or not_landed else ""


def _report_missing_frames(summary: dict[str, Any]) -> bool:
    """Warn if no agent has heard another one, or most frames were of no use; whether it is so."""
    if summary["unheard"]:
        warn(summary["unheard"])
    return bool(summary["unheard"])


def _print_result(args: argparse.Namespace, flight: Any) -> None:
    """Print what came of a flight."""
    files = f"bag:     {flight.bag}\nresults: {Path(args.out) / 'summary.json'}"
    print(json.dumps(flight.summary, indent=2) if args.json else f"{describe(flight.summary)}\n{files}")


def describe(summary: dict[str, Any]) -> str:
    """A flight's results in a few lines."""
    end = summary["end"]
    arrived = "" if summary["completion_time_s"] is None else f" after {summary['completion_time_s']:.2f} s"
    if summary["collided"]:
        end = "crashed (cf{} and cf{})".format(*summary["collided_pair"])
    elif end == "completed":
        end += arrived
    what = "{agents} agents, {moving} moving, {policy}, {estimator}, {avoider}".format(**summary)
    lines = [f"{what}: {end}"]
    if summary["collided"] and arrived:
        lines.append(f"all were at their targets{arrived}")
    parts = ["slots {total} (success {success}, collision {collision}, idle {idle})".format(**summary["slots"])]
    for name, key, form in (
        ("closest", "min_distance_m", "{:.3f} m"), ("efficiency", "efficiency_mean", "{:.3f}"),
        ("mean age", "age_mean_slots", "{:.2f} slots"), ("real-time factor", "realtime_factor", "{:.2f}"),
    ):  # fmt: skip
        if summary[key] is not None:
            parts.append(f"{name} {form.format(summary[key])}")
    return "\n".join([*lines, ", ".join(parts)])
