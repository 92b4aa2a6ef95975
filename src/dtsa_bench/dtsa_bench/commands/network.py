"""`dtsa agent` and `dtsa sniff`: agents whose frames go over a network or a radio; the options that they share.

`dtsa relay`: topics of any robots over the simulated channel.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from dtsa_agent.air.port import AIRS, PortSettings, check_fits, settings_class
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError, did_you_mean
from dtsa_agent.core.settings.declaration import Setting, Settings, names_with_values, settings_of
from dtsa_agent.core.station import check_joinable
from dtsa_agent.keys import check_key, check_session
from dtsa_agent.yaml_file import read_yaml
from dtsa_bench.runs.options import add_options, new_directory, number, option_values

from .registry import Command, add_rows, warn

DEFAULT_POLICY = "lease"
_NO_OPTION = ("policy", "auth", *(s.name for s in settings_of(SwarmConfig) if s.group == "Priority and selection"))
_ROS = "/**", "ros__parameters"  # of a file of ROS parameters, which counts as well
_OPTIONS = {"policy": "policy", "auth": "seal"}  # settings whose options are called otherwise


def add_results(parser: argparse.ArgumentParser) -> None:
    """Add what carries the frames, and where the results go."""
    add_rows(parser, (
        ("--air", f"what carries the frames [{AIRS[0]}]", {"choices": AIRS}),
        ("--out DIR", "directory for its bag and summary.json; default: only printed"),
        ("--json", "print summary.json instead of lines"),
    ))  # fmt: skip


def add_network_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of ports and swarm, and their file. A setting that several ports have is one option."""
    text = "YAML file of settings that all computers share, as `agents: 12`; options go before it"
    parser.add_argument("--swarm", metavar="FILE", dest="swarm_file", help=text)
    names: set[str] = set()
    for air in AIRS:
        group = parser.add_argument_group(f"what carries the frames: --air {air}")
        add_options(group, settings_class(air), "port", skip=names)
        names |= {setting.name for setting in settings_of(settings_class(air))}
    add_rows(parser.add_argument_group("authentication"), (
        ("--seal", "frames carry a code that only holders of the key can make; the key is in the environment: "
         "DTSA_AUTH_KEY [--seal]", {"action": argparse.BooleanOptionalAction}),
    ))  # fmt: skip
    swarm = parser.add_argument_group("the swarm: what all agents share")
    swarm.add_argument("--policy", metavar="NAME", help=f"policy: which agent sends next [{DEFAULT_POLICY}]")
    add_options(swarm, SwarmConfig, "swarm", skip=_NO_OPTION)


def read_network_options(args: argparse.Namespace) -> tuple[PortSettings, SwarmConfig]:
    """Settings of the port and of the swarm, by options and file; options go before the file."""
    _read_file(args)
    cls = settings_class(args.air)
    specs = {setting.name: setting for setting in settings_of(cls)}
    values = {dest.partition(".")[2]: value for dest, value in vars(args).items() if dest.startswith("port.")}
    port = cls.from_dict({
        name: specs[name].parse(value) if name in specs and isinstance(value, str) else value
        for name, value in values.items() if value is not None
    })  # fmt: skip
    named = {"policy": args.policy or DEFAULT_POLICY, "auth": args.seal is not False}
    config = SwarmConfig.from_dict({**option_values(args, SwarmConfig, "swarm"), **named})
    check_key(config)  # before anything is made
    check_session(config)
    return port, config


def _read_file(args: argparse.Namespace) -> None:
    """Settings of the file stand for options that were not given; an error names both."""
    path = args.swarm_file
    values = {} if path is None else _content(path)
    carriers = Setting("air", "text", None, "what carries the frames", choices=AIRS)
    air = values.pop("air", AIRS[0])
    args.air = args.air or carriers.check(air, f"air in {path}")
    sections: dict[str, type[Settings]] = {"swarm": SwarmConfig, "port": settings_class(args.air), "own": AgentSettings}
    settings = {setting.name: (name, setting) for name, cls in sections.items() for setting in settings_of(cls)}
    for name, value in values.items():
        if name == "id":
            raise ConfigError(f"id in {path}", value, "what all agents share; each has an --id of its own")
        if name not in settings:
            question = did_you_mean(str(name), settings)
            allowed = f"a setting of the swarm, of the port {args.air} or of the agent{question}"
            raise ConfigError(f"{name} in {path}", value, allowed)
        section, setting = settings[name]
        option = _OPTIONS.get(name, f"{section}.{name}")
        checked = value if setting.custom else setting.check(value, f"{name} in {path}")
        if getattr(args, option, None) is None:
            setattr(args, option, checked)


def _content(path: str) -> dict[str, Any]:
    try:
        content = read_yaml(path, "swarm")
    except ConfigError as error:
        field = error.field if error.field == "swarm" else f"{error.field} in {path}"
        raise ConfigError(field, error.value, error.allowed) from None
    for section in _ROS:
        if isinstance(content, Mapping) and section in content:
            content = content[section]
    return dict(names_with_values(content, f"swarm {path}"))


class AgentCommand(Command):
    description = """\
Flies one agent, with a simulated vehicle, whose frames go over a port (--air): one process a computer, no channel
node, no start signal, no ROS. The first agent begins; groups that meet become one. Frames are sealed: the key is in the
environment, DTSA_AUTH_KEY. See docs/how-to/several-computers.md."""
    examples = (
        ("--id 3 --interface eth0 --auth-session 41", "the third of twelve; the key is in DTSA_AUTH_KEY"),
        ("--id 1 --agents 4 --interface lo --no-seal --duration-s 10 --out runs/cf1", "ten seconds, with a bag"),
        ("--swarm swarm.yaml --id 3 --auth-session 40 --check", "before a flight: do all hear all"),
        ("--id 3 --air crazyradio --uri radio://0/80/2M --slot-ms 20 --auth-session 41", "by a Crazyradio 2.0"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.usage = "%(prog)s --id N (--interface NAME | --device PATH | --uri URI) [OPTIONS]"
        add_results(parser)
        own = parser.add_argument_group("this agent")
        add_options(own, AgentSettings, "own")
        text = "no flight: reports which agents hear each other in time; exit code 0: all hear all [until all know]"
        own.add_argument("--check", nargs="?", const="0", metavar="SECONDS", help=text)
        add_network_options(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Fly until Ctrl-C, and print what came of it."""
        from dtsa_bench.network.flying import check, fly

        port, config = read_network_options(args)
        own = AgentSettings.from_dict(option_values(args, AgentSettings, "own"))
        check_joinable(config.policy)  # before anything is made
        check_fits(config, port.properties)
        if args.check is not None:
            return check(own, config, port, number(args.check, "check", 0, 3600), args.json)
        return fly(own, config, port, args.out, args.json)


class SniffCommand(Command):
    description = """\
Listens to a swarm on a network or a radio without taking part, records what it hears, and judges it: two senders in a
slot, frames out of turn, turns given away twice or by others. Exit code 1 if a rule was broken. A listener may miss
frames: then a lease that it does not know looks like a broken rule."""
    examples = (
        ("--interface eth0 --auth-session 41 --out runs/sniffed", "twelve agents; until Ctrl-C"),
        ("--air crazyradio --uri radio://0/80/2M --slot-ms 20 --auth-session 41", "with a Crazyradio 2.0"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.usage = "%(prog)s (--interface NAME | --device PATH | --uri URI) [OPTIONS]"
        add_results(parser)
        parser.add_argument("--duration-s", metavar="X", default="0", help="for so long; 0: until Ctrl-C [0]")
        add_network_options(parser)

    def run(self, args: argparse.Namespace) -> int:
        """Listen until Ctrl-C, and print what came of it."""
        from dtsa_agent.stop import Stop
        from dtsa_bench.log.bag.errors import BagError
        from dtsa_bench.network.sniffer import Sniffer

        from .recordings import summary_lines

        port, config = read_network_options(args)
        duration = number(args.duration_s, "duration_s", 0, 1e6)
        directory = None if args.out is None else new_directory(args.out)
        path = None if directory is None else directory / "sniffed.mcap"

        with Stop() as stop, closing(Sniffer(config, port, path, warn)) as sniffer:
            sniffer.run(stop, duration)
        summary = sniffer.summary()
        text = json.dumps(summary, indent=2) + "\n"
        print(text if args.json else "\n".join(summary_lines(summary)) + "\n", end="")
        if directory is not None:
            (directory / "summary.json").write_text(text, encoding="utf-8")
        if sniffer.bag is not None and sniffer.bag.failure:
            raise BagError(sniffer.bag.failure)
        return 1 if summary["rules_broken"] else 0


class RelayCommand(Command):
    description = """\
Topics of any robots over the shared channel: /robot1/pose comes out as /robot2/from/robot1/pose, late, or not at all.
A YAML file names robots, topics, places and the channel. Ctrl-C ends it."""
    examples = (("examples/relay.yaml", "two talkers that lose every fifth message"),)
    options = (
        ("file", "YAML file: robots, topics, channel", {"type": Path}),
        ("--use-sim-time", "time is that of /clock"),
    )  # fmt: skip

    def run(self, args: argparse.Namespace) -> int:
        """Relay until Ctrl-C."""
        from dtsa_channel_sim.relay import node

        sim_time = f"use_sim_time:={str(args.use_sim_time).lower()}"
        return node.main(["relay", "--ros-args", "-p", f"config:={args.file.resolve()}", "-p", sim_time])
