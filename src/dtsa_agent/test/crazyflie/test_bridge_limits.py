"""Integration: durations that no Crazyflie can keep: take-off and go_to are refused, a landing takes longer."""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from waiting import wait_for

from dtsa_agent.crazyflie.orders import PEAK, shortest_s, too_short


def test_the_shortest_duration_keeps_the_speed_of_the_firmwares_path() -> None:
    from dtsa_bench.crazyflies.simulated.planner import evaluate, septic

    for distance, limit in ((1.0, 1.2), (0.3, 0.5), (1.9, 1.0)):
        seconds = shortest_s(distance, limit)
        path = septic(0.0, 0.0, 0.0, distance, seconds)
        speed = [evaluate(path, t)[1] for t in np.linspace(0.0, seconds, 201)]
        assert max(speed) == pytest.approx(limit, rel=1e-6)
        assert shortest_s(-distance, limit) == seconds
    assert shortest_s(0.0, 1.0) > 0.0
    assert pytest.approx(2.1875) == PEAK


def test_why_a_duration_is_too_short() -> None:
    # What Crazyswarm2's examples do: one metre in two seconds, also from a little below zero.
    assert too_short(2.0, 1.05, 1.2) == ""
    text = too_short(0.5, -1.0, 1.2)
    assert text == "duration 0.50 s is too short for 1.00 m: at least 1.82 s (station.max_speed_mps is 1.2)"
    for duration in (0.0, -1.0, math.nan):
        assert too_short(duration, 0.5, 1.2)


@pytest.mark.slow
@pytest.mark.realtime
def test_what_is_too_short_is_refused_and_motors_never_stop_between_a_stream_and_an_order(tmp_path: Path) -> None:
    pytest.importorskip("cflib")
    from bridge_helpers import fake_fleet, flight, settings

    from dtsa_agent.crazyflie.commands import velocity_world
    from dtsa_agent.crazyflie.state import State

    with fake_fleet(tmp_path, 1) as fleet:
        with flight(settings(fleet, {"safety": {"link_age_s": 3.0, "geofence": False}})) as pilot:
            assert pilot.bridge.connect() == []
            cf = pilot.bridge.vehicles["cf1"]

            def stream() -> None:
                for _ in range(10):
                    assert cf.command(velocity_world((0.1, 0.0, 0.0), 0.0, time.monotonic())) == ""
                    time.sleep(0.05)

            def reaches(height: float) -> None:
                wait_for(lambda: cf.last is not None and abs(cf.last.position[2] - height) < 0.05)

            cf.arm(True)
            wait_for(lambda: cf.state is State.ARMED)
            assert "duration 0.30 s is too short" in cf.takeoff(1.0, 0.3)
            assert "is too short" in cf.takeoff(1.0, 0.0)
            assert "not finite" in cf.takeoff(math.nan, 3.0)
            assert not fleet.events(name="takeoff")
            assert cf.takeoff(1.0, 2.0) == ""
            reaches(1.0)
            wait_for(lambda: cf.state is State.FLYING)
            time.sleep(1.0)  # the take-off is flown to its end
            here = cf.last.position
            far = (here[0] - 1.0, here[1], here[2])
            assert "duration 1.00 s is too short for 1.00 m" in cf.go_to(far, 0.0, 1.0, False)
            assert "is too short for 1.00 m" in cf.go_to((-1.0, 0.0, 0.0), 0.0, 1.0, True)
            assert not fleet.events(name="go_to")
            assert cf.go_to((-0.3, 0.0, 0.0), 0.0, 1.0, True) == ""
            time.sleep(1.2)
            stream()
            assert cf.notify_setpoints_stop(0) == ""
            wait_for(lambda: fleet.events(name="stream ended"))
            stream()
            assert cf.takeoff(1.3, 1.5) == ""
            reaches(1.3)
            assert cf.land("test", 0.0, 3.0) == ""
            reaches(1.1)
            assert cf.takeoff(1.3, 1.5) == ""
            reaches(1.3)
            assert cf.state is State.FLYING
            assert cf.land("test", 0.0, 0.2) == ""
            pilot.logged(r"cf1: landing takes [12]\..* s: duration 0\.20 s is too short")
            assert "duration 0.20 s is too short" in cf.longer
            wait_for(lambda: cf.state is State.READY)
            assert cf.longer == ""  # what is said of this landing is not said of a later one
        names = [e["event"] for e in fleet.events(1)]
        assert names.count("takeoff") == 1
        assert names.count("go_to") >= 4
        states = [e["state"] for e in fleet.events(1, "state")]
        assert states[:3] == ["ready to fly", "flying", "landed"]
        assert not [e for e in fleet.events() if e["event"] in ("hard landing", "crash")]
        assert fleet.state_event(1, "landed")["t"] - fleet.events(1, "land")[-1]["t"] > 1.5
        # A stream ends when there is something else to fly. Here both packets come at once, over the air they do not.
        ended = [k for k, name in enumerate(names) if name == "stream ended"]
        assert len(ended) >= 2
        assert {names[k - 1] for k in ended} <= {"go_to", "land"}


@pytest.mark.slow
@pytest.mark.ros
def test_a_setpoint_passes_seven_files_from_its_topic_to_cflib(tmp_path: Path) -> None:
    pytest.importorskip("cflib")
    messages = pytest.importorskip("dtsa_msgs.msg")
    from bridge_helpers import fake_fleet, flight, settings

    from dtsa_agent.crazyflie.commands import POSITION
    from dtsa_agent.crazyflie.node.topics import BridgeInputs
    from dtsa_agent.crazyflie.state import State

    with fake_fleet(tmp_path, 1) as fleet, flight(settings(fleet)) as pilot:
        assert pilot.bridge.connect() == []
        cf = pilot.bridge.vehicles["cf1"]
        cf.arm(True)
        wait_for(lambda: cf.state is State.ARMED)
        message, crossed = messages.Position(z=-0.5), set[str]()
        message.header.frame_id = "map"
        sys.setprofile(lambda frame, event, argument: crossed.add(frame.f_code.co_filename))
        BridgeInputs._stream(SimpleNamespace(), POSITION, cf, message, time.time())  # type: ignore[arg-type]
        sys.setprofile(None)
        wait_for(lambda: fleet.events(name="streaming"))
    ours = {Path(file).stem for file in crossed if "/dtsa_agent/dtsa_agent/" in file}
    assert ours == {"topics", "commands", "state", "vehicle", "safety", "link", "drivers"}
