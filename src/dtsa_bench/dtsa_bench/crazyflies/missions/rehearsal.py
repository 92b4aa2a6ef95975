"""A mission is flown in simulation first, from the places where the Crazyflies stand."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.settings.config import SwarmSettings, parse_swarm
from dtsa_agent.ros.common.process.loop import Stop
from dtsa_bench.crazyflies.simulated.ports import free_base_port
from dtsa_bench.crazyflies.simulated.process import FleetError, running_fleet
from dtsa_bench.flights.flight import Flight
from dtsa_bench.flights.options import FlightOptions
from dtsa_bench.pages.view.process import PageOptions
from dtsa_bench.runs.config import RunConfig

from .mission_flight import fly_crazyflies
from .places import MissionError

WHERE_S = 120.0  # s, to connect to all and ask where they stand


def rehearse(
    run: RunConfig,
    settings: SwarmSettings,
    swarm_yaml: Path,
    out: str | Path,
    options: FlightOptions,
    stop: Stop,
    *,
    page: PageOptions | None = None,
) -> tuple[Flight, str]:
    """Ask where everybody stands, then fly the mission with simulated Crazyflies that stand there.

    No motor of a real one turns. Parameters and results: see `fly_crazyflies`.

    :raises ConfigError: the bridge refuses the swarm.
    :raises MissionError: somebody cannot be asked, or the simulated mission fails.
    """
    places = measured_places(settings, swarm_yaml)
    with tempfile.TemporaryDirectory(prefix="dtsa-rehearsal-") as folder, _fleet(places, Path(folder)) as base:
        data = settings.to_dict()
        for index, robot in enumerate(data["robots"].values()):
            robot["uri"] = f"udp://127.0.0.1:{base + index}"
        data["station"]["positions"] = {}  # decks: what is rehearsed are the ways
        path = Path(folder) / "swarm.yaml"
        path.write_text(yaml.safe_dump(data), encoding="utf-8")
        return fly_crazyflies(run, parse_swarm(data), path, out, replace(options, domain=None), stop, page=page)


def measured_places(settings: SwarmSettings, swarm_yaml: Path) -> list[list[float]]:
    """Where everybody stands, m, world, in the order of the robots.

    :raises MissionError: somebody cannot be asked.
    """
    command = [
        sys.executable,
        "-m",
        "dtsa_agent.crazyflie.node.print_places",
        "--ros-args",
        "-p",
        f"config:={swarm_yaml.resolve()}",
    ]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=WHERE_S, check=False)
    except subprocess.TimeoutExpired:
        raise MissionError(f"the places of the vehicles are not known after {WHERE_S:g} s") from None
    lines = [line for line in result.stdout.splitlines() if line.startswith("{")]
    if result.returncode == 2:
        raise ConfigError("config", str(swarm_yaml), result.stderr.strip().splitlines()[-1])
    found: dict[str, Any] = json.loads(lines[-1]) if lines else {}
    missing = [robot.name for robot in settings.robots if robot.name not in found]
    if missing:
        raise MissionError(f"no rehearsal: the places of {', '.join(missing)} are not known")
    return [found[robot.name] for robot in settings.robots]


@contextmanager
def _fleet(places: list[list[float]], folder: Path) -> Iterator[int]:
    """Simulated Crazyflies at these places, in a process of their own; the first one's port."""
    base = free_base_port(len(places))
    robots = {
        f"cf{k}": {"uri": f"udp://127.0.0.1:{base + k - 1}", "initial_position": [place[0], place[1], 0.0]}
        for k, place in enumerate(places, 1)
    }
    config = folder / "fleet.yaml"
    config.write_text(yaml.safe_dump({"robots": robots}), encoding="utf-8")
    try:
        with running_fleet(["--config", str(config)]):
            yield base
    except FleetError as error:
        raise MissionError(str(error)) from error
