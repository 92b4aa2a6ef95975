"""Configuration, radio budget, state machine, mailbox and safety rules of the bridge: without ROS and without links."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core.errors import ConfigError, LocalProtocolError
from dtsa_agent.crazyflie import state_machine as sm
from dtsa_agent.crazyflie import units
from dtsa_agent.crazyflie.budget import check_budget, radio_loads, radio_of
from dtsa_agent.crazyflie.claims import Claims
from dtsa_agent.crazyflie.config import LogTopic, StationSettings, load_swarm, parse_swarm
from dtsa_agent.crazyflie.limits import check_stream, outside_fence
from dtsa_agent.crazyflie.link import SIMULATED_RADIO
from dtsa_agent.crazyflie.mailbox import Mailbox
from dtsa_agent.crazyflie.safety import Action, SafetyMonitor, SafetySettings, Watched
from dtsa_agent.crazyflie.state_machine import State, StateMachine
from dtsa_agent.crazyflie.units import Setpoint

CONFIG = Path(__file__).parents[1] / "config"


# -- configuration ----------------------------------------------------------------------------------------------------
def swarm(**top: Any) -> dict[str, Any]:
    return {"robots": {"cf1": {"uri": "udp://127.0.0.1:19850"}}} | top


def test_robot_beats_type_beats_all() -> None:
    settings = parse_swarm(
        {
            "robots": {
                "cf2": {"uri": "radio://0/80/2M/E7E7E7E702", "type": "small", "log_rate_hz": 20},
                "cf1": {"uri": "radio://0/80/2M/E7E7E7E701"},
                "cf9": {"uri": "radio://0/80/2M/E7E7E7E709", "enabled": False},
            },
            "robot_types": {"small": {"command_rate_hz": 20, "battery": {"voltage_warning": 3.6}}},
            "all": {
                "command_rate_hz": 30,
                "log_rate_hz": 30,
                "battery": {"voltage_critical": 3.1},
                "firmware_params": {"stabilizer": {"estimator": 2}},
                "firmware_logging": {
                    "enabled": True,
                    "default_topics": {"pose": {"frequency": 10}},
                    "custom_topics": {"volts": {"frequency": 5, "vars": ["pm.vbat"]}},
                },
            },
        }
    )
    first, second = settings.robots
    assert (first.name, first.id, first.command_rate_hz, first.log_rate_hz) == ("cf1", 1, 30, 30)
    assert (second.command_rate_hz, second.log_rate_hz) == (20, 20)
    assert (second.battery.voltage_warning, second.battery.voltage_critical) == (3.6, 3.1)
    assert second.firmware_params == {"stabilizer.estimator": 2}
    assert second.firmware_logging == {"volts": LogTopic("volts", 5.0, ("pm.vbat",))}
    assert parse_swarm(settings.to_dict()) == settings


@pytest.mark.parametrize(
    ("data", "field"),
    [
        (None, "robots"),
        ([], "config"),
        (swarm(robotz={}), "config.robotz"),
        (swarm(robots={}), "robots"),
        (swarm(robots={"drone": {"uri": "udp://h:1"}}), "robots"),
        (swarm(robots={"cf1": {}}), "robots.cf1.uri"),
        (swarm(robots={"cf1": {"uri": "radio:/0"}}), "robots.cf1.uri"),
        (swarm(robots={"cf1": {"uri": "udp://h:1", "type": "big"}}), "robots.cf1.type"),
        (swarm(robots={"cf1": {"uri": "udp://h:1", "colour": 1}}), "robots.cf1.colour"),
        (swarm(robots={"cf1": {"uri": "udp://h:1", "log_rate_hz": 200}}), "robots.cf1.log_rate_hz"),
        (swarm(robots={"cf1": {"uri": "udp://h:1", "initial_position": [1, 2]}}), "robots.cf1.initial_position"),
        (swarm(robots={"cf1": {"uri": "udp://h:1"}, "cf2": {"uri": "udp://h:1"}}), "robots.cf2.uri"),
        (swarm(robots={"cf1": {"uri": "udp://h:1"}, "a1": {"uri": "udp://h:2"}}), "robots.a1"),
        (swarm(all={"battery": {"voltage_critical": 4.0}}), "robots.cf1.battery.voltage_critical"),
        (swarm(station={"min_connected": 2}), "station.min_connected"),
        (swarm(station={"safety": {"geofence_min": [2, 0, 0]}}), "station.safety.geofence_min"),
        (swarm(station={"safety": {"command_age_s": 0.6}}), "station.safety.command_age_s"),
        (swarm(station={"safety": {"geofenze": True}}), "station.safety.geofenze"),
    ],
)
def test_bad_configuration_names_the_field(data: object, field: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse_swarm(data)
    assert error.value.field == field


def test_unreadable_files_are_the_users_to_mend(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        load_swarm(tmp_path / "missing.yaml")
    (tmp_path / "broken.yaml").write_text("robots: {cf1: [")
    with pytest.raises(ConfigError, match="YAML"):
        load_swarm(tmp_path / "broken.yaml")


@pytest.mark.parametrize("name", ["swarm_simulated.yaml", "swarm_radio.yaml"])
def test_examples_are_usable(name: str) -> None:
    settings = load_swarm(CONFIG / name)
    check_budget(radio_loads([(r.name, r.uri, r.command_rate_hz, r.log_rate_hz) for r in settings.robots]), force=False)
    fence = settings.station.safety
    origin = settings.station.room_origin_in_world
    for robot in settings.robots:
        inside = zip(robot.initial_position, origin, fence.geofence_min, fence.geofence_max, strict=True)
        assert all(low <= p - o <= high for p, o, low, high in inside)


# -- radio budget -----------------------------------------------------------------------------------------------------
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


# -- state machine ----------------------------------------------------------------------------------------------------
def machine(*bits: int) -> StateMachine:
    result = StateMachine(lambda before, state, reason: None)
    result.go(State.CONNECTING, "")
    result.go(State.READY, "")
    for info in bits:
        result.observe(info)
    return result


def test_a_flight_goes_through_all_states() -> None:
    seen: list[State] = []
    m = StateMachine(lambda before, state, reason: seen.append(state))
    m.go(State.CONNECTING, "")
    m.go(State.READY, "")
    m.observe(sm.CAN_BE_ARMED)
    m.observe(sm.IS_ARMED)
    m.takeoff("up")
    m.observe(sm.IS_ARMED | sm.IS_FLYING)
    m.land("down")
    m.observe(sm.IS_ARMED | sm.IS_FLYING)
    m.observe(sm.IS_ARMED)
    m.observe(sm.CAN_BE_ARMED)
    assert seen == [1, 2, 3, 4, 5, 3, 2]


def test_one_that_arms_itself_is_ready_until_it_is_told_and_again_once_it_has_landed() -> None:
    m = machine(sm.AUTO_ARM | sm.IS_ARMED)
    on_ground, in_air = sm.AUTO_ARM | sm.IS_ARMED, sm.AUTO_ARM | sm.IS_ARMED | sm.IS_FLYING
    assert m.state is State.READY
    m.arm(True)
    m.observe(sm.AUTO_ARM)  # its pre-flight check begins anew every 30 s: it is not armed for a moment
    assert m.state is State.ARMED
    m.observe(in_air)
    m.land("down")
    m.observe(in_air)
    assert m.state is State.LANDING
    m.observe(on_ground)
    m.observe(on_ground)
    assert m.state is State.READY
    m.arm(True)
    m.observe(on_ground)
    m.arm(False)
    m.observe(on_ground)
    assert m.state is State.READY


@pytest.mark.parametrize("bit", [sm.IS_LOCKED, sm.IS_TUMBLED, sm.IS_CRASHED])
def test_trouble_in_the_air_is_an_emergency_until_reconnected(bit: int) -> None:
    m = machine(sm.IS_ARMED | sm.IS_FLYING, bit)
    assert m.state is State.EMERGENCY
    m.observe(sm.CAN_BE_ARMED)
    assert m.state is State.EMERGENCY
    m.go(State.CONNECTING, "again")
    m.go(State.READY, "")
    assert m.state is State.READY


def test_lost_and_heard_again() -> None:
    m = machine(sm.IS_ARMED | sm.IS_FLYING)
    m.silent("no log")
    assert m.state is State.LOST
    m.land("lost")
    assert m.state is State.LOST
    m.observe(sm.IS_ARMED | sm.IS_FLYING)
    assert m.state is State.LANDING
    m.observe(0)
    assert m.state is State.READY


def test_no_way_around_the_table() -> None:
    m = StateMachine(lambda before, state, reason: None)
    with pytest.raises(LocalProtocolError):
        m.go(State.FLYING, "")


@settings(deadline=None)
@given(st.lists(st.one_of(st.integers(0, 2047), st.sampled_from(["land", "takeoff", "silent", "stop"])), max_size=30))
def test_any_sequence_of_events_keeps_to_the_table(events: list[Any]) -> None:
    m = machine()
    stopped = False
    for event in events:
        if isinstance(event, int):
            m.observe(event)
        elif event == "land":
            m.land("")
        elif event == "takeoff":
            m.takeoff("")
        elif event == "silent":
            m.silent("")
        else:
            m.emergency("")
            stopped = True
        if stopped:
            assert m.state in (State.EMERGENCY, State.LOST)


# -- mailbox ----------------------------------------------------------------------------------------------------------
def test_only_the_latest_command_is_sent_and_orders_go_first() -> None:
    box = Mailbox()
    order = lambda: None  # noqa: E731
    box.put_setpoint(Setpoint("position", (1,), 0.0))
    box.put_setpoint(Setpoint("position", (2,), 0.0))
    assert box.get().arguments == (2,)  # type: ignore[union-attr]
    assert box.replaced == 1
    box.put_background(order)
    box.put_setpoint(Setpoint("position", (3,), 0.0))
    assert box.get() is order
    assert box.get().arguments == (3,)  # type: ignore[union-attr]


def test_an_order_ends_the_stream_and_an_urgent_one_empties_the_box() -> None:
    box = Mailbox()
    urgent = lambda: None  # noqa: E731
    box.put_setpoint(Setpoint("position", (1,), 0.0))
    box.put_order(lambda: None)
    box.put_order(urgent, urgent=True)
    box.close()
    assert box.get() is urgent
    assert box.get() is None


def test_the_mailbox_wakes_its_worker() -> None:
    box = Mailbox()
    got: list[object] = []
    worker = threading.Thread(target=lambda: got.append(box.get()))
    worker.start()
    box.put_setpoint(Setpoint("position", (1,), 0.0))
    worker.join(5)
    assert got


# -- safety rules -----------------------------------------------------------------------------------------------------
def vehicle(name: str = "cf1", **changes: Any) -> Watched:
    values: dict[str, Any] = {
        "name": name,
        "state": State.FLYING,
        "position": (0.0, 0.0, 0.0),
        "battery": 3.9,
        "battery_warning": 3.4,
        "battery_critical": 3.2,
        "log_age": 0.02,
        "command_age": 0.02,
    }
    return Watched(**(values | changes))


def verdicts(*vehicles: Watched, heartbeat: float | None = None, now: float = 0.0, **settings: Any) -> list[tuple]:
    monitor = SafetyMonitor(SafetySettings(**settings))
    return [(v.name, v.action, v.rule) for v in monitor.check(now, vehicles, heartbeat)]


def test_nothing_is_done_without_need() -> None:
    assert verdicts(vehicle(), vehicle("cf2", position=(0.3, 0.0, 0.0)), heartbeat=0.9) == []


@pytest.mark.parametrize(
    ("where", "axis"), [((1.56, 0, 0), "x"), ((-1.56, 0, 0), "x"), ((0, 2.36, 0), "y"), ((0, 0, 1.01), "z")]
)
def test_geofence_lands(where: tuple[float, float, float], axis: str) -> None:
    assert verdicts(vehicle(position=where)) == [("cf1", Action.LAND, "geofence")]
    assert verdicts(vehicle(position=where), geofence=False) == []
    assert verdicts(vehicle(position=where, state=State.READY)) == []
    (verdict,) = SafetyMonitor(SafetySettings()).check(0.0, [vehicle(position=where)], None)
    assert f"in {axis}" in verdict.reason


def test_far_outside_the_fence_the_motors_stop() -> None:
    found = verdicts(vehicle(position=(2.4, 0, 0)))
    assert found == [("cf1", Action.LAND, "geofence"), ("cf1", Action.STOP, "geofence")]
    assert verdicts(vehicle(position=(2.4, 0, 0), state=State.LANDING)) == [("cf1", Action.STOP, "geofence")]


def test_battery_warns_then_lands_but_not_for_a_moment() -> None:
    monitor = SafetyMonitor(SafetySettings())

    def check(now: float, volts: float) -> list[Action]:
        return [v.action for v in monitor.check(now, [vehicle(battery=volts)], None)]

    assert check(0.0, 3.3) == []
    assert check(0.9, 3.5) == []  # a dip: the clock starts again
    assert check(1.0, 3.3) == []
    assert check(2.0, 3.3) == [Action.WARN]
    assert check(3.0, 3.3) == []  # said once
    assert check(4.0, 3.1) == []
    assert check(5.0, 3.1) == [Action.LAND]


def test_silence_loses_a_vehicle() -> None:
    assert verdicts(vehicle(log_age=0.51)) == [("cf1", Action.LOST, "link")]
    assert verdicts(vehicle(log_age=math.inf, state=State.CONNECTING)) == []
    assert verdicts(vehicle(log_age=0.51), link_age_s=0.0) == []


def test_stale_commands_hold_then_land() -> None:
    assert verdicts(vehicle(command_age=0.26)) == [("cf1", Action.HOLD, "commands")]
    assert verdicts(vehicle(command_age=3.1))[1] == ("cf1", Action.LAND, "commands")
    assert verdicts(vehicle(command_age=None)) == []
    assert verdicts(vehicle(command_age=3.1), command_age_s=0.0) == []


def test_a_lost_heartbeat_stops_all_that_could_move() -> None:
    assert verdicts(vehicle(), heartbeat=1.01) == [("", Action.STOP_ALL, "heartbeat")]
    assert verdicts(vehicle(state=State.READY), heartbeat=1.01) == []
    assert verdicts(vehicle(), heartbeat=1.01, heartbeat_s=0.0) == []
    assert verdicts(vehicle(), heartbeat=None) == []


def test_two_too_close_both_land_and_the_third_flies_on() -> None:
    close = [vehicle(), vehicle("cf2", position=(0.1, 0.1, 0.0)), vehicle("cf3", position=(0.0, 1.0, 0.0))]
    assert verdicts(*close) == [("cf1", Action.LAND, "distance"), ("cf2", Action.LAND, "distance")]
    assert verdicts(*close, min_distance_m=0.0) == []


def test_a_rule_speaks_again_after_it_had_ceased() -> None:
    monitor = SafetyMonitor(SafetySettings())
    ages = [0.3, 0.4, 0.02, 0.3]
    assert [len(monitor.check(t, [vehicle(command_age=a)], None)) for t, a in enumerate(ages)] == [1, 0, 0, 1]


# -- real-time priority -----------------------------------------------------------------------------------------------
PRIORITY = """
import os, resource, sys, threading
from dtsa_agent.ros.common.priority import give_way, stay_on_one_processor, take_priority
if len(sys.argv) > 1:  # an ordinary user with that limit
    resource.setrlimit(resource.RLIMIT_RTPRIO, (int(sys.argv[1]),) * 2)
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
over = threading.Event()
threading.Thread(target=over.wait).start()
why = take_priority(7)
policies = {os.sched_getscheduler(int(task)) for task in os.listdir("/proc/self/task")}
assert why or policies == {os.SCHED_RR}, policies
stay_on_one_processor()
assert {len(os.sched_getaffinity(int(task))) for task in os.listdir("/proc/self/task")} == {1}
give_way()
assert os.sched_getscheduler(0) == os.SCHED_OTHER
over.set()
print(why)
"""


def take_all(*arguments: str) -> str:
    command = [sys.executable, "-c", PRIORITY, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_real_time_priority_is_taken_by_all_threads_or_refused_with_a_word() -> None:
    assert take_all() in ("\n", "Operation not permitted; see ulimit -r\n")


def may_raise_limits() -> bool:
    status = Path("/proc/self/status").read_text()
    capabilities = int(next(line.split()[1] for line in status.splitlines() if line.startswith("CapEff")), 16)
    return bool(capabilities >> 24 & 1)  # CAP_SYS_RESOURCE


ORDINARY = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")


@ORDINARY
def test_an_ordinary_user_without_a_grant_gets_no_real_time_priority() -> None:
    assert take_all("0") == "Operation not permitted; see ulimit -r\n"


@ORDINARY
def test_an_ordinary_user_gets_the_real_time_priority_that_is_granted_and_no_more() -> None:
    if take_all() != "\n" or not may_raise_limits():
        pytest.skip("this root may not do that either")
    assert take_all("50") == take_all("7") == "\n"
    assert take_all("6") == "Operation not permitted; see ulimit -r\n"


# -- limits of what is flown ------------------------------------------------------------------------------------------
TWELVE_WRONG_FILES = {
    "the same robot twice": ("robots:\n  cf1: {uri: 'udp://h:1'}\n  cf1: {uri: 'udp://h:2'}\n", "cf1"),
    "a place that is no number": ("robots: {cf1: {uri: 'udp://h:1', initial_position: [.nan, 0, 0]}}", "initial_pos"),
    "a place at infinity": ("robots: {cf1: {uri: 'udp://h:1', initial_position: [0, .inf, 0]}}", "initial_position"),
    "channel 200": ("robots: {cf1: {uri: radio://0/200/2M/E7E7E7E701}}", "channel from 0 to 125"),
    "port 99999": ("robots: {cf1: {uri: 'udp://h:99999'}}", "port from 1 to 65535"),
    "port 0": ("robots: {cf1: {uri: 'udp://h:0'}}", "port from 1 to 65535"),
    "one Crazyflie under two names": (
        "robots: {cf1: {uri: 'radio://0/80/2M/E7E7E7E701'}, cf2: {uri: 'radio://0/80/2M/E7E7E7E701?rate_limit=100'}}",
        "URI of its own",
    ),
    "agent 0": ("robots: {cf0: {uri: 'udp://h:1'}}", "robots.cf0.id"),
    "group 256": ("robots: {cf1: {uri: 'udp://h:1', group_mask: 256}}", "group_mask"),
    "a list of robots": ("robots: [cf1, cf2]", "a mapping"),
    "a parameter that is no number": (
        "robots: {cf1: {uri: 'udp://h:1', firmware_params: {locSrv: {extPosStdDev: .nan}}}}", "extPosStdDev"
    ),
    "a log without a rate": (
        "robots: {cf1: {uri: 'udp://h:1', firmware_logging: {custom_topics: {a: {vars: [pm.vbat]}}}}}", "a.frequency"
    ),
    "a fence without an end": (
        "robots: {cf1: {uri: 'udp://h:1'}}\nstation: {safety: {geofence_max: [1.5, .inf, 1]}}", "geofence_max"
    ),
    "half a file": ("robots: {cf1: {uri: 'udp://h:1'", "YAML"),
    "no text": ("\x00\x01", "YAML"),
}  # fmt: skip


@pytest.mark.parametrize("name", TWELVE_WRONG_FILES)
def test_a_wrong_file_is_answered_clearly(tmp_path: Path, name: str) -> None:
    text, words = TWELVE_WRONG_FILES[name]
    path = tmp_path / "swarm.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_swarm(path)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_places_outside_the_fence_and_speeds_that_nobody_means_are_refused() -> None:
    station = StationSettings()
    assert outside_fence((1.5, 0.0, 1.0), station) == ""
    assert outside_fence((1.95, 0.0, 0.95), station) == "(1.95, 0.00, 0.00) is 0.45 m outside the geofence in x"
    assert outside_fence((0.0, 0.0, 2.5), station).endswith("0.60 m outside the geofence in z")
    open_air = dataclasses.replace(station, safety=SafetySettings(geofence=False))
    assert outside_fence((9.0, 0.0, 1.0), open_air) == ""
    still = (0.0, 0.0, 0.0)
    for setpoint in (
        units.velocity_world((1.5, 0.0, 0.0), 0.0, 0.0),
        units.position((1.0, 2.0, 1.0), 0.0, 0.0),
        units.hover(1.0, 0.0, 0.0, 1.0, 0.0),
        units.full_state((1.0, 0.0, 1.0), still, still, (0.0, 0.0, 0.0, 1.0), still, 0.0),
    ):
        check_stream(setpoint, station)
    for setpoint, words in (
        (units.velocity_world((50.0, 0.0, 0.0), 0.0, 0.0), "50.00 m/s is refused (station.max_stream_mps is 3)"),
        (units.hover(0.0, -50.0, 0.0, 1.0, 0.0), "50.00 m/s"),
        (units.hover(0.0, 0.0, 0.0, 3.0, 0.0), "outside the geofence in z"),
        (units.position((1.95, 0.0, 1.0), 0.0, 0.0), "0.45 m outside the geofence in x"),
        (units.full_state((0.0, 3.0, 1.0), still, still, (0.0, 0.0, 0.0, 1.0), still, 0.0), "geofence in y"),
        (units.full_state((0.0, 0.0, 1.0), (0.0, 9.0, 0.0), still, (0.0, 0.0, 0.0, 1.0), still, 0.0), "9.00 m/s"),
    ):
        with pytest.raises(ValueError, match=re.escape(words)):
            check_stream(setpoint, station)


def test_a_crazyflie_belongs_to_one_bridge(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    first = Claims([("cf1", "radio://0/80/2M/E7E7E7E701"), ("cf2", "radio://0/80/2M/E7E7E7E702")])
    with pytest.raises(ConfigError, match="no other bridge") as error:
        Claims([("cf9", "radio://0/80/2M/E7E7E7E709"), ("a2", "radio://0/80/2M/e7e7e7e702?rate_limit=50")])
    assert error.value.field == "robots.a2.uri"
    Claims([("cf9", "radio://0/80/2M/E7E7E7E709")]).release()  # what it had taken before it was refused is free
    monkeypatch.setenv(SIMULATED_RADIO, str(tmp_path / "radio"))
    Claims([("cf2", "radio://0/80/2M/E7E7E7E702")]).release()  # on another air
    monkeypatch.delenv(SIMULATED_RADIO)
    first.release()
    Claims([("cf2", "radio://0/80/2M/E7E7E7E702")]).release()
