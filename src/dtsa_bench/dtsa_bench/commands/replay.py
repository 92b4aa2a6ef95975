"""`dtsa replay`: play a recorded run."""

from __future__ import annotations

import argparse
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from .registry import RECORDED_RUN

if TYPE_CHECKING:
    from dtsa_bench.log.bag.replay import Player

DESCRIPTION = """\
Publishes a recorded run: the recorded bytes on the recorded topics with the recorded QoS, in time, and
/clock.
Other nodes follow it with use_sim_time:=true. Keys: space pauses and goes on, q ends."""
EXAMPLES = (
    ("runs/a", "in real time"),
    ("runs/a --rate 0.5 --start 2 --loop", "half as fast, from 2 s on, again and again"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
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
        "--wait-for-subscriber", action="store_true", help="begin when somebody subscribes to one of the topics"
    )


def run(args: argparse.Namespace) -> int:
    """Play the bag."""
    import rclpy

    from dtsa_agent.core.errors import ConfigError
    from dtsa_agent.ros.common.node_process import init_ros, limit_to_machine
    from dtsa_bench.log.bag.reader import Bag
    from dtsa_bench.log.bag.replay import Player, RosOutput

    if not 0 <= args.delay <= 3600:
        raise ConfigError("delay", args.delay, "0 to 3600 s")
    with Bag(args.bag) as bag:
        topics = [bag.topic(name) for name in args.topics] if args.topics else list(bag.topics.values())
        limit_to_machine(os.environ)
        init_ros(None)
        try:
            node = rclpy.create_node("replay", enable_rosout=False, start_parameter_services=False)
            output = RosOutput(node, topics, lambda line: print(f"dtsa: warning: {line}", file=sys.stderr, flush=True))
            player = Player(bag, output, args.rate, args.start, args.loop, output.topics)

            def stop(*_: object) -> None:
                player.stopped = True

            signal.signal(signal.SIGINT, stop)
            signal.signal(signal.SIGTERM, stop)
            seconds = (bag.end_ns - bag.start_ns) / 1e9
            print(
                f"playing {len(output.topics)} topics, {seconds:.2f} s of simulated time, at rate {args.rate:g}",
                flush=True,
            )
            while args.wait_for_subscriber and not player.stopped and not output.subscribers():
                time.sleep(0.02)
            begin = time.monotonic() + args.delay
            while not player.stopped and time.monotonic() < begin:
                time.sleep(0.02)
            with keyboard() as pressed:
                player.play(lambda player: _poll(player, pressed, bag.start_ns, seconds))
            if sys.stderr.isatty():
                print(file=sys.stderr)
            rounds = f" in {player.round_count + 1} rounds" if player.round_count else ""
            print(f"played {player.message_count} messages{rounds}", flush=True)
        finally:
            rclpy.try_shutdown()
    return 0


def _poll(player: Player, pressed: Callable[[], str], start_ns: int, length_s: float) -> None:
    """Does what keys say, and shows on a terminal where the player is."""
    for key in pressed():
        player.paused ^= key == " "
        player.stopped |= key in "qQ\x03"
    if sys.stderr.isatty():
        at, state = (player.time_ns - start_ns) / 1e9, "paused" if player.paused else "      "
        text = f"\r{at:8.2f} of {length_s:.2f} s   {player.message_count} messages  {state}  [space] [q]"
        print(text, end="", file=sys.stderr, flush=True)


@contextmanager
def keyboard() -> Iterator[Callable[[], str]]:
    """Keys pressed since the last call, on a terminal, which is afterwards as it was before."""
    if not sys.stdin.isatty():
        yield str
        return
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield (
            lambda: (
                os.read(descriptor, 64).decode("utf-8", "replace") if select.select([descriptor], [], [], 0)[0] else ""
            )
        )
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
