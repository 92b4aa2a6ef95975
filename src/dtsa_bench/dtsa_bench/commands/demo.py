"""`demo`: nine flights that tell in four steps what this software is about; one page, one picture."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dtsa_bench.pages.browser import open_page
from dtsa_bench.runs.options import new_directory, whole_number
from dtsa_bench.runs.program import program

if TYPE_CHECKING:
    from dtsa_bench.pages.demo.flown import Flights
    from dtsa_bench.pages.demo.flying import Landed
    from dtsa_bench.pages.demo.story import Step

INTERRUPTED = 130
NUMBERS = "demo.json"


def add_parser(subparsers: Any) -> None:
    """Adds the command's parser."""
    parser = subparsers.add_parser(
        "demo",
        help="nine recorded flights that show who sends next, a page and a picture; under a minute",
        description="Nine flights of ROS 2 nodes, recorded and verified, tell in four steps who speaks next on a "
        "channel that quadcopters share, and what goes wrong when messages are lost. They become one page and one "
        "picture. The first eight are the same on every machine; in the last one, in real time, a process is killed "
        "and comes back.",
    )
    parser.add_argument(
        "--out", metavar="DIR", default=None, help="new directory for everything [runs/demo-1, -2, ...]"
    )
    parser.add_argument("--seed", metavar="N", default="1", help="seed of the flights [1]")
    parser.add_argument(
        "--animation", action="store_true", help="make demo.gif, too, a moving picture of steps 2 and 3"
    )
    parser.add_argument("--json", action="store_true", help="print demo.json; everything else goes to standard error")
    parser.add_argument(
        "--open",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="open the page in a browser [where there is a display, but not over ssh or in CI]",
    )
    parser.set_defaults(run=run)


def _directory(wanted: str | None) -> Path:
    if wanted is not None:
        return new_directory(wanted)
    number = 1
    while Path(f"runs/demo-{number}").exists():
        number += 1
    return new_directory(f"runs/demo-{number}")


def run(args: argparse.Namespace) -> int:
    """Flies, checks, draws.

    :returns: 0; 1 if a bag's check failed; 130 when interrupted.
    """
    if args.json:
        with redirect_stdout(sys.stderr):
            code, directory = _run(args)
        if code != INTERRUPTED:
            print((directory / NUMBERS).read_text(encoding="utf-8"), end="")
        return code
    return _run(args)[0]


def _run(args: argparse.Namespace) -> tuple[int, Path]:
    seed = whole_number(args.seed, "seed", 0, 2**63 - 1)
    directory = _directory(args.out)

    from dtsa_agent.ros.common.process.loop import Stop
    from dtsa_bench.pages.demo.flying import fly_all
    from dtsa_bench.pages.demo.story import story

    begin = time.monotonic()
    steps = story(seed)
    count = sum(len(step.takes) for step in steps)
    print(f"{count} flights of ROS 2 nodes, recorded to {directory}", flush=True)
    with Stop() as stop:
        landed = fly_all(steps, directory, stop, sys.stderr)
    if stop:
        print(f"dtsa: the demo was interrupted; what was flown is in {directory}", file=sys.stderr)
        return INTERRUPTED, directory
    checks = [_check(key, entry.flight.bag) for key, entry in landed.items()]
    page = _show(steps, landed, directory, args.animation)
    print(f"\n{time.monotonic() - begin:.0f} s in all. The page:", flush=True)
    open_page(page, args.open)
    print(page)
    return 0 if all(checks) else 1, directory


def _check(key: str, bag: Path) -> bool:
    """Verifies a bag and says in a line what was found."""
    from dtsa_bench.recordings.verify import verify_bag

    found = verify_bag(bag)
    if found.ok:
        print(f"verified  {key:14} {sum(found.checked.values()):6} checks: all is what the protocol gives", flush=True)
    else:
        print(f"NOT GOOD  {key}: {found.difference}")
    return found.ok


def _show(steps: tuple[Step, ...], landed: dict[str, Landed], directory: Path, animation: bool) -> Path:
    """Writes everything that is to be looked at.

    :returns: the page.
    """
    from dtsa_bench.pages.demo.flown import read
    from dtsa_bench.pages.demo.page import write_page
    from dtsa_bench.pages.demo.picture import draw_demo
    from dtsa_bench.pages.demo.table import for_terminal

    flights = {}
    for take in (take for step in steps for take in step.takes):
        flight, times = landed[take.key].flight, landed[take.key].times
        flights[take.key] = read(take, flight.bag, flight.summary, flight.positions, times)
    _progress("drawing the picture and the page")
    picture, page = directory / "demo.png", directory / "demo.html"
    draw_demo(picture, steps, flights)
    write_page(page, steps, flights, _commands(directory))
    if animation:
        from dtsa_bench.pages.demo.animation import draw_animation

        _progress("drawing the animation")
        draw_animation(directory / "demo.gif", flights)
    print("\n" + for_terminal(steps, flights) + "\n")
    _tell(directory, picture, flights)
    return page


def _progress(text: str) -> None:
    print(f"{text} ...", file=sys.stderr, flush=True)


def _commands(directory: Path) -> list[tuple[str, str]]:
    """What to do with the recordings."""
    return [
        ("a flight with everything in it, as a page", f"{program()} report {directory}/two-tdma {directory}/two-dtsa"),
        ("was every decision what the protocol says?", f"{program()} verify {directory}/two-lease"),
        ("play a recording into the ROS graph", f"{program()} replay {directory}/two-lease"),
        ("as tables", f"{program()} export {directory}/two-lease"),
        ("look inside with Foxglove or PlotJuggler", f"{directory}/two-lease/bag/bag_0.mcap"),
        ("the same without ROS, in milliseconds", f"{program()} simulate --agents 12 --moving 2 --policy lease"),
        ("thousands of flights", f"{program()} sweep --preset loss"),
    ]


def _tell(directory: Path, picture: Path, flights: Flights) -> None:
    """Says where everything is and how to go on."""
    print(f"picture    {picture}\nflights    {directory}/{{{','.join(flights)}}}")
    for text, command in _commands(directory):
        print(f"{text:44} {command}")
    numbers = {key: dict(flown.summary) for key, flown in flights.items()}
    (directory / NUMBERS).write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
