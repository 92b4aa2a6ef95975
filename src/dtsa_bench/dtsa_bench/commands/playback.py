"""`dtsa replay` and `dtsa view`: a run in the ROS graph, and in the browser."""

from __future__ import annotations

import argparse
import asyncio
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from .registry import RECORDED_RUN, Command, add_rows, warn

if TYPE_CHECKING:
    from dtsa_bench.log.bag.replay import Player
    from dtsa_bench.pages.view.graph import GraphSource
    from dtsa_bench.pages.view.history import PageCommand
    from dtsa_bench.pages.view.network_listener import NetworkListener
    from dtsa_bench.pages.view.server import ViewServer


_ROS = "ros"
_END_S = 2.0  # for the source to end, and for pages to receive the end of a flight
_NICE = 10  # flights on this machine go first


class ReplayCommand(Command):
    description = """\
Publishes a recorded run: the recorded bytes on the recorded topics with the recorded QoS, in time, and
/clock.
Other nodes follow it with use_sim_time:=true. Keys: space pauses and goes on, q ends."""
    examples = (
        ("runs/a", "in real time"),
        ("runs/a --rate 0.5 --start 2 --loop", "half as fast, from 2 s on, again and again"),
    )
    options = (
        ("bag", RECORDED_RUN),
        ("--rate R", "speed, 1 is real time (default 1)", {"type": float, "default": 1.0}),
        ("--start S", "begin S seconds into the run", {"type": float, "default": 0.0}),
        ("--loop", "begin again at the end, until q or Ctrl-C"),
        ("--topics TOPIC...", "play these topics only"),
        ("--delay S", "wait S seconds before the first message, for subscribers to find the player (default 0.5)",
         {"type": float, "default": 0.5}),
        ("--wait-for-subscriber", "begin when one of the topics has a subscriber"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
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
                output = RosOutput(node, topics, lambda line: warn(f"warning: {line}"))
                player = Player(bag, output, args.rate, args.start, args.loop, output.topics)

                def stop(*_: object) -> None:
                    player.stopped = True

                signal.signal(signal.SIGINT, stop)
                signal.signal(signal.SIGTERM, stop)
                seconds = (bag.end_ns - bag.start_ns) / 1e9
                what = f"{len(output.topics)} topics, {seconds:.2f} s of simulated time"
                print(f"playing {what}, at rate {args.rate:g}", flush=True)
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
    """Do what keys say, and show on a terminal where the player is."""
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

    def is_ready() -> bool:
        return bool(select.select([descriptor], [], [], 0)[0])

    before = termios.tcgetattr(descriptor)
    try:
        tty.setcbreak(descriptor)
        yield lambda: os.read(descriptor, 64).decode("utf-8", "replace") if is_ready() else ""
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


class ViewCommand(Command):
    description = """\
Shows a swarm on a page that this machine alone can open: the swarm on the ROS graph, or (--air) agents on a network or
a radio, with their settings as for `dtsa sniff`. The address that is printed holds a random token, without which
every request is refused. A recorded run has a page of its own: `dtsa report`."""
    examples = (
        ("--domain 7", "the swarm on a ROS domain"),
        ("--air udp --interface eth0 --auth-session 41", "agents on a network; the key is in DTSA_AUTH_KEY"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.usage = "%(prog)s [OPTIONS]"
        parser.add_argument("bags", nargs="*", help=argparse.SUPPRESS)
        from dtsa_agent.air.port import AIRS

        add_rows(parser, (
            ("--air", "what carries the swarm's frames [ros]", {"choices": (_ROS, *AIRS)}),
            ("--domain N", "ROS_DOMAIN_ID of the swarm"),
            ("--namespace NAME", "namespace of the swarm [/swarm]"),
            ("--control", "the page may change the channel, kill and start agents, land all Crazyflies and stop their "
             "motors"),
            ("--port N", "where the page is [a free port]", {"default": "0"}),
            ("--listen ADDRESS", "an address of this machine that others reach [127.0.0.1]"),
        ))  # fmt: skip
        from .network import add_network_options

        add_network_options(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Serve the page until a signal comes."""
        from dtsa_agent.core.errors import ConfigError
        from dtsa_bench.pages.view.history import RunHistory
        from dtsa_bench.pages.view.server import ViewServer, new_token
        from dtsa_bench.runs.options import whole_number
        from dtsa_bench.runs.program import program

        if args.bags:
            bags = " ".join(args.bags)
            raise ConfigError("bag", bags, f"none; a recorded run is shown by `{program()} report {bags}`")
        port = whole_number(args.port, "port", 0, 65535)
        if args.listen is not None and not _is_address(args.listen):
            raise ConfigError("listen", args.listen, "one address of this machine, in numbers")
        with suppress(OSError):
            os.nice(_NICE)
        source: GraphSource | NetworkListener
        command: Callable[[PageCommand], str] | None = None
        if args.swarm_file or args.air not in (None, _ROS):
            from dtsa_bench.pages.view.network_listener import NetworkListener

            from .network import read_network_options

            settings, config = read_network_options(args)
            history = RunHistory(settings.destination)
            source = NetworkListener(history, config, settings)
        else:
            from dtsa_agent.ros.common import names
            from dtsa_bench.pages.view.graph import GraphSource

            domain = None if args.domain is None else whole_number(args.domain, "domain", 0, 232)
            space = "/" + args.namespace.strip("/") if args.namespace else names.SWARM
            history = RunHistory(space)
            source = graph = GraphSource(history, domain, space, args.control)
            command = graph.command if args.control else None
        asyncio.run(_serve(ViewServer(history, new_token(), command), source, port, args.listen))
        return 0


def _is_address(text: str) -> bool:
    from ipaddress import ip_address

    try:
        return not ip_address(text).is_unspecified
    except ValueError:
        return False


async def _serve(server: ViewServer, source: GraphSource | NetworkListener, port: int, address: str | None) -> None:
    """Serve until a signal comes."""
    from dtsa_bench.pages.view.server import LOOPBACK

    thread = threading.Thread(target=source.run, daemon=True)
    url = await server.start(port, address or LOOPBACK)
    over = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, over.set)
    thread.start()
    print(url, flush=True)
    if sys.stderr.isatty():
        print("open it in a browser; Ctrl-C ends", file=sys.stderr, flush=True)
    await over.wait()
    source.stopped = True
    await asyncio.get_running_loop().run_in_executor(None, thread.join, _END_S)
    await server.stop(_END_S)
