"""Integration: faults in flight: cflib over UDP, simulated Crazyflies that fail, and the bridge that must react."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cflib")

from bridge_helpers import FakeFleet, Flight, end_process, fake_fleet, flight, settings
from waiting import wait_for

from dtsa_agent.crazyflie.node.parameters import why_refused
from dtsa_agent.crazyflie.state import State
from dtsa_agent.crazyflie.vehicle import CrazyflieVehicle
from dtsa_bench.crazyflies.simulated.truth import read_truth

pytestmark = [pytest.mark.slow, pytest.mark.alone]
SLACK_S = 0.4  # what scheduling may add to a reaction


@dataclass
class FaultFlight:
    """Eight Crazyflies in the air, six faults at once."""

    fleet: FakeFleet
    flight: Flight
    monotonic: float  # when the faults came, this process's clock
    fleet_time: float  # ... and the fleet's
    states: dict[int, State]  # seven seconds later
    others: list[list[str]]  # what the supervisors of those without a fault went through, up to the ground

    def reacted(self, pattern: str) -> float:
        return self.flight.logged(pattern, self.monotonic) - self.monotonic


@pytest.fixture(scope="module")
def fault_flight(tmp_path_factory: pytest.TempPathFactory) -> FaultFlight:
    with (
        fake_fleet(tmp_path_factory.mktemp("faults"), 8, "--arming", "mixed") as fleet,
        flight(settings(fleet)) as pilot,
    ):
        assert pilot.bridge.connect() == []
        pilot.take_off()
        time.sleep(0.5)
        began = time.monotonic()
        t = fleet.fault("freeze", 1)
        fleet.fault("close", 2)
        fleet.fault("tumble", 3)
        fleet.fault("battery", 4, voltage=3.0)
        pilot.velocity["cf5"] = None
        pilot.velocity["cf6"] = (-1.0, 0.0, 0.0)
        time.sleep(7)
        states = {k: pilot.state(k) for k in range(1, 9)}
        pilot.bridge.land_all("test over")
        pilot.bridge.wait_landed(lambda: False)
        others = [fleet.flown(cf) for cf in (7, 8)]
    return FaultFlight(fleet, pilot, began, t, states, others)


def test_frozen_link_and_closed_socket_are_lost_within_half_a_second(fault_flight: FaultFlight) -> None:
    for cf in (1, 2):
        assert fault_flight.reacted(f"cf{cf}: flying -> lost") < 0.5 + SLACK_S
        assert fault_flight.states[cf] is State.LOST
    # The Crazyflie by itself: level after 0.5 s without setpoints, motors off 1 s after the last watchdog packet.
    level = fault_flight.fleet.state_event(1, "level out")
    assert level["t"] - fault_flight.fleet_time == pytest.approx(0.5, abs=0.15)
    assert fault_flight.fleet.state_event(1, "locked")["reason"] == "emergency watchdog"


def test_tumbled_vehicle_is_an_emergency(fault_flight: FaultFlight) -> None:
    assert fault_flight.reacted(r"cf3: flying -> emergency \(tumbled") < SLACK_S
    assert not any(e["event"] == "streaming" and e["t"] > fault_flight.fleet_time for e in fault_flight.fleet.events(3))


def test_empty_battery_lands(fault_flight: FaultFlight) -> None:
    assert fault_flight.reacted("cf4: battery: .* critical .*: land") < 1.0 + SLACK_S
    assert fault_flight.fleet.events(4, "land")
    assert fault_flight.states[4] in (State.READY, State.ARMED)


def test_commands_that_cease_hold_then_land(fault_flight: FaultFlight) -> None:
    assert fault_flight.reacted("cf5: commands: .*: hold") < 0.25 + SLACK_S
    assert 2.5 < fault_flight.reacted("cf5: commands: .*: land") < 3.0 + SLACK_S
    names = [e["event"] for e in fault_flight.fleet.events(5) if e["t"] > fault_flight.fleet_time]
    # Something to fly comes first: without it the end of the stream would stop the motors.
    assert names[:4] == ["go_to", "stream ended", "go_to", "land"]
    assert "level out" not in [e.get("state") for e in fault_flight.fleet.events(5)]  # the firmware never had to help


def test_geofence_lands_at_once(fault_flight: FaultFlight) -> None:
    times, track, events = read_truth(fault_flight.fleet.truth)
    x = track[:, 0, 5]
    assert x.min() < -1.5
    assert x.min() > -1.5 - 0.8
    crossed = times[np.argmax(x < -1.55)]
    (landing,) = (e["t"] for e in events if e["cf"] == 6 and e["event"] == "land")
    assert landing - crossed < 1.5  # it is braked first: a landing from full speed would swing out far
    assert fault_flight.reacted("cf6: geofence: .* outside the geofence in x") > 0


def test_nobody_else_is_harmed(fault_flight: FaultFlight) -> None:
    assert (fault_flight.states[7], fault_flight.states[8]) == (State.FLYING, State.FLYING)
    times, track, events = read_truth(fault_flight.fleet.truth)
    during = (times > fault_flight.fleet_time) & (times < fault_flight.fleet_time + 6.9)
    for k in (6, 7):
        moved = np.linalg.norm(track[during][:, :, k] - track[during][0, :, k], axis=1)
        assert moved.max() < 0.1
    assert not [e for e in events if e["event"] in ("collision", "crash")]
    # The first one arms itself, the second one is locked by the bridge once it has landed.
    assert [states[:3] for states in fault_flight.others] == 2 * [["ready to fly", "flying", "landed"]]
    assert fault_flight.others[1][3:] == ["pre-flight checks not passed", "pre-flight checks passed"]


@pytest.mark.realtime
def test_too_close_lands_both_and_a_lost_heartbeat_stops_all(tmp_path: Path) -> None:
    with (
        fake_fleet(tmp_path, 3) as fleet,
        flight(settings(fleet, {"safety": {"min_distance_m": 0.35}})) as pilot,
    ):
        pilot.bridge.connect()
        pilot.take_off()
        pilot.velocity["cf1"] = (-0.58, 0.56, 0.0)  # towards cf2
        wait_for(lambda: pilot.state(1) is State.LANDING and pilot.state(2) is State.LANDING)
        assert pilot.state(3) is State.FLYING
        pilot.logged("cf1: distance: 0.3. m from cf2")
        assert not fleet.events(name="collision")
        pilot.bridge.heartbeat = time.monotonic()
        silent = time.monotonic()
        time.sleep(0.7)
        assert pilot.state(3) is State.FLYING
        wait_for(lambda: pilot.state(3) is State.EMERGENCY)
        assert 0.7 < time.monotonic() - silent < 1.0 + SLACK_S
        pilot.logged("all: heartbeat: no heartbeat of the ground station")
        wait_for(lambda: any(e["state"] == "locked" for e in fleet.events(3, "state")), 3)
        assert fleet.state_event(3, "locked")["reason"] == "emergency stop"


@pytest.mark.realtime
def test_rules_that_fail_stop_no_motors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with fake_fleet(tmp_path, 1) as fleet, flight(settings(fleet)) as pilot:
        pilot.bridge.connect()
        pilot.take_off()
        with monkeypatch.context() as broken:
            broken.setattr(pilot.bridge.monitor, "check", lambda *_: 1 / 0)
            time.sleep(1.5)  # longer than the firmware's emergency watchdog waits
        pilot.logged("safety: ZeroDivisionError")
        assert pilot.state(1) is State.FLYING
        assert not [e for e in fleet.events(1, "state") if e["state"] == "locked"]
        pilot.bridge.land_all("test over")
        assert pilot.bridge.wait_landed(lambda: False) == []


@pytest.mark.realtime
def test_rules_of_a_vehicle_that_fail_leave_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with fake_fleet(tmp_path, 2) as fleet, flight(settings(fleet)) as pilot:
        pilot.bridge.connect()
        pilot.take_off()
        failing, other = pilot.bridge.vehicles.values()
        with monkeypatch.context() as broken:
            for part in ("watched_state", "tick"):
                broken.setattr(failing, part, lambda now: 1 / 0)
            pilot.velocity["cf2"] = (0.0, 1.0, 0.0)  # out of the geofence
            wait_for(lambda: other.state is State.LANDING, 20)
        assert sum(line.startswith("safety: ZeroDivisionError") for *_, line in pilot.lines) == 2  # one a part
        pilot.logged("cf2: geofence: ")
        pilot.bridge.land_all("test over")
        assert pilot.bridge.wait_landed(lambda: False) == []


@pytest.mark.realtime
def test_crazyswarm2s_voltages_count_on_the_ground_alone(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, 2) as fleet:
        data = settings(fleet, battery={"voltage_warning": 3.8, "voltage_critical": 3.7})  # of its stock file
        fleet.fault("battery", 1, voltage=3.6)
        with flight(data) as pilot:
            assert pilot.bridge.connect() == []
            one, two = pilot.bridge.vehicles.values()
            assert re.match(r"cf1: battery 3\.[56]. V \(voltage_critical is 3\.7 V\)", one.takeoff(0.5, 2.0))
            assert pilot.state(1) is State.READY  # nor is it armed
            assert two.takeoff(0.5, 2.0) == ""
            wait_for(lambda: pilot.state(2) is State.FLYING)
            fleet.fault("battery", 2, voltage=3.6)
            wait_for(lambda: two.last is not None and two.last.battery < 3.65)
            time.sleep(1.5)  # longer than a rule about batteries waits
            assert pilot.state(2) is State.FLYING
            pilot.bridge.land_all("test over")
            assert pilot.bridge.wait_landed(lambda: False) == []


@pytest.mark.realtime
def test_missing_and_refusing_ones_do_not_ground_the_others(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, 4, "--protocol", "10", "--arming", "required") as fleet:
        data = settings(fleet, connect_attempts=2, connect_timeout_s=1.0)
        fleet.fault("close", 1)
        fleet.fault("freeze", 2)
        fleet.fault("refuse_arming", 3)
        with flight(data) as pilot:
            assert sorted(pilot.bridge.connect()) == ["cf1", "cf2"]
            pilot.bridge.order_each(["cf3", "cf4"], lambda v: v.arm(True))
            wait_for(lambda: pilot.state(4) is State.ARMED)
            pilot.bridge.land_all("armed, but still on the ground: there is nothing to land")
            wait_for(lambda: pilot.state(4) is State.READY)
            wait_for(lambda: fleet.events(4, "state")[-1]["state"] == "pre-flight checks passed")
            assert not fleet.events(4, "land")
            pilot.bridge.order_each(["cf4"], lambda v: v.arm(True))
            wait_for(lambda: pilot.state(4) is State.ARMED)
            done, why = pilot.bridge.order_each(pilot.bridge.vehicles, lambda v: v.takeoff(0.5, 1.0))
            assert (done, "cf3 is ready, not armed" in why) == (False, True)
            wait_for(lambda: pilot.state(4) is State.FLYING)
            assert fleet.events(3, "arming refused")
            # The one that was frozen is heard again and can be connected while another flies.
            fleet.fault("heal", 2)
            assert pilot.bridge.reconnect("cf4") == "cf4 is flying"
            assert pilot.bridge.reconnect("cf2") == ""
            wait_for(lambda: pilot.state(2) is State.READY)
            pilot.bridge.vehicles["cf4"].stop("test")
            wait_for(lambda: any(e["state"] == "locked" for e in fleet.events(4, "state")), 3)


@pytest.mark.realtime
def test_after_a_gap_that_the_firmware_survives_they_fly_on_or_land_under_control(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, 6, "--arming", "mixed") as fleet, flight(settings(fleet)) as pilot:
        assert pilot.bridge.connect() == []
        climbing = threading.Timer(1.5, lambda: fleet.fault("close", 1, seconds=0.65))
        climbing.start()
        pilot.take_off()
        climbing.join()
        pilot.velocity["cf4"] = (0.0, 0.4, 0.0)
        pilot.bridge.vehicles["cf6"].land("before the gap")
        time.sleep(0.7)
        gaps = ((2, "close", 0.3), (3, "close", 0.55), (4, "freeze", 0.6), (5, "close", 0.65), (6, "close", 0.65))
        for cf, silence, gap in gaps:
            fleet.fault(silence, cf, seconds=gap)
        down = (State.READY, State.ARMED)
        wait_for(lambda: all(pilot.state(cf) in down for cf in (1, 3, 4, 5, 6)))
        assert pilot.state(2) is State.FLYING
        for cf in (1, 3, 4, 5, 6):
            pilot.logged(f"cf{cf}: (flying|landing) -> lost")
            assert fleet.flown(cf)[-1] != "locked"
            assert len(fleet.events(cf, "land")) == 1 or cf != 6  # it landed by itself all the while
        assert not [e for e in fleet.events() if e["event"] in ("hard landing", "collision", "crash")]
        # One that was switched off and on has forgotten its log.
        link = pilot.bridge.vehicles["cf6"].link
        fleet.fault("reboot", 6)
        forgotten = link.received
        wait_for(lambda: link.received > forgotten + 20)


def check_parameters(one: CrazyflieVehicle, two: CrazyflieVehicle) -> None:
    known = one.link.parameters()
    assert (known["ring.effect"][1], known["hlCommander.vland"][1]) == (6, 0.5)
    for name, value, problem in (
        ("ring.effect", 7, ""),
        ("ring.effect", 256, "ring.effect: 256 is no uint8_t"),
        ("ring.effect", 1.5, "ring.effect: 1.5 is no uint8_t"),
        ("hlCommander.vland", 0.25, ""),
        ("hlCommander.vland", 1e300, "hlCommander.vland: 1e+300 is no float"),
        ("hlCommander.vland", float("nan"), "hlCommander.vland: nan is not finite"),
        ("firmware.modified", 1, "firmware.modified is read-only"),
    ):
        assert why_refused(name, known[name][0], value) == problem
    one.link.set_parameter("ring.effect", 7)
    wait_for(lambda: one.link.parameters()["ring.effect"][1] == 7)
    assert two.link.parameters()["ring.effect"][1] == 6


@pytest.mark.realtime
def test_one_that_begins_to_listen_later_is_waited_for_and_a_lossy_link_still_connects(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, 2) as fleet:
        fleet.fault("close", 1, seconds=2.0)  # as in a launch, beside the bridge
        # Fills the cache of tables.
        with flight(settings(fleet, connect_attempts=1, connect_timeout_s=20.0)) as pilot:
            assert pilot.bridge.connect() == []
            check_parameters(*pilot.bridge.vehicles.values())
        fleet.fault("drop", 1, rate=0.005)
        with flight(settings(fleet, connect_attempts=20, connect_timeout_s=1.0)) as pilot:
            assert pilot.bridge.connect() == []


PILOT = """
import sys, time, json
sys.path.insert(0, {helpers!r})
from bridge_helpers import flight
data = json.loads(sys.argv[1])
with flight(data) as pilot:
    pilot.bridge.connect()
    pilot.take_off()
    time.sleep(0.5)
    print("flying", flush=True)
    time.sleep(60)
"""


@pytest.mark.realtime
def test_killed_bridge_leaves_it_to_the_firmware(tmp_path: Path) -> None:
    """One bridge with and one without the emergency watchdog, both killed."""
    with fake_fleet(tmp_path, 2) as fleet:
        data = settings(fleet)
        processes = []
        for cf, watchdog in ((1, True), (2, False)):
            one: dict[str, Any] = data | {"robots": {f"cf{cf}": data["robots"][f"cf{cf}"]}}
            one["station"] = data["station"] | {"safety": {"emergency_watchdog": watchdog}}
            code = PILOT.format(helpers=str(Path(__file__).parents[1]))
            command = [sys.executable, "-c", code, json.dumps(one)]
            processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        try:
            for process in processes:
                assert process.stdout is not None
                assert process.stdout.readline() == "flying\n"
        finally:
            for process in processes:
                process.kill()
        killed = fleet.fault("heal")
        for process in processes:
            end_process(process)
        time.sleep(2.8)
        assert fleet.state_event(1, "level out")["t"] - killed == pytest.approx(0.5, abs=0.2)
        locked = fleet.state_event(1, "locked")
        assert locked["reason"] == "emergency watchdog"
        assert 0.7 < locked["t"] - killed < 1.2
        assert fleet.state_event(2, "level out")["t"] - killed == pytest.approx(0.5, abs=0.2)
        fallen = fleet.state_event(2, "locked")
        assert fallen["reason"] == "setpoints ceased"
        assert fallen["t"] - killed == pytest.approx(2.0, abs=0.2)
