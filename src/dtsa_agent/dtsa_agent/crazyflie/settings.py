"""The swarm's YAML: robots, robot types, common values. A robot's value overrides its type's, which overrides `all`.

robots:
  cf1: {uri: radio://0/80/2M/E7E7E7E701, initial_position: [1.2, 0.0, 0.0], type: cf21}
robot_types:
  cf21: {battery: {flight_warning: 3.4, flight_landing: 3.2}}
all:
  firmware_params: {stabilizer: {estimator: 2}}
station:
  min_connected: 10
  safety: {geofence_max: [1.5, 2.3, 0.95]}
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, check, named, nested, setting, settings_of
from dtsa_agent.core.settings.scenario import make_scenario
from dtsa_agent.yaml_file import read_yaml

from .addresses import Address, RadioLoad, check_distinct, parse_address, radio_loads
from .onboard import OnboardSettings, check_onboard_swarm
from .positions import NONE, PositionSettings
from .safety import SafetySettings
from .state import Vector

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
TRAILING_NUMBER = re.compile(r"\d+$")
MAX_START_OFFSET_M = 0.25  # of a vehicle from its initial_position, and of that from where an agent on board starts
SECTIONS = ("fileversion", "robots", "robot_types", "all", "station")


@dataclass(frozen=True, slots=True)
class BatterySettings(Settings):
    """Voltage limits of a battery: two on the ground, as in Crazyswarm2, and two in flight."""

    voltage_warning: float = setting(3.4, "on the ground: warning below this", unit="V", minimum=2.0, maximum=5.0)
    voltage_critical: float = setting(3.2, "on the ground: no take-off below this", unit="V", minimum=2.0, maximum=5.0)
    flight_warning: float = setting(3.4, "in flight: warning below this", unit="V", minimum=2.0, maximum=5.0)
    flight_landing: float = setting(3.2, "in flight: landing below this", unit="V", minimum=2.0, maximum=5.0)

    def __post_init__(self) -> None:
        check(self)
        for low, high in (("voltage_critical", "voltage_warning"), ("flight_landing", "flight_warning")):
            if getattr(self, low) > getattr(self, high):
                raise ConfigError(low, getattr(self, low), f"at most {high}, {getattr(self, high)} V")


BATTERY_KEYS = frozenset(spec.name for spec in settings_of(BatterySettings))


@dataclass(frozen=True, slots=True)
class RobotSettings(Settings):
    """One Crazyflie."""

    name: str = setting(REQUIRED, "key of the robot")
    id: int = setting(
        REQUIRED, "the agent's id; left out: the numbers that end all names, if they are 1 to N, else the file's order",
        minimum=1, maximum=65534,
    )  # fmt: skip
    uri: str = setting(REQUIRED, "the Crazyflie's address, such as radio://0/80/2M/E7E7E7E701", custom=True)
    enabled: bool = setting(True, "false: it takes no part")
    type: str = setting("", "one of robot_types; the robot takes over its values")
    group_mask: int = setting(
        0, "groups that it belongs to, a bit each: services with a group_mask reach those that share a bit with it",
        minimum=0, maximum=255,
    )  # fmt: skip
    initial_position: Vector = setting(
        (0.0, 0.0, 0.0), "place at the start, in the Crazyflies' own world (z = 0 is the floor)", unit="m"
    )
    command_rate_hz: float = setting(50.0, "rate of the streamed commands", unit="Hz", minimum=1, maximum=100)
    log_rate_hz: float = setting(50.0, "rate of the state log", unit="Hz", minimum=4, maximum=100)
    connect_timeout_s: float = setting(
        20.0, "time for one attempt to connect; a first connection over the air reads the tables of variables",
        unit="s", minimum=0.2, maximum=300,
    )  # fmt: skip
    connect_attempts: int = setting(
        3, "attempts to connect; before the first one counts, a closed UDP port is asked for up to 10 s",
        minimum=1, maximum=100,
    )  # fmt: skip
    estimator_timeout_s: float = setting(10.0, "time for the estimator to settle", unit="s", minimum=0.1, maximum=300)
    estimator_variance_m2: float = setting(
        0.01, "largest variance of a settled estimator without motion capture; a Flow deck alone, which knows no "
        "place, stays at 100", unit="m²", minimum=1e-6, maximum=1000,
    )  # fmt: skip
    reset_estimator: bool = setting(True, "restart the Kalman filter and wait until it has settled")
    battery: BatterySettings = nested(BatterySettings, "voltages in flight")
    firmware_params: Mapping[str, float] = setting(
        {}, "parameters of the firmware, {group: {name: value}}, set after connecting", custom=True
    )

    def __post_init__(self) -> None:
        check(self)
        object.__setattr__(self, "uri", str(self.uri))
        parse_address(self.uri)
        object.__setattr__(self, "firmware_params", _flatten_parameters(self.firmware_params))

    @property
    def address(self) -> Address:
        return parse_address(self.uri)


ROBOT_KEYS = frozenset(spec.name for spec in settings_of(RobotSettings)) - {"name"}


@dataclass(frozen=True, slots=True)
class GroundStationSettings(Settings):
    """The ground station."""

    min_connected: int = setting(
        1, "fewer usable Crazyflies than this: the bridge ends (exit code 1), no vehicle takes off",
        minimum=1, maximum=1000,
    )  # fmt: skip
    room_origin_in_world: Vector = setting(
        (0.0, 0.0, 0.95), "where the Crazyflies' world sees the origin of the frame map, the room's centre", unit="m"
    )
    force_budget: bool = setting(False, "fly although the radios cannot carry it")
    toc_cache: str = setting("", "folder of the tables of variables; empty: ~/.cache/dtsa/crazyflie")
    land_speed_mps: float = setting(0.4, "mean speed of a landing without a duration",
        unit="m/s", minimum=0.05, maximum=2)  # fmt: skip
    max_speed_mps: float = setting(1.2, "largest speed on the way of a take-off, a go_to or a landing",
        unit="m/s", minimum=0.1, maximum=10)  # fmt: skip
    max_stream_mps: float = setting(3.0, "streamed commands that are faster are refused",
        unit="m/s", minimum=0.1, maximum=30)  # fmt: skip
    landing_timeout_s: float = setting(20.0, "longest wait for all to land at the end",
        unit="s", minimum=1, maximum=300)  # fmt: skip
    priority: int = setting(20, "real-time priority of bridge, agents and ground station, where allowed; 0: none",
        minimum=0, maximum=90)  # fmt: skip
    positions: PositionSettings = nested(PositionSettings, "positions from motion capture")
    on_board: OnboardSettings = nested(OnboardSettings, "Crazyflies that steer themselves by the app on board")
    safety: SafetySettings = nested(SafetySettings, "the safety rules")


@dataclass(frozen=True, slots=True)
class SwarmSettings:
    """Everything in the swarm's YAML."""

    robots: tuple[RobotSettings, ...]  # the enabled ones, by id
    station: GroundStationSettings
    unused: tuple[str, ...] = ()  # keys of the file that mean nothing here

    @property
    def swarm(self) -> SwarmConfig | None:
        """Settings that the agents on board share; None if the bridge steers; ConfigError: they are not usable."""
        on_board = self.station.on_board
        if not on_board.enabled:
            return None
        with named("station.on_board.swarm"):
            swarm = SwarmConfig.from_dict({**on_board.swarm, "agents": len(self.robots)})
            check_onboard_swarm(swarm)
            return swarm

    @property
    def loads(self) -> list[RadioLoad]:
        """Packets that each radio has to carry."""
        positions = self.station.positions.max_rate_hz if self.station.positions.enabled else 0.0
        return radio_loads((r.address, max(r.command_rate_hz + positions, r.log_rate_hz)) for r in self.robots)

    def describe(self) -> list[str]:
        """Return lines for the operator: load of each radio, and keys that have no meaning here."""
        lines = [str(load) for load in self.loads]
        if wired := sum(not robot.address.radio for robot in self.robots):
            lines.append(f"{wired} Crazyflies without a radio (udp, usb): no budget")
        if self.unused:
            lines.append(f"not used: {', '.join(self.unused)}")
        return lines


def load_swarm(path: Path) -> SwarmSettings:
    """Read and check a swarm's YAML; ConfigError: the file cannot be read, or something in it is not usable."""
    return parse_swarm(read_yaml(path, "config"))


def parse_swarm(data: object) -> SwarmSettings:
    """Check the contents of a swarm's YAML; ConfigError: something in it is not usable."""
    top = _mapping("config", data)
    common, unused = _mapping("all", top.get("all")), [str(key) for key in top if key not in SECTIONS]
    robots = {str(name): _mapping(f"robots.{name}", own) for name, own in _mapping("robots", top.get("robots")).items()}
    enabled = {n: own for n, own in robots.items() if own.get("enabled", common.get("enabled", True)) is not False}
    if not enabled:
        raise ConfigError("robots", list(robots), "at least one robot that is enabled")
    types = _mapping("robot_types", top.get("robot_types"))
    merged = {name: _merge_robot(name, own, types, common, unused) for name, own in enabled.items()}
    _assign_ids(merged)
    built = []
    for name, values in merged.items():
        with named(f"robots.{name}"):
            built.append(RobotSettings.from_dict(values | {"name": name}))
    owners: dict[int, str] = {}
    for robot in built:
        if owners.setdefault(robot.id, robot.name) != robot.name:
            raise ConfigError(f"robots.{robot.name}.id", robot.id, f"an id of its own ({owners[robot.id]} has it)")
    built.sort(key=lambda robot: robot.id)
    check_distinct([(robot.name, robot.address) for robot in built])
    with named("station"):
        given = _mapping("station", top.get("station"))
        station = GroundStationSettings.from_dict({key: value for key, value in given.items() if value is not None})
    if station.min_connected > len(built):
        raise ConfigError("station.min_connected", station.min_connected, f"1 to {len(built)}, the enabled robots")
    settings = SwarmSettings(tuple(built), station, tuple(dict.fromkeys(unused)))
    if (swarm := settings.swarm) is not None:
        _check_swarm(settings, swarm)
    return settings


def _check_swarm(settings: SwarmSettings, swarm: SwarmConfig) -> None:
    """Check robots and station for a swarm whose agents run on board."""
    station, (x_origin, y_origin, _) = settings.station, settings.station.room_origin_in_world
    rate, start = station.on_board.polls_hz, make_scenario(swarm).start
    for name, value, wrong, allowed in (
        ("positions.source", station.positions.source, station.positions.enabled,
         f"{NONE}: poses to the Crazyflies would take their air"),
        ("room_origin_in_world", list(station.room_origin_in_world), x_origin or y_origin,
         "0, 0, z: the app knows a height alone"),
        ("safety.min_distance_m", station.safety.min_distance_m, station.safety.min_distance_m,
         "0: places that come so seldom are too old for it; the agents keep apart themselves"),
    ):  # fmt: skip
        if wrong:
            raise ConfigError(f"station.{name}", value, f"with on_board {allowed}")
    for index, robot in enumerate(settings.robots):
        field = f"robots.{robot.name}"
        if robot.id != index + 1:
            raise ConfigError(field, robot.id, f"the ids 1 to {swarm.agents} with on_board")
        if robot.log_rate_hz > rate / 2:
            allowed = f"at most {rate / 2:g} Hz with on_board.polls_hz {rate:g}: a packet comes with every second poll"
            raise ConfigError(f"{field}.log_rate_hz", robot.log_rate_hz, allowed)
        (x, y), place = start[:2, index], robot.initial_position
        if math.dist(place[:2], (x, y)) > MAX_START_OFFSET_M:
            allowed = f"within {MAX_START_OFFSET_M} m of ({x:.2f}, {y:.2f}), where the swarm begins"
            raise ConfigError(f"{field}.initial_position", list(place), allowed)


def _mapping(field: str, value: object) -> dict[str, Any]:
    """Return a section of the file, {} if it is empty; ConfigError: it is no section."""
    if value is not None and not isinstance(value, dict):
        raise ConfigError(field, value, "a mapping of names to values")
    return value or {}


def _merge(low: Mapping[str, Any], high: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested mappings; values of `high` override those of `low`."""
    result = dict(low)
    for key, value in high.items():
        both_nested = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if both_nested else value
    return result


def _merge_robot(
    name: str, own: dict[str, Any], types: dict[str, Any], common: dict[str, Any], unused: list[str]
) -> dict[str, Any]:
    """Merge one robot's values with those of its type and of all; keys without meaning are added to `unused`."""
    if NAME.fullmatch(name) is None:
        raise ConfigError("robots", name, "names of letters, digits and underscores that do not begin with a digit")
    robot_type = own.get("type", "")
    if robot_type and robot_type not in types:
        allowed = "one of robot_types: " + (", ".join(map(str, types)) or "(there are none)")
        raise ConfigError(f"robots.{name}.type", robot_type, allowed)
    type_field, result = f"robot_types.{robot_type}", dict[str, Any]()
    levels = {"all": common, type_field: _mapping(type_field, types.get(robot_type)), f"robots.{name}": own}
    for level, values in levels.items():
        if isinstance(battery := values.get("battery"), dict):
            unused += [f"{level}.battery.{key}" for key in battery if key not in BATTERY_KEYS]
            values = values | {"battery": {key: value for key, value in battery.items() if key in BATTERY_KEYS}}
        unused += [f"{level}.{key}" for key in values if key not in ROBOT_KEYS]
        known = {key: value for key, value in values.items() if key in ROBOT_KEYS and value is not None}
        result = _merge(result, known)
    return result


def _assign_ids(robots: dict[str, dict[str, Any]]) -> None:
    """Give ids to robots without: the numbers that end all names if these are 1 to N, else the file's order."""
    numbers = [int(match[0]) if (match := TRAILING_NUMBER.search(name)) else 0 for name in robots]
    if sorted(numbers) != list(range(1, len(robots) + 1)):
        numbers = list(range(1, len(robots) + 1))
    for own, number in zip(robots.values(), numbers, strict=True):
        own.setdefault("id", number)


def _flatten_parameters(groups: object) -> dict[str, float]:
    """Check parameters of the firmware, {group: {name: value}}; return them by `group.name`. Integers stay integers."""
    result: dict[str, float] = {}
    for group, names in _mapping("firmware_params", groups).items():
        for name, value in _mapping(f"firmware_params.{group}", names).items():
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise ConfigError(f"firmware_params.{group}.{name}", value, "a number")
            result[f"{group}.{name}"] = value
    return result
