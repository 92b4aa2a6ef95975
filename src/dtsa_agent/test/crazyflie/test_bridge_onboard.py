"""What a Crazyflie has on board, by an unmodified cflib: parameters, logs, and trajectories that are flown."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import pytest

pytest.importorskip("cflib")

from bridge_helpers import fake_fleet, flight, settings
from waiting import wait_for

from dtsa_agent.crazyflie.motion.trajectories import Piece, Trajectory
from dtsa_agent.crazyflie.state.state_machine import State

pytestmark = pytest.mark.slow
NOTHING = (0.0,) * 8


def along_x(number: int, metres: float, pieces: int = 1) -> Trajectory:
    """From rest to rest in 1.5 s, then at rest for all other pieces."""
    t = 1.5
    smooth = (0.0, 0.0, 0.0, 0.0, 35 / t**4, -84 / t**5, 70 / t**6, -20 / t**7)
    way = Piece(tuple(metres * c for c in smooth), NOTHING, NOTHING, NOTHING, t)
    rest = Piece((metres, *NOTHING[1:]), NOTHING, NOTHING, NOTHING, 0.02)
    return Trajectory(number, 0, (way, *(rest,) * (pieces - 1)))


@pytest.mark.realtime
def test_parameters_logs_and_trajectories(tmp_path: Path) -> None:
    with fake_fleet(tmp_path, 2, "--arming", "mixed") as fleet, flight(settings(fleet)) as f:
        assert f.bridge.connect() == []
        one, two = f.bridge.vehicles.values()
        # Parameters, with their types.
        known = one.onboard.parameters()
        assert (known["ring.effect"].value, known["hlCommander.vland"].value) == (6, 0.5)
        for name, value, problem in (
            ("ring.effect", 7, ""),
            ("ring.effect", 256, "ring.effect: 256 is not a whole number from 0 to 255"),
            ("ring.effect", 1.5, "ring.effect: 1.5 is not a whole number from 0 to 255"),
            ("hlCommander.vland", 0.25, ""),
            ("hlCommander.vland", float("nan"), "hlCommander.vland: nan is not a number"),
            ("firmware.modified", 1, "firmware.modified is read-only"),
        ):
            assert known[name].problem(value) == problem
        one.onboard.set_parameter("ring.effect", 7)
        wait_for(lambda: one.onboard.parameters()["ring.effect"].value == 7)
        assert two.onboard.parameters()["ring.effect"].value == 6
        # Logs.
        seen: list[Mapping[str, float]] = []
        variables = ["pm.vbat", "stateEstimate.yaw"]
        assert one.onboard.add_log("own", 20, variables, lambda stamp, values: seen.append(values)) == ""
        assert one.onboard.add_log("own", 20, variables, lambda stamp, values: None) == "own is logged already"
        assert "does not log" in one.onboard.add_log("other", 20, ["pm.tea"], lambda stamp, values: None)
        wait_for(lambda: len(seen) > 3)
        assert seen[-1]["pm.vbat"] > 3.0
        assert one.onboard.remove_log("own") == ""
        assert one.onboard.remove_log("own") == "own is not logged"
        # Trajectories, stored as they are and compressed: one arms itself, the other one waits to be told.
        assert one.trajectories.upload(along_x(0, -0.4)) == ""
        assert two.trajectories.upload(along_x(0, -0.4, pieces=40)) == ""
        two.arm(True)
        wait_for(lambda: two.state == State.ARMED)
        assert {v.takeoff(0.95, 2.0, arm=True) for v in (one, two)} == {""}
        time.sleep(2.3)
        order = {"reverse": False, "relative": True}
        assert one.trajectories.start(5, 1.0, **order) == "cf1: trajectory 5 was not uploaded"
        assert "uploaded on the ground" in one.trajectories.upload(along_x(0, -0.2))
        refused = two.trajectories.start(0, 1.0, **order)
        assert refused.startswith("cf2: trajectory 0: (-1.")
        assert refused.endswith("m outside the geofence in x")
        assert two.go_to((-0.4, 0.0, 0.95), 0.0, 2.0, False) == ""
        assert one.trajectories.start(0, 1.0, **order) == ""
        wait_for(lambda: abs(one.last.position[0] - 0.8) < 0.05 and abs(two.last.position[0] + 0.4) < 0.05)  # type: ignore[union-attr]
        assert two.trajectories.start(0, 1.0, **order) == ""
        wait_for(lambda: abs(two.last.position[0] + 0.8) < 0.05)  # type: ignore[union-attr]
        assert [e["duration"] for e in fleet.events(name="trajectory")] == [1.5, pytest.approx(1.5 + 39 * 0.02)]
        f.bridge.land_all("the test ends")
        assert f.bridge.wait_landed(lambda: False) == []
        assert not [e for e in fleet.events() if e["event"] in ("collision", "crash", "hard landing")]
