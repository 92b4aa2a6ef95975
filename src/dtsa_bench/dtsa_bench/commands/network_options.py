"""Options of agents, and of those that listen to them, on a network: what carries the frames, and what all share.

With `--swarm FILE` the settings that all computers of a swarm share stand in a YAML file in the place of options.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from dtsa_agent.air.port import AIRS, PortSettings, settings_class
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting, Settings, names_with_values, settings_of
from dtsa_agent.keys import check_key, check_session
from dtsa_agent.yaml_file import read_yaml
from dtsa_bench.runs.options import add_options, given_options

from .registry import hint

DEFAULT_POLICY = "lease"
_NO_OPTION = ("policy", "auth", *(s.name for s in settings_of(SwarmConfig) if s.group == "Priority and selection"))
_ROS = "/**", "ros__parameters"  # of a file of ROS parameters, which counts as well
_OPTIONS = {"policy": "policy", "auth": "seal"}  # settings whose options are called otherwise


def add_results(parser: argparse.ArgumentParser) -> None:
    """Adds what carries the frames, and where the results go."""
    parser.add_argument("--air", choices=AIRS, help=f"what carries the frames [{AIRS[0]}]")
    parser.add_argument("--out", metavar="DIR", help="directory for its bag and summary.json; default: only printed")
    parser.add_argument("--json", action="store_true", help="print summary.json instead of lines")


def add_network_options(parser: argparse.ArgumentParser) -> None:
    """Adds the options of ports and swarm, and their file. A setting that several ports have is one option."""
    parser.add_argument(
        "--swarm",
        metavar="FILE",
        dest="swarm_file",
        help="YAML file of settings that all computers share, as `agents: 12`; options go before it",
    )
    known: set[str] = set()
    for air in AIRS:
        group = parser.add_argument_group(f"what carries the frames: --air {air}")
        add_options(group, settings_class(air), "port", skip=known)
        known |= {setting.name for setting in settings_of(settings_class(air))}
    parser.add_argument_group("authentication").add_argument(
        "--seal",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="frames carry a code that only holders of the key can make; the key is in the environment: DTSA_AUTH_KEY "
        "[--seal]",
    )
    swarm = parser.add_argument_group("the swarm: what all agents share")
    swarm.add_argument("--policy", metavar="NAME", help=f"who sends next [{DEFAULT_POLICY}]")
    add_options(swarm, SwarmConfig, "swarm", skip=_NO_OPTION)


def read_network_options(args: argparse.Namespace) -> tuple[PortSettings, SwarmConfig]:
    """What carries the frames, and what all agents share, as options and file say; options go before the file.

    :raises ConfigError: for a setting that does not exist or cannot be, or a missing key or session.
    """
    _read_file(args)
    cls = settings_class(args.air)
    specs = {setting.name: setting for setting in settings_of(cls)}
    values = {dest.partition(".")[2]: value for dest, value in vars(args).items() if dest.startswith("port.")}
    port = cls.from_dict({
        name: specs[name].parse(value) if name in specs and isinstance(value, str) else value
        for name, value in values.items() if value is not None
    })  # fmt: skip
    named = {"policy": args.policy or DEFAULT_POLICY, "auth": args.seal is not False}
    config = SwarmConfig.from_dict({**given_options(args, SwarmConfig, "swarm"), **named})
    check_key(config)  # before anything is made
    check_session(config)
    return port, config


def _read_file(args: argparse.Namespace) -> None:
    """Settings of the file stand for options that were not given; an error names both."""
    path = args.swarm_file
    values = {} if path is None else _content(path)
    air = values.pop("air", AIRS[0])
    args.air = args.air or Setting("air", "text", None, "what carries the frames", words=AIRS).check(
        air, f"air in {path}"
    )
    sections: dict[str, type[Settings]] = {"swarm": SwarmConfig, "port": settings_class(args.air), "own": AgentSettings}
    known = {setting.name: (name, setting) for name, cls in sections.items() for setting in settings_of(cls)}
    for name, value in values.items():
        if name == "id":
            raise ConfigError(f"id in {path}", value, "what all agents share; each has an --id of its own")
        if name not in known:
            allowed = f"a setting of the swarm, of the port {args.air} or of the agent{hint(str(name), known)}"
            raise ConfigError(f"{name} in {path}", value, allowed)
        section, setting = known[name]
        option = _OPTIONS.get(name, f"{section}.{name}")
        checked = value if setting.custom else setting.check(value, f"{name} in {path}")
        if getattr(args, option, None) is None:
            setattr(args, option, checked)


def _content(path: str) -> dict[str, Any]:
    try:
        content = read_yaml(path, "swarm")
    except ConfigError as error:
        if error.field == "swarm":
            raise
        raise ConfigError(f"{error.field} in {path}", error.value, error.allowed) from None
    for section in _ROS:
        if isinstance(content, Mapping) and section in content:
            content = content[section]
    return dict(names_with_values(content, f"swarm {path}"))
