"""Integration: bridges over simulated Crazyradios: gaps of the air, dongles that are pulled, the emergency stop."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("cflib")

from bridge_helpers import FakeFleet, Flight, fake_fleet, flight
from waiting import wait_for

from dtsa_agent.crazyflie.link import SIMULATED_RADIO
from dtsa_agent.crazyflie.state import State

pytestmark = pytest.mark.slow


@contextlib.contextmanager
def radio_flight(
    folder: Path, count: int, station: dict[str, Any], *options: str, strangers: int = 0, radio: str = "0",
    connects: bool = True,
) -> Iterator[tuple[FakeFleet, Flight]]:  # fmt: skip
    """Crazyflies on one dongle (a second one is left), and a bridge that is connected to all but some strangers."""
    every = count + strangers
    data = {
        "robots": {
            f"cf{k}": {"uri": f"radio://{radio}/80/2M/E7E7E7E7{k:02X}", "initial_position": [0.35 * k - 1.25, 0.0, 0.0]}
            for k in range(1, every + 1)
        },
        "all": {"connect_timeout_s": 10.0, "estimator_timeout_s": 5.0},
        "station": {"toc_cache": str(folder / "cache")} | station,
    }
    config, path = folder / "swarm.yaml", folder / "radio"
    config.write_text(yaml.safe_dump(data))
    words = ["--config", str(config), "--simulated-radio", str(path), "--radio-dongles", "2"]
    with pytest.MonkeyPatch.context() as patch, fake_fleet(folder, every, *words, *options) as fleet:
        for k in range(count + 1, every + 1):
            del data["robots"][f"cf{k}"]
        patch.setenv(SIMULATED_RADIO, str(path))
        with flight(data) as pilot:
            missing = pilot.bridge.connect()
            assert missing == [] or not connects, "\n".join(line for _, _, line in pilot.lines)
            yield fleet, pilot


@pytest.mark.realtime
def test_a_dongle_that_is_pulled_is_named_and_its_links_go_on_when_it_is_back(tmp_path: Path) -> None:
    with radio_flight(tmp_path, 2, {"safety": {"emergency_watchdog": False}}) as (fleet, pilot):
        one = pilot.bridge.vehicles["cf1"]
        pilot.bridge.order_each(["cf1", "cf2"], lambda v: v.arm(True))
        wait_for(lambda: pilot.state(1) == pilot.state(2) == State.ARMED)
        assert pilot.bridge.order_each(["cf1"], lambda v: v.takeoff(0.95, 2.0)) == (True, "")
        time.sleep(2.5)
        pulled = time.monotonic()
        fleet.fault("unplug", 1, dongle=0, seconds=5.0)
        wait_for(lambda: pilot.state(1) == pilot.state(2) == State.LOST, 5.0)
        assert pilot.logged("radio 0 .* is gone .*: cf1, cf2 out of reach") - pulled < 1.0
        assert pilot.bridge.vehicles["cf2"].takeoff(0.95, 2.0) != ""
        wait_for(lambda: pilot.bridge.vehicles["cf1"].state in (State.READY, State.ARMED), 20.0)
        assert pilot.logged("radio 0 .* is there again")
        assert fleet.events(1, "land")  # the firmware has held its place until then
        assert fleet.flown(1)[:3] == ["ready to fly", "flying", "landed"]
        assert len(fleet.events(name="takeoff")) == 1
        wait_for(lambda: one.link.can_set)
        one.link.set_parameter("ring.effect", 9)
        wait_for(lambda: one.link.parameters()["ring.effect"][1] == 9)


def test_without_its_dongle_a_link_says_so_and_does_not_connect_for_ever(tmp_path: Path) -> None:
    with radio_flight(tmp_path, 1, {}) as (fleet, pilot):
        fleet.fault("unplug", 1, dongle=0)
        wait_for(lambda: pilot.state(1) == State.LOST, 5.0)
        pilot.bridge.vehicles["cf1"].connect()
        wait_for(lambda: pilot.state(1) == State.DISCONNECTED, 20.0)
        fleet.fault("heal", 1)
        wait_for(lambda: any("is there again" in line for _, _, line in pilot.lines), 5.0)
        pilot.bridge.vehicles["cf1"].connect()
        wait_for(lambda: pilot.state(1) == State.READY, 20.0)


@pytest.mark.realtime
def test_any_dongle_will_do_and_one_that_is_pulled_in_flight_is_followed_by_a_gap(tmp_path: Path) -> None:
    """What once ended in an emergency: a link that was away and came back, then a short gap with losses."""
    station = {"safety": {"emergency_watchdog": False}}
    with radio_flight(tmp_path, 1, station, "--radio-loss", "0.01", radio="*") as (fleet, pilot):
        pilot.take_off()
        fleet.fault("unplug", 1, dongle=0, seconds=0.3)
        wait_for(lambda: any("is there again" in line for _, _, line in pilot.lines), 5.0)
        time.sleep(0.5)
        assert pilot.state(1) == State.FLYING
        fleet.fault("drop", 1, rate=1.0, direction="both", seconds=0.25)
        time.sleep(1.0)
        assert pilot.state(1) == State.FLYING
        pilot.bridge.land_all("test over")
        assert pilot.bridge.wait_landed(lambda: False) == []
        assert not [e for e in fleet.flown(1) if e in ("level out", "locked")]


@pytest.mark.realtime
def test_who_else_sends_on_the_channel_is_warned_of(tmp_path: Path) -> None:
    """As many packets are lost as where somebody else sends all the time."""
    with radio_flight(tmp_path, 2, {"safety": {"link_age_s": 3.0}}, "--radio-loss", "0.25", connects=False) as (
        _,
        pilot,
    ):
        wait_for(lambda: any("does another transmitter use its channel?" in line for _, _, line in pilot.lines), 30.0)


def test_an_emergency_stop_reaches_all_that_listen(tmp_path: Path) -> None:
    """Also those whose acknowledgements are missing, and one that this bridge has never met."""
    with radio_flight(tmp_path, 3, {}, strangers=1) as (fleet, pilot):
        pilot.bridge.order_each(["cf1", "cf2", "cf3"], lambda v: v.arm(True))
        assert pilot.logged("radio 1 is kept for emergency stops")
        fleet.fault("drop", 2, rate=1.0, direction="down")
        fleet.fault("drop", 3, rate=0.9, direction="up")
        pilot.bridge.stop_all("test")
        wait_for(lambda: {e["cf"] for e in fleet.events(name="state") if e["state"] == "locked"} == {1, 2, 3, 4}, 5.0)


def test_an_order_that_was_sent_into_a_gap_is_dropped_after_a_second(tmp_path: Path) -> None:
    with radio_flight(tmp_path, 1, {}, "--arming", "required") as (fleet, pilot):
        fleet.fault("drop", 1, rate=1.0, direction="both", seconds=3.0)
        assert pilot.bridge.vehicles["cf1"].arm(True) == ""
        wait_for(lambda: pilot.state(1) == State.LOST, 5.0)
        wait_for(lambda: pilot.state(1) != State.LOST, 10.0)
        assert pilot.state(1) == State.READY
        assert not fleet.events(1, "armed")


@pytest.mark.realtime
def test_gaps_of_the_air(tmp_path: Path) -> None:
    """One gap a vehicle while commands are streamed, all at one time."""
    gaps = {1: (0.25, "both"), 2: (0.7, "both"), 3: (1.5, "both"), 4: (1.5, "down")}
    with radio_flight(tmp_path, 4, {"safety": {"emergency_watchdog": False}}, "--radio-loss", "0.01") as (fleet, pilot):
        pilot.take_off()
        time.sleep(0.5)
        began = time.monotonic()
        for cf, (seconds, direction) in gaps.items():
            fleet.fault("drop", cf, rate=1.0, direction=direction, seconds=seconds)
        wait_for(lambda: pilot.state(4) == State.LOST, 5.0)
        time.sleep(0.6)
        assert fleet.events(4, "land"), "the blind landing arrives although nothing is acknowledged"
        wait_for(lambda: all(pilot.state(k) != State.LOST for k in gaps), 8.0)
        assert pilot.state(1) == State.FLYING
        wait_for(lambda: all(pilot.state(k) == State.READY for k in (2, 3, 4)), 12.0)
        assert pilot.state(1) == State.FLYING
        assert not fleet.events(name="hard landing")
        assert not [e for e in fleet.events(name="state") if e["state"] == "locked"]
        assert pilot.logged("cf4: .*-> lost", began)
        pilot.bridge.land_all("test over")
        assert pilot.bridge.wait_landed(lambda: False) == []
