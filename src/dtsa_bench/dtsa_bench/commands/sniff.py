"""`dtsa sniff`: listens to agents on a network or a radio without taking part."""

from __future__ import annotations

import argparse
import json
import sys

from .network_options import add_network_options, add_results, read_network_options

DESCRIPTION = """\
Listens to a swarm on a network or a radio without taking part, records what it hears, and judges it: two senders in a
slot, frames out of turn, turns given away twice or by others. Exit code 1 if a rule was broken. A listener may miss
frames: then a lease that it does not know looks like a broken rule."""
EXAMPLES = (
    ("--interface eth0 --auth-session 41 --out runs/sniffed", "twelve agents; until Ctrl-C"),
    ("--air crazyradio --uri radio://0/80/2M --slot-ms 20 --auth-session 41", "with a Crazyradio 2.0"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.usage = "%(prog)s (--interface NAME | --device PATH | --uri URI) [OPTIONS]"
    add_results(parser)
    parser.add_argument("--duration-s", metavar="X", default="0", help="for so long; 0: until Ctrl-C [0]")
    add_network_options(parser)


def run(args: argparse.Namespace) -> int:
    """Listen until Ctrl-C, and print what came of it."""
    from dtsa_agent.stop import Stop
    from dtsa_bench.log.bag.errors import BagError
    from dtsa_bench.network.sniffer import Sniffer
    from dtsa_bench.runs.options import new_directory, number

    from .merge import lines

    port, config = read_network_options(args)
    duration = number(args.duration_s, "duration_s", 0, 1e6)
    directory = None if args.out is None else new_directory(args.out)
    path = None if directory is None else directory / "sniffed.mcap"

    def say(line: str) -> None:
        print(f"dtsa: {line}", file=sys.stderr, flush=True)

    with Stop() as stop, Sniffer(config, port, path, say) as sniffer:
        sniffer.run(stop, duration)
    summary = sniffer.summary()
    text = json.dumps(summary, indent=2) + "\n"
    if directory is not None:
        (directory / "summary.json").write_text(text, encoding="utf-8")
    print(text if args.json else "\n".join(lines(summary)) + "\n", end="")
    if sniffer.bag is not None and sniffer.bag.failure:
        raise BagError(sniffer.bag.failure)
    return 1 if summary["rules_broken"] else 0
