"""`--swarm FILE`: settings that all computers of a swarm share, in the place of options."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

_ROS = "/**", "ros__parameters"  # of a file of ROS parameters, which counts as well
_AIR, _POLICY, _AUTH, _ID = "air", "policy", "auth", "id"


def add_swarm_file(group: Any) -> None:
    """Adds the option.

    :param group: parser, or group of its options.
    """
    group.add_argument(
        "--swarm",
        metavar="FILE",
        dest="swarm_file",
        help="YAML file of settings that all computers share, as `agents: 12`; options go before it",
    )


def take_swarm_file(args: argparse.Namespace, air: str) -> None:
    """Settings of the file stand for options that were not given.

    :param args: parsed options: ``air``, ``policy``, ``seal``, and those of swarm, port and agent.
    :param air: what carries the frames, where neither an option nor the file says it.
    :raises ConfigError: for a file that cannot be read, and for a setting that does not exist or cannot be; it names
        both.
    """
    from dtsa_agent.air.ports import AIRS, settings_class
    from dtsa_agent.air.settings import AgentSettings
    from dtsa_agent.core import SwarmConfig
    from dtsa_agent.core.errors import ConfigError
    from dtsa_agent.core.settings.declaration import Setting, settings_of

    from .spelling import hint

    values = {} if args.swarm_file is None else _read(args.swarm_file)
    where = f"in {args.swarm_file}"
    named = values.pop(_AIR, None)
    if named is not None:
        Setting(_AIR, "text", None, "what carries the frames", words=AIRS).check(named, f"{_AIR} {where}")
    args.air = args.air or named or air
    ports = [args.air] if args.air in AIRS else list(AIRS)
    sections = [("swarm", SwarmConfig), *(("port", settings_class(port)) for port in ports), ("own", AgentSettings)]
    known = {setting.name: (section, setting) for section, cls in sections for setting in settings_of(cls)}
    if _ID in values:
        raise ConfigError(f"{_ID} {where}", values[_ID], "what all agents share; each has an --id of its own")
    for name, value in values.items():
        if name not in known:
            allowed = f"a setting of the swarm, of the port {args.air} or of the agent{hint(str(name), known)}"
            raise ConfigError(f"{name} {where}", value, allowed)
        section, setting = known[name]
        checked = value if setting.custom else setting.check(value, f"{name} {where}")
        option = {_POLICY: _POLICY, _AUTH: "seal"}.get(name, f"{section}.{name}")
        if getattr(args, option, None) is None:
            setattr(args, option, checked)


def _read(path: str) -> dict[str, Any]:
    from dtsa_agent.core.errors import ConfigError
    from dtsa_agent.core.settings.declaration import names_with_values
    from dtsa_agent.yaml_file import read_yaml

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
