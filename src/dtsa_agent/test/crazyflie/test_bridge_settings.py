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
from dtsa_agent.crazyflie.addresses import Address, check_budget, parse_address, radio_loads
from dtsa_agent.crazyflie.bridge import own_addresses
from dtsa_agent.crazyflie.link import SIMULATED_RADIO
from dtsa_agent.crazyflie.settings import load_swarm, parse_swarm

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
        f"cf{k}": {"uri": f"udp://h:{k}", "id": k, "log_rate_hz": rate, "initial_position": where or places[i]}
        for i, k in enumerate(ids)
    }
    return swarm(robots=robots, station={"on_board": given, "safety": {"min_distance_m": 0}} | station)


def test_robot_beats_type_beats_all() -> None:
    settings = parse_swarm({
        "robots": {
            "cf2": {"uri": "radio://0/80/2M/E7E7E7E702", "type": "small", "log_rate_hz": 20}, "cf1": {"uri": RADIO},
            "cf9": {"uri": "radio://0/80/2M/E7E7E7E709", "enabled": False},
        },
        "robot_types": {"small": {"command_rate_hz": 20, "battery": {"flight_warning": 3.6}}},
        "all": {
            "command_rate_hz": 30, "log_rate_hz": 30, "battery": {"flight_landing": 3.1},
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
    assert (second.battery.flight_warning, second.battery.flight_landing) == (3.6, 3.1)
    assert second.firmware_params == {"stabilizer.estimator": 2}


def cf1(**more: Any) -> dict[str, Any]:
    return swarm(robots={"cf1": {"uri": "udp://h:1"} | more})


@pytest.mark.parametrize(("data", "field"), [
    (None, "robots"), ([], "config"), ({"robotz": {}}, "robots"), (swarm(robots={}), "robots"),
    (swarm(robots={"2nd": {"uri": "udp://h:1"}}), "robots"), (swarm(robots={"cf1": {}}), "robots.cf1.uri"),
    (swarm(robots={"cf1": {"uri": "radio:/0"}}), "robots.cf1.uri"), (cf1(type="big"), "robots.cf1.type"),
    (cf1(id=0), "robots.cf1.id"), (cf1(log_rate_hz=200), "robots.cf1.log_rate_hz"),
    *((cf1(initial_position=place), "robots.cf1.initial_position") for place in ([1, 2], [math.nan, 0, 0])),
    *((cf1(uri=uri), "robots.cf1.uri") for uri in (
        "radio://0/200/2M/E7E7E7E701", "udp://h:99999", "udp://h:0", "udp://[h:1", "udp://me@h:1", "udp://h:1?a", "usb://[",
    )),
    (cf1(firmware_params={"locSrv": {"extPosStdDev": math.nan}}), "robots.cf1.firmware_params.locSrv.extPosStdDev"),
    (swarm(robots=["cf1", "cf2"]), "robots"),
    (swarm(station={"safety": {"geofence_max": [1.5, math.inf, 1]}}), "station.safety.geofence_max"),
    (swarm(robots={"cf1": {"uri": "udp://h:1", "id": 2}, "cf2": {"uri": "udp://h:2"}}), "robots.cf2.id"),
    (swarm(all={"battery": {"voltage_critical": 4.0}}), "robots.cf1.battery.voltage_critical"),
    (swarm(all={"battery": {"flight_landing": 4.0}}), "robots.cf1.battery.flight_landing"),
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


@pytest.mark.parametrize(("one", "other"), [
    (RADIO, f"{RADIO}?rate_limit=100"), ("radio://0/80/2M/e7e7e7e701", RADIO), ("radio://1/80/2M/E7E7E7E701", RADIO),
    ("radio://*/80/2M/E7E7E7E701", RADIO), ("radio://0/80", "radio://0/80/2M/E7E7E7E7E7"),
    ("radio://0", "radio://0/2/2M/E7E7E7E7E7"), ("radio://0/80/2M/1", "radio://1/80/2M/0000000001"),
    ("udp://h:1", "udp://h:1"), ("udp://localhost:9001", "udp://127.0.0.1:9001"), ("usb://0", "usb://0"),
    ("tcp://192.168.4.1:5000", "tcp://192.168.4.1:5000/"),
])  # fmt: skip
def test_one_crazyflie_is_not_two_robots(one: str, other: str) -> None:
    with pytest.raises(ConfigError, match="cf1 is reached by the same link") as error:
        parse_swarm(swarm(robots={"cf1": {"uri": one}, "cf2": {"uri": other}}))
    assert error.value.field == "robots.cf2.uri"


def test_what_only_looks_alike_is_two_robots() -> None:
    for one, other in (
        (RADIO, "radio://0/81/2M/E7E7E7E701"), (RADIO, "radio://0/80/1M/E7E7E7E701"),
        ("udp://h:1", "tcp://h:1"), ("udp://127.0.0.1:1", "udp://127.0.0.2:1"), ("serial://ttyA", "serial://ttyB"),
        ("udp://a..b:1", "udp://127.0.0.1:1"),
    ):  # fmt: skip
        assert len(parse_swarm(swarm(robots={"cf1": {"uri": one}, "cf2": {"uri": other}})).robots) == 2


# What laboratories' files have in their robots: names, links, and keys for programs of their own.
STOCK = {
    "robot_types": {"cf21": {
        "motion_capture": {"tracking": "librigidbodytracker", "marker": "default_single_marker", "dynamics": "default"},
        "big_quad": False, "battery": {"voltage_warning": 3.8, "voltage_critical": 3.7},
    }},
    "all": {
        "firmware_logging": {"enabled": True, "default_topics": {"pose": {"frequency": 10}}},
        "firmware_params": {"commander": {"enHighLevel": 1}, "locSrv": {"extPosStdDev": 1e-3, "extQuatStdDev": 0.05}},
        "reference_frame": "world", "broadcasts": {"num_repeats": 15, "delay_between_repeats_ms": 1},
    },
}  # fmt: skip


def laboratory(*robots: tuple[str, str, dict[str, Any]], **top: Any) -> dict[str, Any]:
    """A file of Crazyswarm2 with these robots: name, URI, and other keys."""
    common = {"enabled": True, "type": "cf21", "initial_position": [0, 0, 0]}
    return {"fileversion": 3, "robots": {name: common | {"uri": uri} | own for name, uri, own in robots}} | STOCK | top


@pytest.mark.parametrize(("robots", "ids"), [
    ([("cf231", "radio://0/80/2M/E7E7E7E7E7", {}), ("cf5", RADIO, {"enabled": False})], {"cf231": 1}),
    ([("cf1", "radio://*/80/2M/E7E7E7E701", {}), ("cf2", "radio://*/80/2M/E7E7E7E702", {})], {"cf1": 1, "cf2": 2}),
    ([("cf0", RADIO, {}), ("cf1", "radio://0/80/2M/E7E7E7E702", {})], {"cf0": 1, "cf1": 2}),
    ([("cf_0", RADIO, {}), ("cf_1", "radio://0/80/2M/E7E7E7E702", {})], {"cf_0": 1, "cf_1": 2}),
    ([("cf231_active", RADIO, {}), ("marvin", "usb://0", {})], {"cf231_active": 1, "marvin": 2}),
    ([("cf03", RADIO, {}), ("cf01", "radio://0/80/2M/03", {}), ("cf02", "radio://0/80", {})],
     {"cf03": 3, "cf01": 1, "cf02": 2}),
    ([("C23", RADIO, {"role": "evader"}), ("C24", "radio://0/80/2M/02", {"role": "pursuer"})], {"C23": 1, "C24": 2}),
    ([("b", RADIO, {"id": 7}), ("a", "radio://0/80/2M/02", {})], {"b": 7, "a": 2}),
    ([("cf2", RADIO, {}), ("not-a-name", "nothing", {"enabled": False, "type": "none"})], {"cf2": 1}),
    ([("cf1", "tcp://192.168.4.1:5000", {}), ("cf2", "serial:///dev/ttyAMA0", {})], {"cf1": 1, "cf2": 2}),
])  # fmt: skip
def test_files_of_laboratories_are_taken_as_they_are(robots: list[Any], ids: dict[str, int]) -> None:
    settings = parse_swarm(laboratory(*robots))
    assert {robot.name: robot.id for robot in settings.robots} == ids
    for robot in settings.robots:  # Crazyswarm2's voltages are looked at on the ground
        assert (robot.battery.voltage_critical, robot.battery.flight_landing) == (3.7, 3.2)
    assert robots[0][2].get("role") is None or f"robots.{robots[0][0]}.role" in settings.unused
    with pytest.raises(ConfigError, match="at least one robot that is enabled"):
        parse_swarm(laboratory(*[(name, uri, own | {"enabled": False}) for name, uri, own in robots]))


def test_keys_that_mean_nothing_here_are_named_once() -> None:
    file = laboratory(("cf1", RADIO, {"colour": 1, "battery": {"chemistry": "LiPo"}}), ("cf2", "usb://0", {}))
    (line,) = [line for line in parse_swarm(file | {"relative": False}).describe() if "not used" in line]
    for key in ("relative", "robots.cf1.colour", "robots.cf1.battery.chemistry", "all.broadcasts"):
        assert line.count(key) == 1
    assert line.count("robot_types.cf21.big_quad") == 1  # of both robots


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
    check_budget(settings.loads, force=False)
    fence = settings.station.safety
    origin = settings.station.room_origin_in_world
    for robot in settings.robots:
        inside = zip(robot.initial_position, origin, fence.geofence_min, fence.geofence_max, strict=True)
        assert all(low <= p - o <= high for p, o, low, high in inside)


def robots(
    count: int, rate: float, radio: str = "0", bits: str = "2M", channel: int = 80
) -> list[tuple[Address, float]]:
    uris = [f"radio://{radio}/{channel}/{bits}/E7E7E7E7{k:02X}" for k in range(1, count + 1)]
    return [(parse_address(uri), rate) for uri in uris]


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
    wired = [(parse_address("udp://127.0.0.1:19850"), 100.0)]
    loads = radio_loads(robots(4, 50) + robots(3, 50, "1", channel=100) + wired)
    assert [(load.medium, load.number) for load in loads] == [("radio 0", 4), ("radio 1", 3)]
    assert all(load.fits for load in loads)


def test_two_dongles_on_one_channel_carry_no_more_than_one() -> None:
    loads = radio_loads(robots(4, 50) + robots(4, 50, "1"))
    assert [(load.medium, load.fits) for load in loads] == [
        ("radio 0", True), ("radio 1", True), ("channel 80 of radios 0, 1", False),
    ]  # fmt: skip
    with pytest.raises(ConfigError, match="channels of their own"):
        check_budget(loads, force=False)


def test_the_budget_says_with_which_rates_it_would_fit() -> None:
    (load,) = radio_loads(robots(10, 50))
    assert str(load).endswith("DOES NOT FIT (command_rate_hz and log_rate_hz 15 fit)")
    (load,) = radio_loads(robots(10, 15))
    assert str(load).endswith(": fits")


def test_a_crazyflie_belongs_to_one_bridge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    first = own_addresses([("cf1", "radio://0/80/2M/E7E7E7E701"), ("cf2", "radio://0/80/2M/E7E7E7E702")])
    with pytest.raises(ConfigError, match="no other bridge") as error:
        own_addresses([("cf9", "radio://0/80/2M/E7E7E7E709"), ("a2", "radio://0/80/2M/e7e7e7e702?rate_limit=50")])
    assert error.value.field == "robots.a2.uri"
    own_addresses([("cf9", "radio://0/80/2M/E7E7E7E709")]).close()  # what it had taken before it was refused is free
    monkeypatch.setenv(SIMULATED_RADIO, str(tmp_path / "radio"))
    own_addresses([("cf2", "radio://0/80/2M/E7E7E7E702")]).close()  # on another air
    monkeypatch.delenv(SIMULATED_RADIO)
    first.close()
    own_addresses([("cf2", "radio://0/80/2M/E7E7E7E702")]).close()


def test_cflib_shows_no_warnings_of_other_packages() -> None:
    """Its import turns all DeprecationWarnings on; a mission's error then stood below those of its dependencies."""
    pytest.importorskip("cflib")
    program = (
        "import warnings; from dtsa_agent.crazyflie.link import require_cflib; require_cflib(); "
        "warnings.warn_explicit('old', DeprecationWarning, 'elsewhere.py', 1, module='elsewhere')"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
