"""Tables of pages that are made while the site is built: a page has ``<!-- table: NAME -->`` in their place.

NAME is one of :data:`TABLES`, or ``evidence NAME`` for the rows of the record ``docs/evidence/NAME.json``.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from dtsa_agent.air.serial_modems import FRAMING, MODEMS, NONE
from dtsa_agent.air.settings import AgentSettings, CrazyradioSettings, SerialSettings, UdpSettings
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import Setting, Settings, settings_of
from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS, KINDS, AvoiderParams, FlightModel, VehicleParams
from dtsa_agent.crazyflie.onboard import OnboardSettings
from dtsa_agent.crazyflie.positions import PositionSettings
from dtsa_agent.crazyflie.safety import SafetySettings
from dtsa_agent.crazyflie.settings import BatterySettings, GroundStationSettings, RobotSettings
from dtsa_bench.runs.config import RunConfig, RunLimits
from dtsa_channel_sim import ChannelConfig, ClockConfig
from dtsa_channel_sim.relay.transport import MessageChannel
from dtsa_dev.records import EVIDENCE, read_record

from . import table

_ROOT = Path(__file__).resolve().parents[3]
_LENGTH = 60 + FRAMING  # bytes of a sealed frame of `lease` on a modem's line
_PLACE = re.compile(r"^<!-- table: (?P<name>[^>]*?) -->$", re.MULTILINE)
NODES = ("agent", "agent, real time", "swarm_host", "crazyflie_agents", "channel", "recorded_channel")


def filled(text: str) -> str:
    """A page with its tables."""

    def fill(place: re.Match[str]) -> str:
        name = place["name"]
        if name.startswith("evidence "):
            return evidence(name.removeprefix("evidence "))
        if name not in TABLES:
            raise ConfigError("table", name, ", ".join(TABLES))
        return _table_of(name)

    return _PLACE.sub(fill, text)


@cache  # `docs --serve` builds the site again and again
def _table_of(name: str) -> str:
    return TABLES[name]()


def settings_table(cls: type[Settings], groups: Iterable[str] = (), skip: Sequence[str] = ()) -> str:
    """The settings of a class, a row each; those that may change in flight are marked with a star.

    `groups` limits them to these headings.
    """
    wanted = set(groups)
    rows = [
        (f"`{s.name}`{' *' if s.changeable else ''}", _default(s), _unit(s), _allowed(s), s.help)
        for s in settings_of(cls)
        if s.name not in skip and (not wanted or s.group in wanted)
    ]
    return table(("setting", "default", "unit", "allowed", "meaning"), rows)


def _grouped(cls: type[Settings]) -> str:
    """The settings of a class, a table under each of their headings."""
    groups = dict.fromkeys(spec.group for spec in settings_of(cls))
    return "\n".join(f"**{group}**\n\n{settings_table(cls, [group])}" for group in groups)


def _model_values(kind: str) -> str:
    """The values of all flight models with one avoider."""
    models = [model for model in FLIGHT_MODELS.values() if model.avoider_kind == kind]
    rows = []
    for cls, part in ((AvoiderParams, "avoider"), (VehicleParams, "vehicle"), (FlightModel, "")):
        for spec in settings_of(cls):
            others = [other for other in KINDS if f"{other}: " in spec.help]
            if spec.kind == "float" and (not others or kind in others):
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


def _modems() -> str:
    def ms(time_ns: float) -> str:
        return f"{time_ns / 1e6:.1f} ms" if time_ns else ""

    rows = []
    sources: dict[str, list[str]] = {}
    for name, modem in MODEMS.items():
        if name != NONE:
            times = [ms(time_ns) for time_ns in (modem.on_air_ns(_LENGTH), modem.turn_round_ns, modem.turn_ns)]
            sizes = f"{modem.packet}, {modem.buffer} bytes"
            rows.append((f"`{name}`", modem.text, *times, sizes, f"{modem.baud} baud"))
            sources.setdefault(modem.source, []).append(f"`{name}`")
    head = ("`--modem`", "modem", f"{_LENGTH} bytes on the air", "until it sends", "an empty turn",
            "longest packet, buffer", "line")  # fmt: skip
    listed = "".join(f"- {', '.join(names)}: {source}.\n" for source, names in sources.items())
    return f"{table(head, rows)}\nSources:\n\n{listed}"


def _vehicle() -> str:
    from dtsa_agent.ros.odometry_vehicle import VehicleSettings  # needs ROS

    return settings_table(VehicleSettings)


def _radios() -> str:
    from .radios import radio_table  # flies

    return radio_table()


def _node(name: str) -> str:
    from .nodes import node_tables  # needs ROS

    return node_tables(name)


def _faults() -> str:
    """The faults that `soak faults` makes happen, and the reactions."""
    places = [str(_ROOT / place) for place in ("src/dtsa_agent/test", "src/dtsa_bench/test", "tools/test")]
    sys.path[:0] = [place for place in places if place not in sys.path]
    from faults import FAULTS

    rows = [
        (number, fault.what, fault.reaction, "tests and soak" if fault.sample else "soak")
        for number, fault in enumerate(FAULTS, 1)
    ]
    return table(("", "fault", "reaction", "run by"), rows)


def evidence(name: str) -> str:
    """The rows of a record, and what it was made with."""
    if not (EVIDENCE / f"{name}.json").exists():
        return "No record is kept yet.\n"
    record = read_record(name)
    low, high = record.get("load", [0.0, 0.0])
    passed = f"{record['passed']} passed in {record['minutes']:.0f} minutes, " if "passed" in record else ""
    sizes = f"{record['sizes']}. " if "sizes" in record else ""
    source = (
        f"`tools/dtsa {record['command']}`, {record['date']}: {passed}{record['cores']} cores, {record['versions']}"
    )
    loaded = f", load {low:g} to {high:g}" if "load" in record else ""
    rows = f"{table(record['heads'], record['rows'])}\n" if record["rows"] else ""
    return f"{rows}{sizes}{source}{loaded} ([record]({name}.json)).\n"


def _records() -> str:
    """All records: what each holds, and the command that makes it again."""
    rows = []
    for path in sorted(EVIDENCE.glob("*.json")):
        record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if "command" in record:
            promise = record.get("promise", "what it costs")
            cells = (promise, record.get("passed", ""), record["date"], f"`{record['code']}`")
            rows.append((f"[{path.stem}]({path.name})", f"`tools/dtsa {record['command']}`", *cells))
    return table(("record", "command", "promise", "passed", "date", "digest of the code"), rows)


def _league() -> str:
    """The tables of league 1: all scores, ages by cell, and what each entry sets."""
    from dtsa_bench.experiments.league import HEADS, LeagueTable, league, read_entries

    scores = LeagueTable(league(), read_entries(EVIDENCE / "league-1.json"))
    flown = [
        (
            entry["name"],
            ", ".join(f"`{key}: {value}`" for key, value in entry["scheme"].items()),
            *(entry[key] for key in ("package", "commit", "date")),
        )
        for entry in scores.entries
    ]
    flights = sum(score.lost.total for score in scores.scores)
    return "\n".join([
        f"{len(flown)} entries, {flights:,} flights ([all of them](league-1.json)). 95 % intervals in brackets.\n",
        table(HEADS, scores.lines()),
        "Age in each cell, ms; in brackets the lost flights, if any:\n",
        table(("scheme", *scores.cells), scores.cell_lines()),
        table(("cell", "meaning"), [[name, cell["text"]] for name, cell in scores.league.cells.items()]),
        table(("entry", "sets", "package", "commit", "flown"), flown),
    ])  # fmt: skip


#: Tables that a page may ask for, and their makers.
TABLES: dict[str, Callable[[], str]] = {
    "SwarmConfig": partial(_grouped, SwarmConfig),
    "SwarmConfig, leases": partial(settings_table, SwarmConfig, ["Frames and leases"]),
    "ChannelConfig": partial(settings_table, ChannelConfig),
    "MessageChannel": partial(settings_table, MessageChannel, ["Access"]),
    "RunLimits": partial(settings_table, RunLimits),
    "RunConfig": partial(settings_table, RunConfig),
    "ClockConfig": partial(settings_table, ClockConfig),
    **{f"flight models, {kind}": partial(_model_values, kind) for kind in KINDS},
    "AgentSettings": partial(settings_table, AgentSettings),
    "VehicleSettings": _vehicle,
    "UdpSettings": partial(settings_table, UdpSettings),
    "CrazyradioSettings": partial(settings_table, CrazyradioSettings),
    "SerialSettings": partial(settings_table, SerialSettings),
    "modems": _modems,
    "robots": partial(settings_table, RobotSettings, skip=("name", "id")),
    "battery": partial(settings_table, BatterySettings),
    "station": partial(settings_table, GroundStationSettings),
    "positions": partial(settings_table, PositionSettings),
    "on_board": partial(settings_table, OnboardSettings),
    "safety": partial(settings_table, SafetySettings),
    "radios": _radios,
    "faults": _faults,
    "records": _records,
    "league-1": _league,
    **{f"node {name}": partial(_node, name) for name in NODES},
}
