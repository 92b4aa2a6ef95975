"""What the simulated Crazyflies' firmware does, and refuses to do."""

from __future__ import annotations

import errno
import struct

import pytest
from craft import Craft
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.crazyflie.state import decompress_quaternion, yaw_of
from dtsa_bench.crazyflies.simulated import crtp, planner
from dtsa_bench.crazyflies.simulated.estimate import attitude, compress, quaternion
from dtsa_bench.crazyflies.simulated.firmware import FLY, OFF, Battery

finite = st.floats(-5, 5, width=32)  # as the firmware counts; the half of the smallest double is not exact


@settings(deadline=None)
@given(finite, finite, finite, finite, st.floats(0.2, 10))
def test_paths_begin_and_end_as_they_should(p0: float, v0: float, a0: float, p1: float, duration: float) -> None:
    path = planner.septic(p0, v0, a0, p1, duration)
    assert planner.evaluate(path, 0.0) == (p0, v0, a0)
    p, v, a = planner.evaluate(path, duration)
    assert (p, v, a) == pytest.approx((p1, 0.0, 0.0), abs=1e-6 / duration**2)


def test_orders_to_groups_that_it_is_not_in_are_nothing_to_it() -> None:
    craft = Craft()
    craft.take_off()
    index = crtp.PARAM_ID["hlCommander.groupmask"]
    for mask, lands in ((0b01, False), (0b10, True)):
        craft.ask(crtp.PARAM, 2, struct.pack("<HB", index, mask))
        assert craft.ask(crtp.HIGH_LEVEL, 0, struct.pack("<BBff?f", 8, 0b10, 0.0, 0.0, True, 1.0))[3] == 0  # type: ignore[index]
        assert (craft.firmware.planner.state == planner.LANDING) == lands


def test_high_level_orders_have_no_effect_or_are_refused_where_the_firmware_says_so() -> None:
    craft = Craft()
    craft.take_off()
    craft.velocity(0.0, 0.0, 0.0)
    land = struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 1.0)
    craft.ask(crtp.HIGH_LEVEL, 0, land)
    craft.fly(0.2)
    craft.velocity(0.0, 0.0, 0.0)  # makes it forget the landing
    craft.fly(0.2)
    assert craft.estimate.position[2] > 0.9
    craft.ask(crtp.HIGH_LEVEL, 0, land)
    craft.ask(crtp.GENERIC_COMMANDER, 1, struct.pack("<BI", 0, 0))
    craft.fly(1.2)
    assert craft.estimate.position[2] < 0.05
    craft = Craft()
    take_off = struct.pack("<BBff?f", 7, 0, 1.0, 0.0, True, 1.0)
    land = struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 1.0)
    assert craft.ask(crtp.HIGH_LEVEL, 0, take_off) == take_off[:3] + bytes([errno.EBUSY])  # not armed
    assert craft.ask(crtp.HIGH_LEVEL, 0, b"\x63") == b"\x63" + bytes([errno.ENOEXEC])
    craft.take_off()
    assert craft.ask(crtp.HIGH_LEVEL, 0, take_off) == take_off[:3] + b"\x01"  # it flies
    assert craft.ask(crtp.HIGH_LEVEL, 0, land) == land[:3] + b"\x00"
    craft.fly(0.5)
    assert craft.ask(crtp.HIGH_LEVEL, 0, land) == land[:3] + b"\x01"  # it lands
    craft.fly(0.6)
    assert craft.mode == OFF


def test_a_stream_that_ends_with_nothing_else_to_fly_stops_the_motors() -> None:
    for ordered_before in (False, True):
        craft = Craft()
        craft.take_off()
        craft.velocity(0.0, 0.0, 0.0)
        craft.fly(0.1)
        hold = struct.pack("<B3B5f", 12, 0, 0, 0, 0.0, 0.0, 1.0, 0.0, 0.5)
        if ordered_before:
            assert craft.ask(crtp.HIGH_LEVEL, 0, hold) == hold[:3] + b"\x00"
        craft.ask(crtp.GENERIC_COMMANDER, 1, struct.pack("<BI", 0, 0))
        craft.fly(0.02)
        assert craft.mode == (FLY if ordered_before else OFF)


def test_landings_are_planned_from_rest_and_ways_from_the_speed_that_is_flown() -> None:
    for order, keeps in ((8, False), (12, True)):
        craft = Craft()
        craft.take_off()
        for _ in range(10):
            craft.velocity(1.0, 0.0, 0.0)
            craft.fly(0.1)
        way = struct.pack("<B3B5f", 12, 0, 0, 0, 3.0, 0.0, 1.0, 0.0, 3.0)
        craft.ask(crtp.HIGH_LEVEL, 0, way if order == 12 else struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 2.0))
        goal = craft.firmware.planner.goal(craft.t)
        assert goal is not None
        assert goal.velocity == ((1.0, 0.0, 0.0) if keeps else (0.0, 0.0, 0.0))
        assert goal.position == pytest.approx(craft.estimate.position, abs=0.011)
    craft.ask(crtp.GENERIC_COMMANDER, 1, struct.pack("<BI", 0, 0))
    craft.fly(1.0)
    before = craft.firmware.planner.goal(craft.t)
    craft.ask(crtp.HIGH_LEVEL, 0, way)  # once more, on the way: speed and acceleration go on
    after = craft.firmware.planner.goal(craft.t)
    assert before is not None
    assert after is not None
    for a, b in ((before.position, after.position), (before.velocity, after.velocity)):
        assert a == pytest.approx(b, abs=0.02)


def test_the_emergency_watchdog_begins_with_its_first_packet_and_latches() -> None:
    craft = Craft()
    craft.take_off()
    for _ in range(4):
        craft.ask(9, 1, b"\x04")
        craft.fly(0.9)
        assert craft.mode == FLY
    craft.fly(0.15)
    assert (craft.mode, craft.state) == (OFF, "locked")
    craft.ask(9, 1, b"\x04")
    craft.fly(0.1)
    assert craft.ask(9, 1, b"\x01\x01") == b"\x81\x00\x00"
    craft.firmware.reset()
    craft.take_off()


def test_arming_needs_a_crazyflie_that_may_fly() -> None:
    craft = Craft()
    craft.firmware.supervisor.refuse_arming = True
    assert craft.ask(9, 1, b"\x01\x01") == b"\x81\x00\x00"
    craft.firmware.supervisor.refuse_arming = False
    craft.velocity(0.0, 0.0, 1.0)
    craft.fly(0.1)
    assert craft.mode == OFF  # not armed: no thrust
    craft.ask(crtp.GENERIC_COMMANDER, 1, struct.pack("<BI", 0, 0))
    assert craft.ask(9, 1, b"\x01\x01") == b"\x81\x01\x01"
    craft.fly(30.5)  # nobody takes off
    assert not craft.firmware.supervisor.armed


def test_one_that_arms_itself_does_so_after_power_on_after_a_landing_and_after_its_timeout() -> None:
    craft = Craft(auto_arming=True)
    craft.fly(0.02)
    assert (craft.state, craft.firmware.supervisor.armed) == ("ready to fly", True)
    info = craft.ask(9, 0, b"\x0c")
    assert info is not None
    assert info[1] & 0b1110 == 0b1110  # armed, by itself, may fly
    craft.take_off()
    craft.ask(crtp.HIGH_LEVEL, 0, struct.pack("<BBff?f", 8, 0, 0.0, 0.0, True, 1.0))
    craft.fly(1.0 + 2.0 + 3.0 + 0.2)
    again = ["landed", "pre-flight checks not passed", "pre-flight checks passed", "ready to fly"]
    assert [e["state"] for name, e in craft.events if name == "state"] == ["ready to fly", "flying", *again]
    craft.fly(30.1)
    assert [e["state"] for name, e in craft.events if name == "state"][-3:] == again[1:]
    assert craft.ask(9, 1, b"\x01\x00") == b"\x81\x01\x00"  # disarmed ...
    craft.fly(0.05)
    assert craft.firmware.supervisor.armed  # ... for a moment


def test_full_state_setpoints_and_yaw() -> None:
    craft = Craft()
    craft.take_off()
    bits = compress(quaternion(0.0, 0.0, 1.0))
    packet = struct.pack("<B9hI3h", 6, 200, -100, 1100, 0, 0, 0, 0, 0, 0, bits, 0, 0, 0)
    for _ in range(40):
        craft.ask(crtp.GENERIC_COMMANDER, 0, packet)
        craft.fly(0.1)
    assert craft.estimate.position == pytest.approx((0.2, -0.1, 1.1), abs=0.01)
    assert craft.firmware.yaw == pytest.approx(1.0, abs=0.01)


@settings(deadline=None)
@given(st.floats(-3.1, 3.1))
def test_heading_survives_compression(yaw: float) -> None:
    assert yaw_of(decompress_quaternion(compress(quaternion(0.1, -0.2, yaw)))) == pytest.approx(yaw, abs=0.01)


def test_a_quadcopter_leans_where_it_accelerates() -> None:
    roll, pitch = attitude((2.0, 0.0, 0.0), 0.0)
    assert (roll, pitch > 0.1) == (pytest.approx(0.0), True)  # forward: nose down, positive in REP-103
    roll, pitch = attitude((0.0, 2.0, 0.0), 0.0)
    assert (roll < -0.1, pitch) == (True, pytest.approx(0.0))  # to the left: left side down


def test_battery_drains_in_flight_and_can_be_forced() -> None:
    battery = Battery()
    full = battery.voltage
    battery.update(210.0, motors=True)
    assert battery.charge == pytest.approx(0.5)
    assert battery.voltage < full - 0.4
    battery.force(3.0, motors=True)
    assert battery.voltage == pytest.approx(3.0)
