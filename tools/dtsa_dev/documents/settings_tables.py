"""The tables of settings in the documentation, made from the code.

A table stands between ``<!-- settings: NAME -->`` and ``<!-- end -->``; NAME is one of :data:`TABLES`. The command
``python -m dtsa_dev.documents.settings_tables docs/*/*.md`` rewrites all tables of these files.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path

from dtsa_agent.air.crazyradio.settings import CrazyradioSettings
from dtsa_agent.air.serial.lengths import FRAMING
from dtsa_agent.air.serial.modems import MODEMS, NONE
from dtsa_agent.air.serial.settings import SerialSettings
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.air.udp.settings import UdpSettings
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import Setting, Settings, settings_of
from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS, KINDS, AvoiderParams, FlightModel, VehicleParams
from dtsa_agent.crazyflie.positions.motion_capture import PositionSettings
from dtsa_agent.crazyflie.safety.rules import SafetySettings
from dtsa_agent.crazyflie.settings.config import BatterySettings, RobotSettings, StationSettings
from dtsa_agent.crazyflie.settings.on_board import OnBoardSettings
from dtsa_bench.runs.config import RunConfig, RunLimits
from dtsa_channel_sim import ChannelConfig, ClockConfig

from .markdown import table

_LENGTH = 60 + FRAMING  # bytes of a sealed frame of `lease` on a modem's line
NODES = ("agent", "agent, real time", "swarm_host", "crazyflie_agents", "channel", "recorded_channel")
_BLOCK = re.compile(r"(<!-- settings: (?P<name>[^>]*?) -->\n).*?(<!-- end -->)", re.DOTALL)
_HEAD = ("setting", "default", "unit", "allowed", "meaning")


def rewritten(text: str) -> str:
    """A page with its tables made again.

    :param text: the page, Markdown.
    :raises ConfigError: if a table has a name that is none of :data:`TABLES`.
    """

    def renewed(found: re.Match[str]) -> str:
        name = found["name"]
        if name not in TABLES:
            raise ConfigError("settings", name, ", ".join(TABLES))
        return f"{found[1]}{TABLES[name]()}{found[3]}"

    return _BLOCK.sub(renewed, text)


def settings_table(cls: type[Settings], groups: Iterable[str] = (), skip: Sequence[str] = ()) -> str:
    """The settings of a class, a row each; what may change in flight is marked with a star.

    :param cls: the settings class.
    :param groups: only settings with these headings; empty: all.
    :param skip: settings that are left out.
    """
    wanted = set(groups)
    rows = [
        (f"`{s.name}`{' *' if s.changeable else ''}", _default(s), _unit(s), _allowed(s), s.help)
        for s in settings_of(cls)
        if s.name not in skip and (not wanted or s.group in wanted)
    ]
    return table(_HEAD, rows)


def grouped_tables(cls: type[Settings]) -> str:
    """The settings of a class, a table under each of their headings.

    :param cls: the settings class.
    """
    groups = list(dict.fromkeys(spec.group for spec in settings_of(cls)))
    return "\n".join(f"**{group}**\n\n{settings_table(cls, [group])}" for group in groups)


def model_values(kind: str) -> str:
    """The values of all flight models with one avoider.

    :param kind: name of the avoider.
    """
    models = [model for model in FLIGHT_MODELS.values() if model.avoider_kind == kind]
    rows = []
    for cls, part in ((AvoiderParams, "avoider"), (VehicleParams, "vehicle"), (FlightModel, "")):
        for spec in settings_of(cls):
            others = [other for other in KINDS if f"{other}: " in spec.help]
            if spec.kind != "float" or (others and kind not in others):
                continue
            owners = [getattr(model, part) if part else model for model in models]
            values = [f"{getattr(owner, spec.name):g}" for owner in owners]
            rows.append((f"`{spec.name}`", *values, _unit(spec), _allowed(spec), spec.help))
    return table(("value", *(f"`{model.name}`" for model in models), "unit", "allowed", "meaning"), rows)


def _default(spec: Setting) -> str:
    value = spec.default
    if spec.required:
        return "required"
    if spec.section is not None or value is None or value == "" or (spec.kind != "vector" and value in ({}, ())):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(f"{part:g}" for part in value)
    return _number(value) if isinstance(value, (int, float)) else str(value)


def _number(value: float) -> str:
    """A number with its thousands apart, as 10 000 000."""
    if value == 2**63 - 1:
        return "2^63 - 1"
    return f"{int(value):,}".replace(",", " ") if abs(value) >= 1e4 and value == int(value) else f"{value:g}"


def _unit(spec: Setting) -> str:
    return "" if spec.unit == "1" else spec.unit


def _allowed(spec: Setting) -> str:
    if spec.choices:
        return ", ".join(f"`{choice}`" for choice in spec.choices) + (", plug-ins" if spec.open_choices else "")
    if spec.kind not in ("int", "float"):
        return {"bool": "true, false", "vector": "x, y, z", "values": "name=number, ..."}.get(spec.kind, "")
    low, high = ("" if bound is None else _number(bound) for bound in (spec.minimum, spec.maximum))
    return f"{low} to {high}"


def _node(name: str) -> str:
    from .node_tables import node_tables  # needs ROS

    return node_tables(name)


def _vehicle() -> str:
    from dtsa_agent.ros.odometry_vehicle import VehicleSettings  # needs ROS, too

    return settings_table(VehicleSettings)


def _radios() -> str:
    from .radio_table import radio_table  # flies

    return radio_table()


def _modems() -> str:
    head = (
        "`--modem`",
        "what",
        "73 bytes on the air",
        "until it sends",
        "an empty turn",
        "longest packet, buffer",
        "line",
    )
    rows = [
        (
            f"`{name}`",
            modem.text,
            f"{modem.on_air_ns(_LENGTH) / 1e6:.1f} ms",
            f"{modem.turn_round_ns / 1e6:.1f} ms" if modem.turn_round_ns else "",
            f"{modem.turn_ns / 1e6:.1f} ms" if modem.turn_ns else "",
            f"{modem.packet}, {modem.buffer} bytes",
            f"{modem.baud} baud",
        )
        for name, modem in MODEMS.items()
        if name != NONE
    ]
    sources: dict[str, list[str]] = {}
    for name, modem in MODEMS.items():
        sources.setdefault(modem.source, []).append(f"`{name}`")
    del sources[MODEMS[NONE].source]
    return (
        table(head, rows)
        + "\nSources:\n\n"
        + "".join(f"- {', '.join(names)}: {source}.\n" for source, names in sources.items())
    )


#: What a page may ask for, and what makes it.
TABLES: dict[str, Callable[[], str]] = {
    "SwarmConfig": partial(grouped_tables, SwarmConfig),
    "SwarmConfig, leases": partial(settings_table, SwarmConfig, ["Frames and leases"]),
    "ChannelConfig": partial(settings_table, ChannelConfig),
    "RunLimits": partial(settings_table, RunLimits),
    "RunConfig": partial(settings_table, RunConfig),
    "ClockConfig": partial(settings_table, ClockConfig),
    **{f"flight models, {kind}": partial(model_values, kind) for kind in KINDS},
    "AgentSettings": partial(settings_table, AgentSettings),
    "VehicleSettings": _vehicle,
    "UdpSettings": partial(settings_table, UdpSettings),
    "CrazyradioSettings": partial(settings_table, CrazyradioSettings),
    "SerialSettings": partial(settings_table, SerialSettings),
    "modems": _modems,
    "robots": partial(settings_table, RobotSettings, skip=("name", "id")),
    "battery": partial(settings_table, BatterySettings),
    "station": partial(settings_table, StationSettings),
    "positions": partial(settings_table, PositionSettings),
    "on_board": partial(settings_table, OnBoardSettings),
    "safety": partial(settings_table, SafetySettings),
    "radios": _radios,
    **{f"node {name}": partial(_node, name) for name in NODES},
}


def main(paths: Sequence[str]) -> int:
    """Rewrites the tables of some pages.

    :param paths: the pages.
    :returns: 0; 2 if a page cannot be used.
    """
    try:
        for path in map(Path, paths):
            old = path.read_text(encoding="utf-8")
            new = rewritten(old)
            if new != old:
                path.write_text(new, encoding="utf-8")
                print(path)
    except (ConfigError, OSError) as error:
        print(f"settings_tables: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
