"""Integration: bridges over simulated Crazyradios: gaps of the air, links that cflib closes, the emergency stop."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

pytest.importorskip("cflib")

from bridge_helpers import FakeFleet, Flight, fake_fleet, flight
from waiting import wait_for

from dtsa_agent.crazyflie.links.link import SIMULATED_RADIO
from dtsa_agent.crazyflie.links.radio_link import RadioPort
from dtsa_agent.crazyflie.state.state_machine import State

pytestmark = pytest.mark.slow


@contextlib.contextmanager
def radio_flight(
    folder: Path, count: int, station: dict[str, Any], *options: str, strangers: int = 0
) -> Iterator[tuple[FakeFleet, Flight]]:
    """Crazyflies on one dongle (a second one is left), and a bridge that is connected to all but some strangers."""
    every = count + strangers
    data = {
        "robots": {
            f"cf{k}": {"uri": f"radio://0/80/2M/E7E7E7E7{k:02X}", "initial_position": [0.5 * k - 1.25, 0.0, 0.0]}
            for k in range(1, every + 1)
        },
        "all": {"connect_timeout_s": 10.0, "estimator_timeout_s": 5.0},
        "station": {"toc_cache": str(folder / "cache")} | station,
    }
    config, path = folder / "swarm.yaml", folder / "radio"
    config.write_text(yaml.safe_dump(data))
    radio = ["--config", str(config), "--simulated-radio", str(path), "--radio-dongles", "2"]
    with pytest.MonkeyPatch.context() as patch, fake_fleet(folder, every, *radio, *options) as fleet:
        for k in range(count + 1, every + 1):
            del data["robots"][f"cf{k}"]
        patch.setenv(SIMULATED_RADIO, str(path))
        with flight(data) as pilot:
            assert pilot.bridge.connect() == [], pilot.lines
            yield fleet, pilot


@pytest.mark.realtime
def test_a_link_that_cflib_closes_is_opened_again_in_flight(tmp_path: Path) -> None:
    with radio_flight(tmp_path, 2, {"safety": {"emergency_watchdog": False}}) as (fleet, pilot):
        one = pilot.bridge.vehicles["cf1"]
        pilot.take_off()
        link = one.link
        link._cf.link.link_error_callback("Too many packets lost")  # as cflib does it after 100 of them
        assert pilot.logged("cf1: flying -> lost .*Too many packets lost")
        wait_for(lambda: link.reopened == 1 and pilot.state(1) != State.LOST, 5.0)
        wait_for(lambda: pilot.state(1) == State.FLYING)
        # Parameters can be set again once cflib has read them; nothing waits for that.
        wait_for(lambda: one.onboard.settable)
        one.onboard.set_parameter("ring.effect", 9)
        wait_for(lambda: one.onboard.parameters()["ring.effect"].value == 9)
        pilot.bridge.land_all("test over")
        assert pilot.bridge.wait_landed(lambda: False) == []
        assert [e for e in fleet.flown(1) if e in ("level out", "locked")] in ([], ["level out"])


def test_an_emergency_stop_reaches_all_that_listen(tmp_path: Path) -> None:
    """Also those whose acknowledgements are missing, and one that this bridge has never met."""
    with radio_flight(tmp_path, 3, {}, strangers=1) as (fleet, pilot):
        pilot.bridge.each(["cf1", "cf2", "cf3"], lambda v: v.arm(True))
        assert pilot.logged("radio 1 is kept for emergency stops")
        fleet.fault("drop", 2, rate=1.0, direction="down")
        fleet.fault("drop", 3, rate=0.9, direction="up")
        pilot.bridge.stop_all("test")
        wait_for(lambda: {e["cf"] for e in fleet.events(name="state") if e["state"] == "locked"} == {1, 2, 3, 4}, 5.0)


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


def test_whoever_looks_for_room_wakes_those_that_wait_for_it() -> None:
    """cflib's own threads wait in `put`; one that slept on would hold the lock of all senders for two seconds."""
    waiting: queue.Queue[int] = queue.Queue(1)
    waiting.put(1)
    port = RadioPort(SimpleNamespace(link=SimpleNamespace(out_queue=waiting)))
    looks = threading.Thread(target=port.wait_for_room, args=(60.0,), daemon=True)
    puts = threading.Thread(target=waiting.put, args=(2, True, 60.0), daemon=True)
    for number, thread in enumerate((looks, puts), 1):
        thread.start()
        wait_for(lambda number=number: len(waiting.not_full._waiters) == number)  # type: ignore[attr-defined, misc]
    waiting.get()
    puts.join(30.0)
    assert not puts.is_alive()
