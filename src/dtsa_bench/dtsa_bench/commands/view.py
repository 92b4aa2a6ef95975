"""`dtsa view`: a swarm in the browser."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

from .network_options import add_network_options, read_network_options

if TYPE_CHECKING:
    from dtsa_bench.pages.view.page_commands import PageCommand
    from dtsa_bench.pages.view.server import ViewServer

DESCRIPTION = """\
Shows a swarm on a page that this machine alone can open: the swarm on the ROS graph, or (--air) agents on a network or
a radio, with their settings as for `dtsa sniff`. The address that is printed holds a random token; whoever does not
know it gets nothing. A recorded run has a page of its own: `dtsa report`."""
EXAMPLES = (
    ("--domain 7", "the swarm on a ROS domain"),
    ("--air udp --interface eth0 --auth-session 41", "agents on a network; the key is in DTSA_AUTH_KEY"),
)
_ROS = "ros"
_END_S = 2.0  # for the source to end, and for pages to receive the end of a flight
_NICE = 10  # flights on this machine go first


class Source(Protocol):
    """Adds the moments of a run to a history, in a thread of its own."""

    stopped: bool

    def run(self) -> None:
        """Follow the run until it is over, or ``stopped`` is set."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.usage = "%(prog)s [OPTIONS]"
    parser.add_argument("bags", nargs="*", help=argparse.SUPPRESS)
    from dtsa_agent.air.port import AIRS

    parser.add_argument("--air", choices=(_ROS, *AIRS), help="what carries the swarm's frames [ros]")
    parser.add_argument("--domain", metavar="N", default=None, help="ROS_DOMAIN_ID of the swarm")
    parser.add_argument("--namespace", metavar="NAME", default=None, help="namespace of the swarm [/swarm]")
    parser.add_argument(
        "--control",
        action="store_true",
        help="the page may change the channel, kill and start agents, land all Crazyflies and stop their motors",
    )
    parser.add_argument("--port", metavar="N", default="0", help="where the page is [a free port]")
    parser.add_argument(
        "--listen", metavar="ADDRESS", default=None, help="an address of this machine that others reach [127.0.0.1]"
    )
    add_network_options(parser)


def run(args: argparse.Namespace) -> int:
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
    if args.listen is not None and not _plain_address(args.listen):
        raise ConfigError("listen", args.listen, "one address of this machine, in numbers")
    with suppress(OSError):
        os.nice(_NICE)
    source: Source
    command: Callable[[PageCommand], str] | None = None
    if args.swarm_file or args.air not in (None, _ROS):
        from dtsa_bench.pages.view.network_listener import NetworkListener

        settings, config = read_network_options(args)
        history = RunHistory(settings.where)
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


def _plain_address(text: str) -> bool:
    from ipaddress import ip_address

    try:
        return not ip_address(text).is_unspecified
    except ValueError:
        return False


async def _serve(server: ViewServer, source: Source, port: int, address: str | None) -> None:
    """Serve until a signal comes."""
    import signal

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
