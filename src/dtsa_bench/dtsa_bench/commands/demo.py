"""`demo`: nine flights that show in four steps what this software is about; one picture, and the report of them all."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
import webbrowser
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_bench.runs.options import new_directory, whole_number
from dtsa_bench.runs.program import program

from .registry import INTERRUPTED, Command, warn

if TYPE_CHECKING:
    from dtsa_bench.pages.demo.flights import FinishedFlight


NUMBERS = "demo.json"
_REMOTE = ("SSH_CONNECTION", "SSH_CLIENT", "SSH_TTY", "CI")


class DemoCommand(Command):
    description = """\
Nine flights of ROS 2 nodes, recorded and verified, tell in four steps who sends next on a channel that quadcopters
share, and what goes wrong when messages are lost. One picture shows them all. The first eight, which are the same on
every machine, stand side by side on a page; in the last one, in real time, a process is killed and comes back."""
    examples = (
        ("", "everything, into runs/demo-1, and the page in a browser"),
        ("--animation --no-open --out story", "with a moving picture; no browser"),
    )
    options = (
        ("--out DIR", "new directory for everything [runs/demo-1, -2, ...]"),
        ("--seed N", "seed of the flights [1]", {"default": "1"}),
        ("--animation", "make demo.gif, too, a moving picture of steps 2 and 3"),
        ("--json", "print demo.json; everything else goes to standard error"),
        ("--open", "open the page in a browser [where there is a display, but not over ssh or in CI]",
         {"action": argparse.BooleanOptionalAction, "default": None}),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Fly, check, draw; 1 if a bag's check failed, 130 when interrupted."""
        if args.json:
            with redirect_stdout(sys.stderr):
                code, directory = _run(args)
            if code != INTERRUPTED:
                print((directory / NUMBERS).read_text(encoding="utf-8"), end="")
            return code
        return _run(args)[0]


def _run(args: argparse.Namespace) -> tuple[int, Path]:
    seed = whole_number(args.seed, "seed", 0, 2**63 - 1)
    number = 1
    while args.out is None and Path(f"runs/demo-{number}").exists():
        number += 1

    from dtsa_bench.flights.domain import clear_hindrances

    clear_hindrances(os.environ)
    from dtsa_agent.stop import Stop
    from dtsa_bench.experiments.tables import aligned
    from dtsa_bench.pages.demo.flights import HEAD, demo_steps, fly_all, table_rows
    from dtsa_bench.pages.report.data import write_report

    directory = new_directory(args.out or f"runs/demo-{number}")
    begin = time.monotonic()
    steps = demo_steps(seed)
    print(f"{sum(map(len, steps))} flights of ROS 2 nodes, recorded to {directory}", flush=True)
    with Stop() as stop:
        flights = fly_all(steps, directory, stop)
    if stop:
        warn(f"the demo was interrupted; what was flown is in {directory}")
        return INTERRUPTED, directory
    good = [_is_verified(key, directory / key) for key in flights]
    print("\n" + aligned([HEAD, *table_rows(steps, flights)], rule=True) + "\n", flush=True)
    numbers = {key: dict(finished.summary) for key, finished in flights.items()}
    (directory / NUMBERS).write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    print("drawing the picture and the page ...", file=sys.stderr, flush=True)
    _draw(steps, flights, directory, args.animation)
    compared = [directory / key for key, finished in flights.items() if not finished.flight.live]
    page = write_report(compared, directory / "demo.html")
    print(f"picture    {directory / 'demo.png'}\nflights    {directory}/{{{','.join(flights)}}}")
    for text, command in _next_commands(directory):
        print(f"{text:44} {command}")
    print(f"\n{time.monotonic() - begin:.0f} s in all. The page:", flush=True)
    open_page(page, args.open)
    print(page)
    return 0 if all(good) else 1, directory


def _is_verified(key: str, bag: Path) -> bool:
    """Verify a bag and print a line about it."""
    from dtsa_bench.log.verify.check import verify_bag

    result = verify_bag(bag)
    if result.ok:
        print(f"verified  {key:14} {sum(result.checked.values()):6} checks: all is what the protocol gives", flush=True)
    else:
        print(f"NOT GOOD  {key}: {result.difference}")
    return result.ok


def _draw(steps: Any, flights: Mapping[str, FinishedFlight], directory: Path, animation: bool) -> None:
    from dtsa_bench.drawing import optional_picture

    with optional_picture(directory / "demo.png") as file:
        from dtsa_bench.pages.demo.picture import draw_demo

        draw_demo(file, steps, flights)
    if animation:
        with optional_picture(directory / "demo.gif") as file:
            from dtsa_bench.pages.demo.picture import draw_animation

            draw_animation(file, flights)


def _next_commands(directory: Path) -> list[tuple[str, str]]:
    """Commands to go on with: the purpose of each, and its words."""
    return [
        ("the flight in which one is killed, as a page", f"{program()} report {directory}/killed-lease"),
        ("was every decision what the protocol says?", f"{program()} verify {directory}/two-lease"),
        ("play a recording into the ROS graph", f"{program()} replay {directory}/two-lease"),
        ("as tables", f"{program()} export {directory}/two-lease"),
        ("look inside with Foxglove or PlotJuggler", f"{directory}/two-lease/bag/bag_0.mcap"),
        ("the same without ROS, in milliseconds", f"{program()} simulate --agents 12 --moving 2 --policy lease"),
        ("thousands of flights", f"{program()} sweep --preset loss"),
    ]


def has_display(environment: Mapping[str, str], platform: str) -> bool:
    """Whether this process has a display of its user's: not over ssh, not in CI."""
    if any(environment.get(name) for name in _REMOTE):
        return False
    return platform == "darwin" or bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def open_page(path: Path, wanted: bool | None = None) -> bool:
    """Open a page; whether a browser took it. None: where there is a display."""
    if not (has_display(os.environ, sys.platform) if wanted is None else wanted):
        return False
    try:
        return webbrowser.open(path.resolve().as_uri())
    except webbrowser.Error:
        return False
