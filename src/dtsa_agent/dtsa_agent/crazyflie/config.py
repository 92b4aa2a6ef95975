"""The swarm's YAML: robots, their types, and what holds for all. A robot's value beats its type's, which beats `all`.

robots:
  cf1: {uri: radio://0/80/2M/E7E7E7E701, initial_position: [1.2, 0.0, 0.0], type: cf21}
robot_types:
  cf21: {battery: {voltage_warning: 3.4, voltage_critical: 3.2}}
all:
  firmware_params: {stabilizer: {estimator: 2}}
station:
  min_connected: 10
  safety: {geofence_max: [1.5, 2.3, 0.95]}
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings import check, named, setting
from dtsa_agent.crazyflie.budget import radio_of
from dtsa_agent.crazyflie.safety import SafetySettings
from dtsa_agent.crazyflie.units import Vector

NAME = re.compile(r"^[A-Za-z][A-Za-z0-9_]*?(\d+)$")
SECTIONS = ("fileversion", "robots", "robot_types", "all", "station")
# Keys that Crazyswarm2's files have and that mean nothing here: its files can be used as they are.
IGNORED = frozenset({"motion_capture", "big_quad", "firmware_logging", "reference_frame", "broadcasts", "marker"})


@dataclass(frozen=True, slots=True)
class RobotSettings:
    """One Crazyflie.

    :raises ConfigError: a value is out of range.
    """

    name: str
    uri: str
    id: int = setting(0, "the agent's id: the digits that end its name", minimum=1, maximum=65534)
    enabled: bool = True
    type: str = ""
    initial_position: Vector = (0.0, 0.0, 0.0)  # m, world
    command_rate_hz: float = setting(50.0, "rate of the streamed commands", unit="Hz", minimum=1, maximum=100)
    log_rate_hz: float = setting(50.0, "rate of the state log", unit="Hz", minimum=4, maximum=100)
    connect_timeout_s: float = setting(20.0, "time for one attempt to connect", unit="s", minimum=0.2, maximum=300)
    connect_attempts: int = setting(3, "attempts to connect", minimum=1, maximum=100)
    estimator_timeout_s: float = setting(10.0, "time for the estimator to settle", unit="s", minimum=0.1, maximum=300)
    reset_estimator: bool = True
    battery_warning_v: float = setting(3.4, "warning below this voltage", unit="V", minimum=2.0, maximum=5.0)
    battery_critical_v: float = setting(3.2, "landing below this voltage", unit="V", minimum=2.0, maximum=5.0)
    firmware_params: Mapping[str, float] = dataclasses.field(default_factory=dict)  # group.name -> value

    def __post_init__(self) -> None:
        try:
            check(self)
            radio_of(self.uri)
        except ConfigError as error:
            raise ConfigError(f"robots.{self.name}.{error.field}", error.value, error.allowed) from None
        if self.battery_critical_v > self.battery_warning_v:
            raise ConfigError(
                f"robots.{self.name}.battery.voltage_critical",
                self.battery_critical_v,
                f"at most voltage_warning, {self.battery_warning_v} V",
            )


@dataclass(frozen=True, slots=True)
class StationSettings:
    """The ground station.

    :raises ConfigError: a value is out of range.
    """

    min_connected: int = setting(1, "fewer connected Crazyflies than this: nobody flies", minimum=1, maximum=1000)
    room_origin_in_world: Vector = (0.0, 0.0, 0.95)  # m: where the Crazyflies' world sees the origin of `map`
    force_budget: bool = False  # fly even if the radios cannot carry it
    toc_cache: str = ""  # folder of the variables' tables; empty: ~/.cache/dtsa/crazyflie
    land_speed_mps: float = setting(0.4, "mean speed of a landing", unit="m/s", minimum=0.05, maximum=2)
    max_speed_mps: float = setting(
        1.2, "largest speed on the way of a take-off, a go_to or a landing", unit="m/s", minimum=0.1, maximum=10
    )
    landing_timeout_s: float = setting(20.0, "longest wait for all to land", unit="s", minimum=1, maximum=300)
    priority: int = setting(
        20, "real-time priority of bridge, agents and ground station, where allowed; 0: none", minimum=0, maximum=90
    )
    safety: SafetySettings = dataclasses.field(default_factory=SafetySettings)

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True, slots=True)
class SwarmSettings:
    """Everything in the swarm's YAML."""

    robots: tuple[RobotSettings, ...]  # the enabled ones, by id
    station: StationSettings


def load_swarm(path: Path) -> SwarmSettings:
    """Read and check a swarm's YAML.

    :raises ConfigError: the file cannot be read, or something in it is not usable.
    """
    import yaml

    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError("config", str(path), f"a file that can be read ({error.strerror})") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = getattr(error, "problem_mark", None)
        line = f", line {where.line + 1}" if where is not None else ""
        raise ConfigError("config", str(path), f"a YAML file{line}") from error
    return parse_swarm(data)


def parse_swarm(data: object) -> SwarmSettings:
    """Settings from the contents of a swarm's YAML.

    :raises ConfigError: something in it is not usable.
    """
    top = _mapping("config", data)
    _known("config", top, SECTIONS)
    types = _mapping("robot_types", top.get("robot_types"))
    common = _mapping("all", top.get("all"))
    robots = []
    for name, own in _mapping("robots", top.get("robots")).items():
        robots.append(_robot(str(name), _mapping(f"robots.{name}", own), types, common))
    robots = sorted((r for r in robots if r.enabled), key=lambda r: r.id)
    if not robots:
        raise ConfigError("robots", [], "at least one robot that is enabled")
    numbers: dict[int, str] = {}
    uris: dict[str, str] = {}
    for robot in robots:
        link = robot.uri.partition("?")[0]
        if link in uris:
            raise ConfigError(f"robots.{robot.name}.uri", robot.uri, f"a URI of its own ({uris[link]} has it)")
        uris[link] = robot.name
        if robot.id in numbers:
            raise ConfigError(f"robots.{robot.name}", robot.id, f"a number of its own ({numbers[robot.id]} has it)")
        numbers[robot.id] = robot.name
    station = _station(_mapping("station", top.get("station")))
    if station.min_connected > len(robots):
        raise ConfigError("station.min_connected", station.min_connected, f"1 to {len(robots)}, the enabled robots")
    return SwarmSettings(tuple(robots), station)


def _mapping(field: str, value: object) -> dict[str, Any]:
    if value is None:
        return {}
    if not isinstance(value, dict):
        raise ConfigError(field, value, "a mapping of names to values")
    return value


def _known(field: str, values: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in values:
        if key not in known and key not in IGNORED:
            raise ConfigError(f"{field}.{key}", values[key], "one of " + ", ".join(known))


def _merge(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
    """Nested mappings, `high` beats `low`."""
    result = dict(low)
    for key, value in high.items():
        both = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if both else value
    return result


_DERIVED = ("name", "id", "battery_warning_v", "battery_critical_v")
ROBOT_KEYS = (*(f.name for f in dataclasses.fields(RobotSettings) if f.name not in _DERIVED), "battery")


def _robot(name: str, own: dict[str, Any], types: dict[str, Any], common: dict[str, Any]) -> RobotSettings:
    field = f"robots.{name}"
    match = NAME.match(name)
    if match is None:
        raise ConfigError("robots", name, "names such as cf3: letters, then the agent's number")
    kind = own.get("type", "")
    if kind and kind not in types:
        raise ConfigError(
            f"{field}.type", kind, "one of robot_types: " + (", ".join(map(str, types)) or "(there are none)")
        )
    merged = _merge(_merge(common, _mapping(f"robot_types.{kind}", types.get(kind))), own)
    _known(field, merged, ROBOT_KEYS)
    if "uri" not in merged:
        raise ConfigError(f"{field}.uri", None, "the Crazyflie's address, such as radio://0/80/2M/E7E7E7E701")
    values = {key: value for key, value in merged.items() if key in ROBOT_KEYS}
    battery = _mapping(f"{field}.battery", values.pop("battery", None))
    _known(f"{field}.battery", battery, ("voltage_warning", "voltage_critical"))
    for key, field_name in (("voltage_warning", "battery_warning_v"), ("voltage_critical", "battery_critical_v")):
        if key in battery:
            values[field_name] = battery[key]
    for key in ("enabled", "reset_estimator"):
        if key in values and not isinstance(values[key], bool):
            raise ConfigError(f"{field}.{key}", values[key], "true or false")
    if "initial_position" in values:
        values["initial_position"] = _vector(f"{field}.initial_position", values["initial_position"])
    params = _mapping(f"{field}.firmware_params", values.pop("firmware_params", None))
    values["uri"] = str(values["uri"])
    return RobotSettings(name=name, id=int(match[1]), firmware_params=_params(field, params), **values)


def _params(field: str, groups: Mapping[str, Any]) -> dict[str, float]:
    result: dict[str, float] = {}
    for group, names in groups.items():
        for name, value in _mapping(f"{field}.firmware_params.{group}", names).items():
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ConfigError(f"{field}.firmware_params.{group}.{name}", value, "a number")
            result[f"{group}.{name}"] = value
    return result


def _vector(field: str, value: object) -> Vector:
    if not isinstance(value, (list, tuple)) or len(value) != 3:
        raise ConfigError(field, value, "three numbers: x, y, z in m")
    for v in value:
        if isinstance(v, bool) or not isinstance(v, (int, float)):
            raise ConfigError(field, value, "three numbers: x, y, z in m")
    return float(value[0]), float(value[1]), float(value[2])


STATION_KEYS = tuple(f.name for f in dataclasses.fields(StationSettings))
SAFETY_KEYS = tuple(f.name for f in dataclasses.fields(SafetySettings))


def _station(values: dict[str, Any]) -> StationSettings:
    _known("station", values, STATION_KEYS)
    values = dict(values)
    safety = _mapping("station.safety", values.pop("safety", None))
    _known("station.safety", safety, SAFETY_KEYS)
    if "room_origin_in_world" in values:
        values["room_origin_in_world"] = _vector("station.room_origin_in_world", values["room_origin_in_world"])
    if not isinstance(values.get("force_budget", False), bool):
        raise ConfigError("station.force_budget", values["force_budget"], "true or false")
    with named("station.safety"):
        rules = SafetySettings(**safety)
    return StationSettings(safety=rules, **values)
