"""`dtsa sniff`: listens to agents on a network or a radio without taking part."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

DESCRIPTION = """\
Listens to a swarm on a network or a radio without taking part, records what it hears, and judges it: two senders in a
slot, frames out of turn, turns given away twice or by others. Exit code 1 if a rule was broken. A listener may miss
frames: then a lease that it does not know looks like a broken rule."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    from .agent import add_air, add_ports, add_swarm

    parser = subparsers.add_parser("sniff", help="listen to agents on a real network or radio", description=DESCRIPTION)
    parser.usage = "%(prog)s (--interface NAME | --device PATH | --uri URI) [OPTIONS]"
    add_air(parser)
    parser.add_argument("--duration-s", metavar="X", default="0", help="for so long; 0: until Ctrl-C [0]")
    parser.add_argument(
        "--pcap", metavar="FILE", type=Path, help="with --air crazyradio: all packets that it hears, for Wireshark"
    )
    add_ports(parser)
    add_swarm(parser)


def run(args: argparse.Namespace) -> int:
    """Listen until Ctrl-C, and print what came of it."""
    from dtsa_agent.air.ports import AIRS
    from dtsa_agent.core.settings.declaration import Setting
    from dtsa_agent.stop import Stop
    from dtsa_bench.network.sniffer import Sniffer
    from dtsa_bench.recordings.bag.errors import BagError
    from dtsa_bench.runs.options import new_directory

    from .agent import port_of, swarm_of
    from .merge import lines
    from .swarm_file import take_swarm_file

    take_swarm_file(args, AIRS[0])
    duration = Setting("duration_s", "float", 0.0, "how long", unit="s", minimum=0, maximum=1e6).read(args.duration_s)
    port, config = port_of(args), swarm_of(args)
    directory = None if args.out is None else new_directory(args.out)
    path = None if directory is None else directory / "sniffed.mcap"

    def say(line: str) -> None:
        print(f"dtsa: {line}", file=sys.stderr, flush=True)

    with Stop() as stop, Sniffer(config, port, path, args.pcap, say) as sniffer:
        sniffer.run(stop, duration)
    summary = sniffer.summary()
    text = json.dumps(summary, indent=2) + "\n"
    if directory is not None:
        (directory / "summary.json").write_text(text, encoding="utf-8")
    print(text if args.json else "\n".join(lines(summary)) + "\n", end="")
    if sniffer.bag is not None and sniffer.bag.failure:
        raise BagError(sniffer.bag.failure)
    if sniffer.packets is not None and sniffer.packets.failure:
        raise BagError(sniffer.packets.failure)
    return 1 if summary["rules_broken"] else 0
