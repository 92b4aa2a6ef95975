"""`dtsa agent`: one agent whose frames go over a network or a radio."""

from __future__ import annotations

import argparse

from dtsa_agent.air.port import check_fits
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core.station import check_joinable
from dtsa_bench.runs.options import add_options, given_options, number

from .network_options import add_network_options, add_results, read_network_options

DESCRIPTION = """\
Flies one agent, with a simulated vehicle, whose frames go over a port (--air): one process a computer, no channel
node, no start signal, no ROS. The first agent begins; groups that meet become one. Frames are sealed: the key is in the
environment, DTSA_AUTH_KEY. See docs/how-to/several-computers.md."""
EXAMPLES = (
    ("--id 3 --interface eth0 --auth-session 41", "the third of twelve; the key is in DTSA_AUTH_KEY"),
    ("--id 1 --agents 4 --interface lo --no-seal --duration-s 10 --out runs/cf1", "ten seconds, with a bag"),
    ("--swarm swarm.yaml --id 3 --auth-session 40 --check", "before a flight: do all hear all"),
    ("--id 3 --air crazyradio --uri radio://0/80/2M --slot-ms 20 --auth-session 41", "by a Crazyradio 2.0"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's options."""
    parser.usage = "%(prog)s --id N (--interface NAME | --device PATH | --uri URI) [OPTIONS]"
    add_results(parser)
    own = parser.add_argument_group("this agent")
    add_options(own, AgentSettings, "own")
    own.add_argument(
        "--check",
        nargs="?",
        const="0",
        metavar="SECONDS",
        help="does not fly: tells who is heard, in time, and by whom; exit code 0: all hear all [until all can tell]",
    )
    add_network_options(parser)


def run(args: argparse.Namespace) -> int:
    """Fly until Ctrl-C, and print what came of it."""
    from dtsa_bench.network.flying import AgentJob, check, fly

    port, config = read_network_options(args)
    own = AgentSettings.from_dict(given_options(args, AgentSettings, "own"))
    check_joinable(config.policy)  # before anything is made
    check_fits(config, port.properties)
    job = AgentJob(own, config, port, args.out, args.json)
    return fly(job) if args.check is None else check(job, number(args.check, "check", 0, 3600))
