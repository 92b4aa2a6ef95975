"""`dtsa agent`: one agent whose frames go over a network or a radio."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from .swarm_file import add_swarm_file, take_swarm_file

if TYPE_CHECKING:
    from dtsa_agent.air.port import PortSettings
    from dtsa_agent.core import SwarmConfig

DESCRIPTION = """\
Flies one agent, with a simulated vehicle, whose frames go over a port (--air): one process a computer, no channel
node, no start signal, no ROS. The first agent begins; groups that meet become one. Frames are sealed: the key is in the
environment, DTSA_AUTH_KEY. See docs/how-to/several-computers.md."""
DEFAULT_POLICY = "lease"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Register the command."""
    from dtsa_agent.air.settings import AgentSettings
    from dtsa_bench.runs.options import add_options

    parser = subparsers.add_parser("agent", help="one agent on a real network or radio", description=DESCRIPTION)
    parser.usage = "%(prog)s --id N (--interface NAME | --device PATH | --uri URI) [OPTIONS]"
    add_air(parser)
    own = parser.add_argument_group("this agent")
    add_options(own, AgentSettings, "own")
    own.add_argument(
        "--check",
        nargs="?",
        const="0",
        metavar="SECONDS",
        help="does not fly: tells who is heard, in time, and by whom; exit code 0: all hear all [until all can tell]",
    )
    add_ports(parser)
    add_swarm(parser)


def add_air(parser: argparse.ArgumentParser) -> None:
    """Adds what carries the frames, and where the results go."""
    from dtsa_agent.air.ports import AIRS

    parser.add_argument("--air", choices=AIRS, help=f"what carries the frames [{AIRS[0]}]")
    add_swarm_file(parser)
    parser.add_argument("--out", metavar="DIR", help="directory for its bag and summary.json; default: only printed")
    parser.add_argument("--json", action="store_true", help="print summary.json instead of lines")


def add_ports(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the ports, and whether frames are sealed. A setting that several ports have is one option."""
    from dtsa_agent.air.ports import AIRS, settings_class
    from dtsa_agent.core.settings.declaration import settings_of
    from dtsa_bench.runs.options import add_options

    known: set[str] = set()
    for air in AIRS:
        group = parser.add_argument_group(f"what carries the frames: --air {air}")
        add_options(group, settings_class(air), "port", skip=known)
        known |= {setting.name for setting in settings_of(settings_class(air))}
    group = parser.add_argument_group("authentication")
    group.add_argument(
        "--seal",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="frames carry a code that only holders of the key can make; the key is in the environment: DTSA_AUTH_KEY "
        "[--seal]",
    )


def add_swarm(parser: argparse.ArgumentParser) -> None:
    """Adds the options of the swarm, with the defaults of this air."""
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.core.settings.declaration import settings_of
    from dtsa_bench.runs.options import add_options

    swarm = parser.add_argument_group("the swarm: what all agents share")
    swarm.add_argument("--policy", metavar="NAME", help=f"who sends next [{DEFAULT_POLICY}]")
    skip = ("policy", "auth", *(s.name for s in settings_of(SwarmConfig) if s.group == "Priority and selection"))
    add_options(swarm, SwarmConfig, "swarm", skip=skip)


def port_of(args: argparse.Namespace) -> PortSettings:
    """What carries the frames, as the options describe it.

    :param args: parsed options.
    :raises ConfigError: for one that cannot be, or for an option of another port.
    """
    from dtsa_agent.air.ports import AIRS, make_settings, settings_class
    from dtsa_agent.core.errors import ConfigError
    from dtsa_bench.runs.options import given

    values = given(args, settings_class(args.air), "port")
    for air in AIRS:
        for name, value in given(args, settings_class(air), "port").items():
            if name not in values:
                raise ConfigError(name, value, f"only with --air {air}")
    return make_settings(args.air, values)


def swarm_of(args: argparse.Namespace) -> SwarmConfig:
    """The swarm that the options describe.

    :param args: parsed options.
    :raises ConfigError: for one that cannot be, or a missing key or session.
    """
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.keys import check_key, check_session
    from dtsa_bench.runs.options import given

    named = {"policy": args.policy or DEFAULT_POLICY, "auth": args.seal is not False}
    config = SwarmConfig.from_dict({**given(args, SwarmConfig, "swarm"), **named})
    check_key(config)  # before anything is made
    check_session(config)
    return config


def _check_of(args: argparse.Namespace) -> float | None:
    """How long to check, s, 0: as long as it takes; None: it flies.

    :raises ConfigError: for another text than a number, and for options that only a flight has.
    """
    from dtsa_agent.core.errors import ConfigError
    from dtsa_agent.core.settings.declaration import Setting

    if args.check is None:
        return None
    for name, value in (("out", args.out), ("duration_s", getattr(args, "own.duration_s"))):
        if value is not None:
            raise ConfigError(name, value, "only without --check")
    return float(Setting("check", "float", 0.0, "how long", unit="s", minimum=0, maximum=3600).read(args.check))


def run(args: argparse.Namespace) -> int:
    """Fly until Ctrl-C, and print what came of it."""
    from dtsa_agent.air.datagram import check_fits
    from dtsa_agent.air.ports import AIRS
    from dtsa_agent.air.prepared import prepare
    from dtsa_agent.air.settings import AgentSettings
    from dtsa_agent.core.agents.joining import check_joinable
    from dtsa_bench.network.flying import Order, become, check, fly
    from dtsa_bench.runs.options import given

    take_swarm_file(args, AIRS[0])
    own = AgentSettings.from_dict(given(args, AgentSettings, "own"))
    port, config = port_of(args), swarm_of(args)
    check_joinable(config.policy)  # before anything is made
    check_fits(config, port.properties)
    seconds = _check_of(args)
    order = Order(own, config, port, prepare(config, port.properties), args.out, args.json)
    if seconds is not None:
        return check(order, seconds)
    if args.own_process:
        become(order, "dtsa_bench.commands.agent_process")
    return fly(order)
