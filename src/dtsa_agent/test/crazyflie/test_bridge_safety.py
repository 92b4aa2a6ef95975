"""State machine, mailbox, safety rules and limits of the bridge: without ROS and without links."""

from __future__ import annotations

import errno
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.crazyflie import commands
from dtsa_agent.crazyflie import state as sm
from dtsa_agent.crazyflie.orders import LAND, TAKEOFF, RepeatedOrder
from dtsa_agent.crazyflie.safety import (
    ESTIMATE_HOLD_S,
    Action,
    SafetyMonitor,
    SafetySettings,
    WatchedVehicle,
    outside_fence,
)
from dtsa_agent.crazyflie.settings import GroundStationSettings, RobotSettings
from dtsa_agent.crazyflie.state import State, StateMachine
from dtsa_agent.crazyflie.vehicle import CrazyflieVehicle

if TYPE_CHECKING:
    from dtsa_agent.crazyflie.drivers import Mailbox


def machine(*bits: int) -> StateMachine:
    result = StateMachine(lambda before, state, reason: None)
    result.enter(State.CONNECTING, "")
    result.enter(State.READY, "")
    for info in bits:
        result.update(info)
    return result


def test_one_that_arms_itself_is_ready_until_it_is_told_and_again_once_it_has_landed() -> None:
    m = machine(sm.AUTO_ARM | sm.IS_ARMED)
    on_ground, in_air = sm.AUTO_ARM | sm.IS_ARMED, sm.AUTO_ARM | sm.IS_ARMED | sm.IS_FLYING
    assert m.state is State.READY
    m.arming_ordered = True
    m.update(sm.AUTO_ARM)  # its pre-flight check begins anew every 30 s: it is not armed for a moment
    assert m.state is State.ARMED
    m.update(in_air)
    m.note_landing("down")
    m.update(in_air)
    assert m.state is State.LANDING
    m.update(on_ground)
    m.update(on_ground)
    assert m.state is State.READY
    m.arming_ordered = True
    m.update(on_ground)
    m.arming_ordered = False
    m.update(on_ground)
    assert m.state is State.READY


@pytest.mark.parametrize("bit", [sm.IS_LOCKED, sm.IS_TUMBLED, sm.IS_CRASHED])
def test_trouble_in_the_air_is_an_emergency_until_reconnected(bit: int) -> None:
    m = machine(sm.IS_ARMED | sm.IS_FLYING, bit)
    assert m.state is State.EMERGENCY
    m.update(sm.CAN_BE_ARMED)
    assert m.state is State.EMERGENCY
    m.enter(State.CONNECTING, "again")
    m.enter(State.READY, "")
    assert m.state is State.READY


def test_lost_and_heard_again() -> None:
    m = machine(sm.IS_ARMED | sm.IS_FLYING)
    m.note_lost_link("no log")
    assert m.state is State.LOST
    m.note_landing("lost")
    assert m.state is State.LOST
    m.update(sm.IS_ARMED | sm.IS_FLYING)
    assert m.state is State.LANDING
    m.update(0)
    assert m.state is State.READY


@settings(deadline=None)
@given(st.lists(st.one_of(st.integers(0, 2047), st.sampled_from(["land", "takeoff", "silent", "stop"])), max_size=30))
def test_whatever_comes_a_stopped_one_stays_stopped(events: list[Any]) -> None:
    m = machine()
    stopped = False
    for event in events:
        if isinstance(event, int):
            m.update(event)
        elif event == "land":
            m.note_landing("")
        elif event == "takeoff":
            m.note_takeoff("")
        elif event == "silent":
            m.note_lost_link("")
        else:
            m.note_emergency_stop("")
            stopped = True
        if stopped:
            assert m.state in (State.EMERGENCY, State.LOST)


SETPOINT, POSITION = b"\x7c\x08", b"\x6c\x01"
GO_TO, LAND_ORDER, NOTIFY, WATCHDOG, STOP = b"\x8c\x0c1", b"\x8c\x08", b"\x7d\x00", b"\x9d\x04", b"\x9d\x03"
PARAMETER, LOG = b"\x2e\x01", b"\x5d\x05"


def taken(box: Mailbox) -> list[bytes]:
    return [waiting[1] for waiting in iter(box.pop, None)]


def mailbox(*packets: bytes) -> Mailbox:
    pytest.importorskip("cflib")
    from dtsa_agent.crazyflie.drivers import Mailbox

    box = Mailbox()
    for packet in packets:
        box.add(packet)
    return box


def test_only_the_latest_command_is_sent_orders_go_first_and_the_others_take_turns() -> None:
    box = mailbox(PARAMETER, SETPOINT + b"1", POSITION, SETPOINT + b"2", WATCHDOG, LOG)
    assert taken(box) == [WATCHDOG, SETPOINT + b"2", PARAMETER, POSITION, LOG]
    assert taken(mailbox(SETPOINT, WATCHDOG, WATCHDOG)) == [WATCHDOG, SETPOINT]


def test_an_order_ends_the_stream_and_an_emergency_stop_empties_the_box() -> None:
    assert taken(mailbox(SETPOINT, GO_TO, NOTIFY, GO_TO)) == [GO_TO, NOTIFY, GO_TO]
    assert taken(mailbox(SETPOINT, GO_TO, PARAMETER, STOP, STOP, STOP)) == [STOP, STOP, STOP]


def test_an_order_that_has_waited_for_long_takes_nobody_by_surprise(monkeypatch: pytest.MonkeyPatch) -> None:
    box = mailbox(GO_TO, STOP)
    box.add(LAND_ORDER)
    old = mailbox(SETPOINT, POSITION, PARAMETER)
    later = time.monotonic() + 1.1
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert taken(box) == [STOP]
    assert taken(old) == [PARAMETER]
    flood = mailbox(*(GO_TO + bytes((k,)) for k in range(200)))
    assert 0 < len(taken(flood)) < 50


def vehicle(name: str = "cf1", **changes: Any) -> WatchedVehicle:
    values: dict[str, Any] = {
        "name": name, "state": State.FLYING, "position": (0.0, 0.0, 0.0), "battery": 3.9, "battery_warning": 3.4,
        "battery_critical": 3.2, "log_age": 0.02, "command_age": 0.02,
    }  # fmt: skip
    return WatchedVehicle(**(values | changes))


def verdicts(
    *vehicles: WatchedVehicle, heartbeat: float | None = None, now: float = 0.0, **settings: Any
) -> list[tuple]:
    monitor = SafetyMonitor(SafetySettings(**settings))
    return [(v.name, v.action, v.rule) for v in monitor.check(now, vehicles, heartbeat)]


def test_nothing_is_done_without_need() -> None:
    assert verdicts(vehicle(), vehicle("cf2", position=(0.3, 0.0, 0.0)), heartbeat=0.9) == []


@pytest.mark.parametrize(
    ("where", "axis"), [((1.56, 0, 0), "x"), ((-1.56, 0, 0), "x"), ((0, 2.36, 0), "y"), ((0, 0, 1.01), "z")]
)
def test_geofence_lands(where: tuple[float, float, float], axis: str) -> None:
    (verdict,) = SafetyMonitor(SafetySettings()).check(0.0, [vehicle(position=where)], None)
    assert (verdict.name, verdict.action, verdict.rule) == ("cf1", Action.LAND, "geofence")
    assert f"in {axis}" in verdict.reason


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


STALE, WRONG = ("cf1", Action.HOLD, "commands"), ("cf1", Action.HOLD, "estimate")
FENCE, LOST = ("cf1", Action.LAND, "geofence"), ("cf1", Action.LOST, "link")
FAR = (2.4, 0, 0)


@pytest.mark.parametrize(
    ("changes", "others", "expected"),
    [
        ({"position": FAR}, {}, [FENCE, ("cf1", Action.STOP, "geofence")]),  # the motors stop
        ({"position": FAR, "state": State.LANDING}, {}, [("cf1", Action.STOP, "geofence")]),
        ({"position": FAR}, {"geofence": False}, []),
        ({"position": (1.56, 0, 0), "state": State.READY}, {}, []),
        ({"log_age": 0.51}, {}, [LOST]),
        ({"log_age": math.inf, "state": State.CONNECTING}, {}, []),
        ({"log_age": 0.51}, {"link_age_s": 0.0}, []),
        ({"command_age": 0.26}, {}, [STALE]),
        ({"command_age": 3.1}, {}, [STALE, ("cf1", Action.LAND, "commands")]),
        ({"command_age": None}, {}, []),
        ({"command_age": 3.1}, {"command_age_s": 0.0}, []),
        ({"wrong": "drifts", "wrong_s": ESTIMATE_HOLD_S}, {}, [WRONG]),
        ({"wrong": "drifts", "wrong_s": ESTIMATE_HOLD_S + 0.01}, {}, [WRONG, ("cf1", Action.LAND, "estimate")]),
        ({"wrong": "drifts", "state": State.LANDING}, {}, [("cf1", Action.LAND, "estimate")]),
        ({"wrong": "drifts", "state": State.READY}, {}, []),
        ({"wrong_s": 9.0}, {}, []),
        ({}, {"heartbeat": 1.01}, [("", Action.STOP_ALL, "heartbeat")]),
        ({"state": State.READY}, {"heartbeat": 1.01}, []),
        ({}, {"heartbeat": 1.01, "heartbeat_s": 0.0}, []),
        ({}, {"heartbeat": None}, []),
    ],
)
def test_each_trouble_has_its_reaction(changes: dict[str, Any], others: dict[str, Any], expected: list[tuple]) -> None:
    assert verdicts(vehicle(**changes), **others) == expected


def test_two_too_close_both_land_and_the_third_flies_on() -> None:
    close = [vehicle(), vehicle("cf2", position=(0.1, 0.1, 0.0)), vehicle("cf3", position=(0.0, 1.0, 0.0))]
    assert verdicts(*close) == [("cf1", Action.LAND, "distance"), ("cf2", Action.LAND, "distance")]
    assert verdicts(*close, min_distance_m=0.0) == []


def test_what_is_exactly_at_a_limit_is_still_allowed() -> None:
    hold, land = Action.HOLD, Action.LAND
    fence = {"geofence_tolerance_m": 0.25, "geofence_hard_m": 0.5}
    for x, actions in ((1.75, []), (1.7501, [land]), (2.0, [land]), (2.0001, [land, Action.STOP])):
        assert [v[1] for v in verdicts(vehicle(position=(x, 0, 0)), **fence)] == actions
    assert verdicts(vehicle(battery=3.4), battery_s=0.0) == []
    assert [v[1] for v in verdicts(vehicle(battery=3.2), battery_s=0.0)] == [Action.WARN]
    assert verdicts(vehicle(log_age=0.5)) == []
    for rule in ("command", "position"):
        ages = {f"{rule}_age_s": 0.25, f"{rule}_land_s": 3.0}
        for age, actions in ((0.25, []), (3.0, [hold]), (3.1, [hold, land])):
            assert [v[1] for v in verdicts(vehicle(**{f"{rule}_age": age}), **ages)] == actions
    apart = vehicle(), vehicle("cf2", position=(0.25, 0.0, 0.0))
    assert verdicts(*apart, min_distance_m=0.25) == []
    assert verdicts(vehicle(), heartbeat=1.0) == []


def test_a_rule_speaks_again_after_it_had_ceased() -> None:
    monitor = SafetyMonitor(SafetySettings())
    ages = [0.3, 0.4, 0.02, 0.3]
    assert [len(monitor.check(t, [vehicle(command_age=a)], None)) for t, a in enumerate(ages)] == [1, 0, 0, 1]


@pytest.mark.parametrize(("setpoint", "words"), [
    *((commands.velocity_world(v, 0.0, 0.0), "") for v in ((3.0, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, -3.0))),
    (commands.velocity_world((0.0, 3.01, 0.0), 0.0, 0.0), "3.01 m/s is refused (station.max_stream_mps is 3)"),
    (commands.velocity_world((50.0, 0.0, 0.0), 0.0, 0.0), "50.00 m/s is refused (station.max_stream_mps is 3)"),
    (commands.Setpoint(commands.POSITION, (1.0, 2.0, 1.0, 0.0), 0.0, (1.0, 2.0, 1.0)), ""),
    (commands.Setpoint(commands.POSITION, (), 0.0, (1.95, 0.0, 1.0)), "0.45 m outside the geofence in x"),
    (commands.Setpoint(commands.FULL_STATE, (), 0.0, (0.0, 3.0, 1.0)), "geofence in y"),
    (commands.Setpoint(commands.FULL_STATE, (), 0.0, (0.0, 0.0, 1.0), 9.0), "9.00 m/s"),
])  # fmt: skip
def test_places_outside_the_fence_and_speeds_that_nobody_means_are_refused(
    setpoint: commands.Setpoint, words: str, tmp_path: Path
) -> None:
    robot = RobotSettings(name="cf1", id=1, uri="udp://127.0.0.1:1")
    one = CrazyflieVehicle(robot, GroundStationSettings(), tmp_path, lambda level, line: None)
    one.machine.enter(State.FLYING, "")
    problem = one.command(setpoint)
    assert (words in problem, bool(problem), one.refused) == (True, bool(words), bool(words))


def test_how_far_a_place_is_outside_the_fence() -> None:
    fence, origin = SafetySettings(), (0.0, 0.0, 0.95)
    assert outside_fence((1.5, 0.0, 1.0), fence, origin) == ""
    assert outside_fence((1.95, 0.0, 0.95), fence, origin) == "(1.95, 0.00, 0.00) is 0.45 m outside the geofence in x"
    assert outside_fence((0.0, 0.0, 2.5), fence, origin).endswith("0.60 m outside the geofence in z")
    assert outside_fence((9.0, 0.0, 1.0), SafetySettings(geofence=False), origin) == ""


def test_a_take_off_is_ordered_again_while_the_supervisor_lets_no_motor_run() -> None:
    """A Crazyflie that arms itself refuses orders for a moment, three seconds after it has landed."""
    takeoff: int = 7
    sent: list[int] = []
    order = RepeatedOrder(TAKEOFF, sent.append, None, 0.0)
    for attempt in range(1, 4):
        assert order.note_answer(takeoff, errno.EBUSY) == ""
        send = order.due(attempt * 0.2)
        assert send is not None
        send(attempt)
    assert order.note_answer(takeoff, errno.EBUSY) == "refuses the take-off (error 16)"
    order = RepeatedOrder(TAKEOFF, sent.append, None, 10.0)
    assert order.note_answer(takeoff, errno.EBUSY) == order.note_answer(takeoff, 0) == ""
    assert order.due(11.0) is None
    assert "refuses the landing" in RepeatedOrder(LAND, sent.append, None, 20.0).note_answer(8, errno.EBUSY)
