"""`dtsa replay`: play a recorded run."""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .registry import RECORDED_RUN

if TYPE_CHECKING:
    from dtsa_bench.recordings.bag.reader import Bag
    from dtsa_bench.recordings.bag.replay import Player, RosOutput

DESCRIPTION = """\
Publishes a recorded run: the recorded bytes on the recorded topics with the recorded QoS, in time, and
/clock.
Other nodes follow it with use_sim_time:=true. Keys: space pauses and goes on, q ends."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    parser = subparsers.add_parser(
        "replay",
        help="play a recorded run on the ROS graph",
        description=DESCRIPTION,
    )
    parser.add_argument("bag", help=RECORDED_RUN)
    parser.add_argument("--rate", type=float, default=1.0, metavar="R", help="speed, 1 is real time (default 1)")
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="begin S seconds into the run")
    parser.add_argument("--loop", action="store_true", help="begin again at the end, until q or Ctrl-C")
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="play these topics only")
    parser.add_argument(
        "--delay", type=float, default=0.5, metavar="S",
        help="wait S seconds before the first message, for subscribers to find the player (default 0.5)",
    )  # fmt: skip
    parser.add_argument(
        "--wait-for-subscriber",
        action="store_true",
        help="begin when somebody subscribes to one of the topics",
    )


def run(args: argparse.Namespace) -> int:
    """Play the bag."""
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.recordings.bag.reader import Bag

    if not 0 <= args.delay <= 3600:
        raise ConfigError("delay", args.delay, "0 to 3600 s")
    with Bag(args.bag) as bag:
        return _play(args, bag)


def _play(args: argparse.Namespace, bag: Bag) -> int:
    import rclpy

    from dtsa_agent.ros.common.process.node_process import init_ros
    from dtsa_agent.ros.common.workarounds.dds import limit_to_machine
    from dtsa_bench.recordings.bag.replay import Player, RosOutput, steady_timing

    topics = [bag.topic(name) for name in args.topics] if args.topics else list(bag.topics.values())
    limit_to_machine(os.environ)
    init_ros(None)
    try:
        node = rclpy.create_node("replay", enable_rosout=False, start_parameter_services=False)
        output = RosOutput(node, topics)
        player = Player(bag, output, args.rate, args.start, args.loop, args.topics)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: player.stop())
        seconds = (bag.end_ns - bag.start_ns) / 1e9
        print(f"playing {len(topics)} topics, {seconds:.2f} s of simulated time, at rate {args.rate:g}", flush=True)
        with keyboard() as pressed, steady_timing():
            screen = Screen(bag.start_ns, bag.end_ns)
            _wait(args, output, player)
            player.play(lambda playing: _poll(playing, pressed, screen))
            screen.end(player)
    finally:
        rclpy.try_shutdown()
    return 0


def _wait(args: argparse.Namespace, output: RosOutput, player: Player) -> None:
    while args.wait_for_subscriber and not player.stopped and not output.subscribers():
        time.sleep(0.02)
    until = time.monotonic() + args.delay
    while not player.stopped and time.monotonic() < until:
        time.sleep(0.02)


def _poll(player: Player, pressed: Pressed, screen: Screen) -> None:
    for key in pressed():
        if key == " ":
            player.toggle_pause()
        elif key in "qQ\x03":
            player.stop()
    screen.show(player)


class Pressed:
    """Keys pressed since the last call; nothing where there is no terminal."""

    def __init__(self, descriptor: int | None) -> None:
        self._descriptor = descriptor

    def __call__(self) -> str:
        if self._descriptor is None or not select.select([self._descriptor], [], [], 0)[0]:
            return ""
        return os.read(self._descriptor, 64).decode("utf-8", "replace")


@contextmanager
def keyboard() -> Iterator[Pressed]:
    """The terminal, read key by key; as it was before, afterwards."""
    if not sys.stdin.isatty():
        yield Pressed(None)
        return
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield Pressed(descriptor)
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class Screen:
    """The line that says where the player is; silent where there is no terminal.

    :param start_ns: ns, first log time of the bag. :param end_ns: ns, last one.
    """

    def __init__(self, start_ns: int, end_ns: int) -> None:
        self._start_ns, self._length = start_ns, (end_ns - start_ns) / 1e9
        self._live = sys.stderr.isatty()
        self._next = 0.0

    def show(self, player: Player) -> None:
        """Show it, a few times a second."""
        if not self._live or time.monotonic() < self._next:
            return
        self._next = time.monotonic() + 0.1
        progress = player.progress
        at = (progress.time_ns - self._start_ns) / 1e9
        state = "paused" if progress.paused else "      "
        text = f"\r{at:8.2f} of {self._length:.2f} s   {progress.messages} messages  {state}  [space] [q]"
        sys.stderr.write(text)
        sys.stderr.flush()

    def end(self, player: Player) -> None:
        """Say what was played."""
        progress = player.progress
        if self._live:
            sys.stderr.write("\n")
        mean, most = progress.late_mean_ns / 1e6, progress.late_max_ns / 1e6
        late = f"late by {mean:.3f} ms on average, {most:.3f} ms at most"
        rounds = f" in {progress.rounds + 1} rounds" if progress.rounds else ""
        print(f"played {progress.messages} messages{rounds}, {late}", flush=True)
