"""Radios: their times, and their lines: what waits, what is cut, what has no room, and when frames arrive."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.air.port import flight_ns
from dtsa_agent.air.serial_modems import HEADER, LONGEST, MODEMS
from dtsa_agent.air.settings import SerialSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import LocalProtocolError
from dtsa_channel_sim import Air, Channel, ChannelConfig
from dtsa_channel_sim.model.airtime import RADIOS, Airtime, Line, RadioRow, airtime_of

MS = 1_000_000
AIRTIME = RADIOS["crazyflie"].airtime
TOTAL, BACK = AIRTIME.total_ns(56), AIRTIME.from_radio_ns(56)


def line(agents=6, **config):
    return Air(Channel(ChannelConfig(agents=agents, radio="crazyflie", **config)))


@pytest.mark.parametrize(("later_ns", "waits_ns"), [(-1, 0), (0, BACK), (1, BACK - 1), (BACK - 1, 1), (BACK, 0)])
def test_an_own_frame_waits_while_its_radio_hands_a_reception_over(later_ns, waits_ns):
    air = line()
    air.begin("heard", 1, 0, 56)
    air.begin("own", 2, TOTAL + later_ns, 56)
    verdicts = {v.frame_id: v for v in air.resolve(10 * MS)}
    assert verdicts["own"].start_ns == TOTAL + later_ns + waits_ns
    # Handed over a moment earlier it cuts the reception instead.
    assert verdicts["heard"].received[1] == (later_ns >= 0)


def test_an_own_frame_goes_before_the_next_reception_and_that_one_waits_for_nothing():
    """Agent 3 has two receptions, and a frame of its own while it hands the first one over."""
    air = line(agents=3)
    second = TOTAL - AIRTIME.ramp_up_ns
    air.begin("first", 1, 0, 56)
    air.begin("second", 2, second, 20)
    air.begin("own", 3, TOTAL + 1, 56)
    verdicts = {v.frame_id: v for v in air.resolve(10 * MS)}
    assert verdicts["first"].received.tolist() == [False, False, True]  # agent 2 turned to sending
    ends = second + AIRTIME.total_ns(20)
    assert ends < TOTAL + BACK
    assert verdicts["second"].received[2]
    assert verdicts["own"].start_ns == TOTAL + BACK
    assert verdicts["second"].arrival_ns == TOTAL + BACK + AIRTIME.from_radio_ns(20)


def test_a_radio_sends_its_own_frames_one_after_the_other():
    air = line()
    for frame_id, at_ns in (("one", 0), ("two", 10), ("three", 20)):
        air.begin(frame_id, 1, at_ns, 56)
    verdicts = air.resolve(10 * MS)
    assert [(v.frame_id, v.start_ns, v.collided) for v in verdicts] == [
        ("one", 0, 0), ("two", TOTAL, 0), ("three", 2 * TOTAL, 0),
    ]  # fmt: skip


def test_no_frame_takes_longer_than_the_latest_time():
    """The own frame waits for the longest reception, and is the eighth that a receiver holds."""
    assert AIRTIME.latest_ns(56) == BACK + TOTAL + 8 * BACK
    air = line()
    for k in range(200):
        air.begin(k, k % 6 + 1, k * 300_000, 56)
    for verdict in air.resolve(1000 * MS):
        assert verdict.arrival_ns - verdict.start_ns <= TOTAL + 8 * BACK


def test_a_radio_holds_eight_receptions_and_loses_the_ninth():
    """Back to back a frame of 56 bytes comes every 0.27 ms, and takes 0.64 ms to be handed over.

    The senders do not hear each other, so none of them waits.
    """
    deaf = {"from": list(range(1, 21)), "to": list(range(1, 21)), "loss": 1}
    air, bits = line(agents=21, link_loss=[deaf]), AIRTIME.on_air_ns(56)
    for k in range(20):
        air.begin(k, k + 1, k * bits, 56)
    verdicts = air.resolve(100 * MS)
    at_last = [bool(v.received[20]) for v in verdicts]
    through: list[int] = []
    for k, verdict in enumerate(verdicts):  # a queue by hand
        end = AIRTIME.ramp_up_ns + (k + 1) * bits
        through = [at for at in through if at > end]
        held = len(through)
        assert at_last[k] == (held < 8)
        if held < 8:
            through.append((through[-1] if through else end) + BACK)
        assert verdict.lost + verdict.collided == 19 + (held >= 8)
    assert at_last.index(False) == 13  # 8 are held, and 5 handed over


@given(st.lists(st.lists(st.integers(1, 6), unique=True, max_size=2), min_size=1, max_size=30), st.integers(0, 99))
@settings(max_examples=60, deadline=None)
def test_slots_that_are_long_enough_know_nothing_of_the_line(slots, seed):
    """The same verdicts as with radios without one, in the shortest slots that fit."""
    slot_ns = AIRTIME.shortest_slot_ns(56, guard_ns=0)
    plain, true = (
        Air(Channel(ChannelConfig(agents=6, slot_ns=slot_ns, loss=0.2, seed=seed, radio=radio)))
        for radio in ("plain", "crazyflie")
    )
    for air in (plain, true):
        for slot, senders in enumerate(slots):
            for sender in senders:
                air.begin((slot, sender), sender, slot * slot_ns, 56)
    one, other = (
        [(v.frame_id, v.start_ns, v.received.tolist(), v.lost, v.collided) for v in air.resolve(100 * MS)]
        for air in (plain, true)
    )
    assert one == other


def test_a_radio_that_waits_begins_and_is_sensed_later():
    air = line()
    air.begin("heard", 1, 0, 56)
    air.begin("own", 2, TOTAL + 1, 56)
    begins = TOTAL + BACK + AIRTIME.ramp_up_ns
    assert not air.busy(3, begins - 1)
    assert air.busy(3, begins)
    assert [v.frame_id for v in air.resolve(10 * MS)] == ["heard", "own"]


def test_what_a_crazyflie_cannot_send_is_refused():
    air = line()
    with pytest.raises(LocalProtocolError, match="length 61: a frame has 1 to 60 bytes"):
        air.begin(0, 1, 0, 61)
    assert np.array_equal(air.resolve(MS), [])


def test_airtimes_of_the_radio():
    airtime = Airtime()
    assert airtime.on_air_ns(24) == 140_500
    assert airtime.on_air_ns(60) == 284_500
    assert airtime.total_ns(60) == 414_500
    assert Airtime(bitrate=3_000_000_0).on_air_ns(1) == -(-97 * 1000 // 30)


def test_a_line_of_one_megabaud_takes_ten_microseconds_a_byte():
    airtime = RADIOS["crazyflie"].airtime
    assert (airtime.to_radio_ns(56), airtime.from_radio_ns(56)) == (630_000, 640_000)
    assert (airtime.to_radio_ns(0), airtime.from_radio_ns(0)) == (70_000, 80_000)
    assert (airtime.line.waits, airtime.line.queue, airtime.longest) == (True, 8, 60)


def test_a_policy_that_needs_the_frame_pays_both_ways_and_the_decision():
    airtime = RADIOS["crazyflie"].airtime
    on_air = airtime.total_ns(56) + 140_000
    assert airtime.shortest_slot_ns(56, guard_ns=70_000) == on_air + 640_000  # the radio hands over, then it sends
    needs = airtime.shortest_slot_ns(56, guard_ns=70_000, decide_ns=780_000, needs_frame=True)
    assert needs == on_air + 640_000 + 780_000 + 630_000


def test_a_line_that_works_beside_the_radio_costs_a_slot_only_where_it_is_the_slowest_part():
    quick, slow = (Airtime(line=Line(0, byte_ns, 0, byte_ns)) for byte_ns in (1_000, 100_000))
    assert quick.shortest_slot_ns(19, guard_ns=0) == quick.total_ns(19)
    assert slow.shortest_slot_ns(19, guard_ns=0) == 1_900_000
    assert slow.shortest_slot_ns(19, guard_ns=0, decide_ns=2_000_000) == 2_000_000


def test_settings_of_the_air_count_where_the_radio_has_them(monkeypatch):
    own = Airtime(bitrate=64_000, ramp_up_ns=1, formula=lambda length: 1_000 * length)
    monkeypatch.setitem(RADIOS, "modem", RadioRow(own, "a modem", "made up"))
    assert airtime_of("modem", 2_000_000, 130_000, 300_000).total_ns(20) == 20_001
    assert airtime_of("plain", 1_000_000, 5, 7).line == Line(7, 0, 7, 0)
    tuned = airtime_of("crazyflie", 1_000_000, 5, 7)
    assert (tuned.bitrate, tuned.ramp_up_ns, tuned.line) == (1_000_000, 5, RADIOS["crazyflie"].airtime.line)


def test_modems_take_what_agents_over_serial_lines_expect_of_them():
    for name, modem in MODEMS.items():
        if name == "none":
            assert name not in RADIOS
            continue
        airtime = RADIOS[name].airtime
        config = SwarmConfig(agents=2, policy="lease", slot_ms=900.0, auth=True, auth_session=1)
        port = SerialSettings(device="x", modem=name, baud=modem.baud).properties
        assert port.header(config.auth).size == HEADER
        length = config.frame_length
        way_ns = airtime.to_radio_ns(length) + airtime.total_ns(length) + airtime.from_radio_ns(length) + modem.turn_ns
        assert abs(flight_ns(config, port) - way_ns) < 1_500_000  # symbols of LoRa are whole ones
        assert port.longest == min(LONGEST, airtime.longest + HEADER)
