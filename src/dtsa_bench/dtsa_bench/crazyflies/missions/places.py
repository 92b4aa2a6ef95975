"""Before motors turn: where each vehicle stands, measured, and where each agent begins."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.crazyflie.safety import SafetySettings
from dtsa_agent.crazyflie.settings import SwarmSettings, parse_swarm

PLACE_M = 0.25  # m: a vehicle may stand this far beside its place
MIN_RATE_HZ = 10  # of commands and log: at 6 Hz simulated vehicles came within 0.17 m, at 4 Hz they left the room
APART_M = 0.35  # m: closer than this to each other none takes off or flies to its start

Array = NDArray[np.float64]


class MissionError(DtsaError):
    """The mission cannot go on; all are landed."""


def mission_defaults(settings: SwarmSettings, given: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of the swarm that a mission chooses unless the user does.

    The paper's room: an ellipse of half axes 1.2 m and 2.0 m, ids in order, so that everyone finds its place. More room
    between two vehicles than in simulation, because they know where they are to a few centimetres only; and the policy
    with which tables agree even where frames are lost.
    """
    room = {"shape": "ellipse", "axis_x_m": 1.2, "axis_y_m": 2.0, "permute": False}
    defaults = {"agents": len(settings.robots), "avoider": "crazyflie", "policy": "lease"} | room
    return {name: value for name, value in defaults.items() if given.get(name) is None}


def check_places(settings: SwarmSettings, config: SwarmConfig) -> Scenario:
    """Return the scenario, once it is sure that all stand where they begin.

    :raises ConfigError: ids are missing, a rate is too low, or places are not where the scenario wants them (all).
    """
    ids = [robot.id for robot in settings.robots]
    if ids != list(range(1, config.agents + 1)):
        raise ConfigError("robots", ids, f"the ids 1 to {config.agents}, one for each agent")
    for robot in settings.robots:
        for name in ("command_rate_hz", "log_rate_hz"):
            if (rate := getattr(robot, name)) < MIN_RATE_HZ:
                raise ConfigError(f"robots.{robot.name}.{name}", rate, f"at least {MIN_RATE_HZ} Hz for a mission")
    scenario = make_scenario(config)
    x0, y0, _ = settings.station.room_origin_in_world
    wrong = {
        robot.name: f"{robot.name} within {PLACE_M} m of ({x + x0:.2f}, {y + y0:.2f})"
        for robot, (x, y) in zip(settings.robots, scenario.start[:2].T.tolist(), strict=True)
        if np.hypot(robot.initial_position[0] - x0 - x, robot.initial_position[1] - y0 - y) > PLACE_M
    }
    if wrong:
        raise ConfigError("initial_position", ", ".join(wrong), "; ".join(wrong.values()))
    return scenario


def place_lines(settings: SwarmSettings) -> list[str]:
    """What a mission with its default scenario lacks in the robots' places; empty: nothing."""
    try:
        check_places(settings, SwarmConfig(**mission_defaults(settings, {})))
    except ConfigError as error:
        return [f"{error.field}: {place}" for place in error.allowed.split("; ")]
    return []


def example_swarm(count: int) -> str:
    """A swarm's YAML for a mission of so many on one dongle: places, and rates that it can carry."""
    uris = [f"radio://0/80/2M/E7E7E7E7{k:02X}" for k in range(1, count + 1)]
    robots = {f"cf{k}": {"uri": uri} for k, uri in enumerate(uris, 1)}
    settings = parse_swarm({"robots": robots})
    start = make_scenario(SwarmConfig(**mission_defaults(settings, {}))).start
    x0, y0, _ = settings.station.room_origin_in_world
    (load,) = settings.loads
    rate = min(50, int(load.fitting_hz))
    if rate < MIN_RATE_HZ:
        raise ConfigError("places", count, f"as many as one dongle can carry at {MIN_RATE_HZ} Hz")
    lines = [f"# {count} on one dongle: {load}", "robots:"]
    for k, (uri, (x, y)) in enumerate(zip(uris, start[:2].T.tolist(), strict=True), 1):
        place = f"[{x + x0 + 0.0:.3f}, {y + y0 + 0.0:.3f}, 0.0]"
        lines.append(f"  cf{k}: {{uri: '{uri}', initial_position: {place}}}")
    return "\n".join([*lines, f"all: {{command_rate_hz: {rate}, log_rate_hz: {rate}}}"])


def assign_places(config: SwarmConfig, measured: Array) -> SwarmConfig:
    """Return the configuration in which all begin near where they stand, if roles may be exchanged.

    If one is not where it would begin, all exchange places: the sum of the squared ways is the smallest possible,
    with which ways that are flown at the same time keep 0.7 times the distance of the starts or goals. Roles that
    `places` gives are kept.

    :param measured: (3, N), m, frame map: where they stand.
    """
    start = make_scenario(config).start
    away = np.linalg.norm(measured[:2] - start[:2], axis=0)
    if away.max() <= PLACE_M or config.places:
        return config
    from scipy.optimize import linear_sum_assignment

    count = config.agents
    places = make_scenario(dataclasses.replace(config, places=" ".join(map(str, range(1, count + 1))))).start
    ways = measured[:2, :, None] - places[:2, None, :]
    _, chosen = linear_sum_assignment((ways * ways).sum(axis=0))
    return dataclasses.replace(config, places=" ".join(str(place + 1) for place in chosen.tolist()))


def check_standing(names: Sequence[str], measured: Array, fence: SafetySettings) -> None:
    """Whether all can take off where they stand, (3, N), m, frame map; MissionError: with names and distances."""
    problems = []
    if fence.geofence:
        low, high = np.array(fence.geofence_min)[:2], np.array(fence.geofence_max)[:2]
        for name, (x, y) in zip(names, measured[:2].T.tolist(), strict=True):
            outside = float(max((low - (x, y)).max(), ((x, y) - high).max()))
            if outside > fence.geofence_tolerance_m:
                problems.append(f"{name} stands {outside:.2f} m outside the geofence at ({x:.2f}, {y:.2f})")
    a, b = np.tril_indices(len(names), -1)
    problems += _too_close(names, np.linalg.norm(measured[:2, a] - measured[:2, b], axis=0), "stand {:.2f} m apart")
    if problems:
        raise MissionError(f"no take-off (at least {APART_M} m apart): {'; '.join(problems)}")


def check_crossings(scenario: Scenario, names: Sequence[str], measured: Array) -> None:
    """Whether all can fly straight to their starts at the same time from where they are, (3, N), m, frame map.

    :raises MissionError: with the names and smallest distances of those that would come too close.
    """
    a, b = np.tril_indices(len(names), -1)
    before, after = (place[:2, a] - place[:2, b] for place in (measured, scenario.start))
    change = after - before
    square = (change**2).sum(axis=0)
    when = np.clip(-(before * change).sum(axis=0) / np.where(square > 0.0, square, 1.0), 0.0, 1.0)
    close = _too_close(names, np.linalg.norm(before + when * change, axis=0), "would come within {:.2f} m")
    if close:
        raise MissionError(
            f"on the way to where they begin {'; '.join(close)}: put each on its place, or leave out --places, with "
            "which they exchange roles"
        )


def _too_close(names: Sequence[str], distances: Array, text: str) -> list[str]:
    """Name the pairs that are too close, from the distances of all, in the order of `np.tril_indices`."""
    pairs = zip(*np.tril_indices(len(names), -1), distances.tolist(), strict=True)
    return [f"{names[b]} and {names[a]} {text.format(distance)}" for a, b, distance in pairs if distance < APART_M]
