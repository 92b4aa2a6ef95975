"""`dtsa agent`: one agent whose frames go over a network."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dtsa_agent.core import SwarmConfig

DESCRIPTION = """\
Flies one agent, with a simulated vehicle, whose frames go to a multicast group: one process a computer, no channel
node, no start signal, no ROS. The first agent begins; groups that meet become one. Frames are sealed: the key is in the
environment, DTSA_AUTH_KEY. See docs/how-to/several-computers.md."""
DEFAULT_POLICY = "lease"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    from dtsa_agent.air.settings import AgentSettings
    from dtsa_bench.runs.options import add_options

    parser = subparsers.add_parser("agent", help="one agent on a real network", description=DESCRIPTION)
    parser.usage = "%(prog)s --id N --interface NAME [OPTIONS]"
    add_air(parser)
    add_options(parser.add_argument_group("this agent"), AgentSettings, "own")
    add_network(parser)
    add_swarm(parser)


def add_air(parser: argparse.ArgumentParser) -> None:
    """Adds what carries the frames, and where the results go."""
    parser.add_argument("--air", choices=("udp",), default="udp", help="what carries the frames [udp]")
    parser.add_argument("--out", metavar="DIR", help="directory for its bag and summary.json; default: only printed")
    parser.add_argument("--json", action="store_true", help="print summary.json instead of lines")


def add_network(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the network, and whether frames are sealed."""
    from dtsa_agent.air.udp.settings import UdpSettings
    from dtsa_bench.runs.options import add_options

    network = parser.add_argument_group("the network")
    add_options(network, UdpSettings, "udp")
    network.add_argument(
        "--seal",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="frames carry a code that only holders of the key can make; the key is in the environment: DTSA_AUTH_KEY",
    )


def add_swarm(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the swarm, with the defaults of this air."""
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.core.settings.declaration import settings_of
    from dtsa_bench.runs.options import add_options

    swarm = parser.add_argument_group("the swarm: what all agents share")
    swarm.add_argument("--policy", metavar="NAME", default=DEFAULT_POLICY, help=f"who sends next [{DEFAULT_POLICY}]")
    skip = ("policy", "auth", *(s.name for s in settings_of(SwarmConfig) if s.group == "Priority and selection"))
    add_options(swarm, SwarmConfig, "swarm", skip=skip)


def swarm_of(args: argparse.Namespace) -> SwarmConfig:
    """The swarm that the options describe.

    :param args: parsed options.
    :raises ConfigError: for one that cannot be, or a missing key or session.
    """
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.keys import check_key, check_session
    from dtsa_bench.runs.options import given

    config = SwarmConfig.from_dict({**given(args, SwarmConfig, "swarm"), "policy": args.policy, "auth": args.seal})
    check_key(config)  # before anything is made
    check_session(config)
    return config


def run(args: argparse.Namespace) -> int:
    """Fly until Ctrl-C, and print what came of it."""
    from dtsa_agent.air.prepared import prepare
    from dtsa_agent.air.settings import AgentSettings
    from dtsa_agent.air.udp import UdpSettings
    from dtsa_agent.core.agents.joining import check_joinable
    from dtsa_bench.network.flying import Order, become, fly
    from dtsa_bench.runs.options import given

    own = AgentSettings.from_dict(given(args, AgentSettings, "own"))
    udp = UdpSettings.from_dict(given(args, UdpSettings, "udp"))
    config = swarm_of(args)
    check_joinable(config.policy)  # before anything is made
    order = Order(own, config, udp, prepare(config), args.out, args.json)
    if args.own_process:
        become(order, "dtsa_bench.commands.agent_process")
    return fly(order)
