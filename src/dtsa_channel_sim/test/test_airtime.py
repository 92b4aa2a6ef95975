"""Radios by name: the times of their lines, and the shortest slots that follow."""

from dtsa_agent.air.port import flight_ns
from dtsa_agent.air.serial_modems import HEADER, LONGEST, MODEMS
from dtsa_agent.air.settings import SerialSettings
from dtsa_agent.core import SwarmConfig
from dtsa_channel_sim.model.airtime import RADIOS, Airtime, Line, RadioRow, airtime_of


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
