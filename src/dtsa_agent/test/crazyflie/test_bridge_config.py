"""Configuration of the bridge, its radio budget, and who flies a Crazyflie: without ROS and without links."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import pytest

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.links.link import SIMULATED_RADIO
from dtsa_agent.crazyflie.node.bridge import Ownership
from dtsa_agent.crazyflie.settings.config import load_swarm, parse_swarm
from dtsa_agent.crazyflie.settings.radio_budget import check_budget, radio_loads, radio_of

RADIO = "radio://0/80/2M/E7E7E7E701"
CONFIG = Path(__file__).parents[2] / "config"


def swarm(**top: Any) -> dict[str, Any]:
    return {"robots": {"cf1": {"uri": "udp://127.0.0.1:19850"}}} | top


def on_board(
    rate: float = 5, ids: tuple[int, ...] = (1, 2), where: list[float] | None = None, **station: Any
) -> dict[str, Any]:
    """Two that steer themselves; other keys are those of `on_board` or of the station."""
    given = {"swarm": {"policy": "lease", "jitter_m": 0.0, "permute": False}, "polls_hz": 10}
    given |= {key: station.pop(key) for key in tuple(station) if key in given}
    places = [list(make_scenario(SwarmConfig(agents=2)).start[:, k]) for k in range(2)]
    robots = {
        f"cf{k}": {"uri": f"udp://h:{k}", "log_rate_hz": rate, "initial_position": where or places[i]}
        for i, k in enumerate(ids)
    }
    return swarm(robots=robots, station={"on_board": given, "safety": {"min_distance_m": 0}} | station)


def test_robot_beats_type_beats_all() -> None:
    settings = parse_swarm({
        "robots": {
            "cf2": {"uri": "radio://0/80/2M/E7E7E7E702", "type": "small", "log_rate_hz": 20}, "cf1": {"uri": RADIO},
            "cf9": {"uri": "radio://0/80/2M/E7E7E7E709", "enabled": False},
        },
        "robot_types": {"small": {"command_rate_hz": 20, "battery": {"voltage_warning": 3.6}}},
        "all": {
            "command_rate_hz": 30, "log_rate_hz": 30, "battery": {"voltage_critical": 3.1},
            "firmware_params": {"stabilizer": {"estimator": 2}},
            "firmware_logging": {
                "enabled": True, "default_topics": {"pose": {"frequency": 10}},
                "custom_topics": {"volts": {"frequency": 5, "vars": ["pm.vbat"]}},
            },
        },
    })  # fmt: skip
    first, second = settings.robots
    assert (first.name, first.id, first.command_rate_hz, first.log_rate_hz) == ("cf1", 1, 30, 30)
    assert (second.command_rate_hz, second.log_rate_hz) == (20, 20)
    assert (second.battery.voltage_warning, second.battery.voltage_critical) == (3.6, 3.1)
    assert second.firmware_params == {"stabilizer.estimator": 2}


def cf1(**more: Any) -> dict[str, Any]:
    return swarm(robots={"cf1": {"uri": "udp://h:1"} | more})


@pytest.mark.parametrize(("data", "field"), [
    (None, "robots"), ([], "config"), (swarm(robotz={}), "config.robotz"), (swarm(robots={}), "robots"),
    (swarm(robots={"drone": {"uri": "udp://h:1"}}), "robots"), (swarm(robots={"cf1": {}}), "robots.cf1.uri"),
    (swarm(robots={"cf1": {"uri": "radio:/0"}}), "robots.cf1.uri"), (cf1(type="big"), "robots.cf1.type"),
    (cf1(colour=1), "robots.cf1.colour"), (cf1(log_rate_hz=200), "robots.cf1.log_rate_hz"),
    *((cf1(initial_position=place), "robots.cf1.initial_position") for place in ([1, 2], [math.nan, 0, 0])),
    *((cf1(uri=uri), "robots.cf1.uri") for uri in ("radio://0/200/2M/E7E7E7E701", "udp://h:99999", "udp://h:0")),
    (cf1(firmware_params={"locSrv": {"extPosStdDev": math.nan}}), "robots.cf1.firmware_params.locSrv.extPosStdDev"),
    (swarm(robots=["cf1", "cf2"]), "robots"), (swarm(robots={"cf0": {"uri": "udp://h:1"}}), "robots.cf0.id"),
    (swarm(robots={"cf1": {"uri": RADIO}, "cf2": {"uri": f"{RADIO}?rate_limit=100"}}), "robots.cf2.uri"),
    (swarm(station={"safety": {"geofence_max": [1.5, math.inf, 1]}}), "station.safety.geofence_max"),
    (swarm(robots={"cf1": {"uri": "udp://h:1"}, "cf2": {"uri": "udp://h:1"}}), "robots.cf2.uri"),
    (swarm(robots={"cf1": {"uri": "udp://h:1"}, "a1": {"uri": "udp://h:2"}}), "robots.a1"),
    (swarm(all={"battery": {"voltage_critical": 4.0}}), "robots.cf1.battery.voltage_critical"),
    (swarm(station={"min_connected": 2}), "station.min_connected"),
    (swarm(station={"safety": {"geofence_min": [2, 0, 0]}}), "station.safety.geofence_min"),
    (swarm(station={"safety": {"command_age_s": 0.6}}), "station.safety.command_age_s"),
    (on_board(swarm={"policy": "lease", "agents": 3}), "station.on_board.swarm.agents"),
    (on_board(swarm={"policy": "lease", "slots": 3}), "station.on_board.swarm.slots"),
    (on_board(swarm={"policy": "sotdma"}), "station.on_board.swarm.policy"),
    (on_board(polls_hz=5), "station.on_board.polls_hz"), (on_board(rate=8), "robots.cf1.log_rate_hz"),
    (on_board(ids=(1, 3)), "robots.cf3"), (on_board(where=[0.5, 0.0, 0.0]), "robots.cf1.initial_position"),
    (on_board(safety={}), "station.safety.min_distance_m"),
    (on_board(positions={"source": "pose"}), "station.positions.source"),
    (on_board(room_origin_in_world=[1, 0, 1]), "station.room_origin_in_world"),
])  # fmt: skip
def test_bad_configuration_names_the_field(data: object, field: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_swarm(data)
    assert error.value.field == field
    assert "\n" not in str(error.value)


def test_unreadable_files_are_the_users_to_mend(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        load_swarm(tmp_path / "missing.yaml")
    twice = "robots:\n  cf1: {uri: 'udp://h:1'}\n  cf1: {uri: 'udp://h:2'}\n"
    for text, words in (("robots: {cf1: [", "YAML"), ("\x00\x01", "YAML"), (twice, "cf1")):
        (tmp_path / "broken.yaml").write_text(text)
        with pytest.raises(ConfigError, match=words) as error:
            load_swarm(tmp_path / "broken.yaml")
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["swarm_simulated.yaml", "swarm_radio.yaml"])
def test_examples_are_usable(name: str) -> None:
    settings = load_swarm(CONFIG / name)
    check_budget(radio_loads([(r.name, r.uri, r.command_rate_hz, r.log_rate_hz) for r in settings.robots]), force=False)
    fence = settings.station.safety
    origin = settings.station.room_origin_in_world
    for robot in settings.robots:
        inside = zip(robot.initial_position, origin, fence.geofence_min, fence.geofence_max, strict=True)
        assert all(low <= p - o <= high for p, o, low, high in inside)


def robots(count: int, rate: float, radio: str = "0", bits: str = "2M") -> list[tuple[str, str, float, float]]:
    return [(f"cf{k}", f"radio://{radio}/80/{bits}/E7E7E7E7{k:02X}", rate, rate) for k in range(1, count + 1)]


@pytest.mark.parametrize(
    ("rate", "most", "bits"), [(50.0, 4, "2M"), (20.0, 8, "2M"), (50.0, 4, "1M"), (50.0, 2, "250K"), (20.0, 4, "250K")]
)
def test_budget_is_what_one_radio_is_known_to_carry(rate: float, most: int, bits: str) -> None:
    check_budget(radio_loads(robots(most, rate, bits=bits)), force=False)
    loads = radio_loads(robots(most + 1, rate, bits=bits))
    assert "DOES NOT FIT" in str(loads[0])
    with pytest.raises(ConfigError, match=f"{most} Crazyflies"):
        check_budget(loads, force=False)
    check_budget(loads, force=True)


def test_budget_counts_each_radio_and_no_udp() -> None:
    loads = radio_loads(robots(4, 50) + robots(3, 50, "1") + [("cf9", "udp://127.0.0.1:19850", 100, 100)])
    assert [(load.radio, len(load.robots)) for load in loads] == [("0", 4), ("1", 3)]
    assert radio_of("usb://0") is None
    assert radio_of("radio://0/80/2M/E7E7E7E701?rate_limit=100") == "0"


def test_a_crazyflie_belongs_to_one_bridge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    first = Ownership([("cf1", "radio://0/80/2M/E7E7E7E701"), ("cf2", "radio://0/80/2M/E7E7E7E702")])
    with pytest.raises(ConfigError, match="no other bridge") as error:
        Ownership([("cf9", "radio://0/80/2M/E7E7E7E709"), ("a2", "radio://0/80/2M/e7e7e7e702?rate_limit=50")])
    assert error.value.field == "robots.a2.uri"
    Ownership([("cf9", "radio://0/80/2M/E7E7E7E709")]).release()  # what it had taken before it was refused is free
    monkeypatch.setenv(SIMULATED_RADIO, str(tmp_path / "radio"))
    Ownership([("cf2", "radio://0/80/2M/E7E7E7E702")]).release()  # on another air
    monkeypatch.delenv(SIMULATED_RADIO)
    first.release()
    Ownership([("cf2", "radio://0/80/2M/E7E7E7E702")]).release()


def test_cflib_shows_no_warnings_of_other_packages() -> None:
    """Its import turns all DeprecationWarnings on; a mission's error then stood below those of its dependencies."""
    pytest.importorskip("cflib")
    program = (
        "import warnings; from dtsa_agent.crazyflie.links.link import require_cflib; require_cflib(); "
        "warnings.warn_explicit('old', DeprecationWarning, 'elsewhere.py', 1, module='elsewhere')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
