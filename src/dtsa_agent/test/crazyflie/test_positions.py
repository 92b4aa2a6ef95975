"""Positions from motion capture: what is believed, when an estimator has settled, and flights with a real publisher."""

from __future__ import annotations

import math
import os
import re
import sys
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from waiting import wait_for

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.positions import POSES_AFTER_JUMP, PoseTracker, PositionSettings, quantile
from dtsa_agent.crazyflie.safety import EstimateWatch, SafetySettings
from dtsa_agent.crazyflie.settings import parse_swarm
from dtsa_agent.crazyflie.state import VehicleState

ORIGIN = (0.0, 0.0, 0.95)
LEVEL = (0.0, 0.0, 0.0, 1.0)


def tracker(**changes: Any) -> PoseTracker:
    return PoseTracker(PositionSettings(**({"source": "pose"} | changes)), SafetySettings(), ORIGIN)


def offer(t: PoseTracker, place: Any, at: float, *, q: Any = LEVEL, frame: str = "world", flying: bool = False) -> str:
    return t.receive_pose(place, q, frame, 1000.0 + at, at, flying=flying)


@pytest.mark.parametrize(("pose", "kind", "words"), [
    ({"place": (math.nan, 0.0, 0.0)}, "not finite", "not finite"),
    ({"place": (0.0, 0.0, math.inf)}, "not finite", "not finite"),
    ({"place": (5.0, 0.0, 0.0)}, "outside", "3.50 m outside the geofence in x"),
    ({"q": (0.0, 0.0, 0.0, 0.0)}, "quaternion", "length 0, not 1"),
    ({"frame": "odom"}, "frame", "'odom' is neither world nor map"), ({"at": 0.99}, "stamp", "0.010 s before"),
    ({"at": 1.0}, "stamp", "0.000 s before"), ({"place": (1.0, 0.0, 0.0)}, "jump", "jumps by 1.00 m"),
])  # fmt: skip
def test_poses_that_cannot_be_are_refused_and_counted(pose: dict[str, Any], kind: str, words: str) -> None:
    t = tracker()
    assert offer(t, (0.0, 0.0, 0.0), 1.0) == ""
    values = {"place": (0.0, 0.0, 0.0), "at": 1.01} | pose
    assert words in offer(t, values.pop("place"), values.pop("at"), **values)
    assert (dict(t.refused), words in t.reason) == ({kind: 1}, True)
    assert t.last is not None
    assert (t.last.position, t.age(1.51)) == ((0.0, 0.0, 0.0), pytest.approx(0.51))


def test_frames_quaternions_and_the_rate() -> None:
    t = tracker(send="extpos", max_rate_hz=50)
    assert offer(t, (0.5, 0.0, -0.95), 1.0, frame="map", q=(0.0, 0.0, 0.0, 0.0)) == ""  # extpos needs no attitude
    assert t.last is not None
    assert (t.last.position, t.last.orientation) == (pytest.approx((0.5, 0.0, 0.0)), None)
    assert sum(t.is_due(2.0 + 0.01 * k) for k in range(100)) == pytest.approx(50, abs=1)
    full = tracker(max_rate_hz=100)
    assert offer(full, (0.5, 0.0, 0.0), 1.01, q=(0.0, 0.0, 0.0, 1.04)) == ""
    assert full.last is not None
    assert full.last.orientation == (0.0, 0.0, 0.0, 1.0)
    jitter = np.random.default_rng(1).uniform(-0.004, 0.004, 100)
    assert sum(full.is_due(2.0 + 0.01 * k + jitter[k]) for k in range(100)) > 90


def test_one_that_was_carried_is_believed_again_on_the_ground_only() -> None:
    for flying in (False, True):
        t = tracker()
        offer(t, (0.0, 0.0, 0.0), 1.0)
        answers = [offer(t, (1.2, 0.0, 0.0), 1.0 + 0.005 * k, flying=flying) for k in range(1, POSES_AFTER_JUMP + 1)]
        assert all(answers[:-1])
        assert (answers[-1] == "") is not flying
    # Two bodies that change names all the time never agree with each other.
    t = tracker()
    offer(t, (0.0, 0.0, 0.0), 1.0)
    assert all(offer(t, (1.2, (-1) ** k, 0.0), 1.0 + 0.001 * k) for k in range(1, 60))


def test_poses_that_come_late_are_not_believed() -> None:
    t = tracker()

    def at(stamp: float, arrival: float, *, flying: bool = True) -> str:
        return t.receive_pose(
            (0.0, 0.0, 1e-4 * arrival), LEVEL, "world", 77000.0 + stamp, arrival, flying=flying
        )  # another clock

    assert [at(0.01 * k, 5.004 + 0.01 * k) for k in range(20)] == [""] * 20
    backlog = [at(0.2 + 0.01 * k, 5.5 + 0.0005 * k) for k in range(28)]  # nothing for 0.3 s, then all at once
    assert "it comes 296 ms later than the fastest one" in backlog[0]
    assert [bool(answer) for answer in backlog] == [True] * 25 + [False] * 3
    assert t.refused == {"late": 25}
    assert at(0.48, 5.484) == ""
    # The clock of motion capture was set back: on the ground its poses are believed again, in flight they are not.
    assert all(at(0.49 + 0.01 * k, 7.0 + 0.01 * k) for k in range(60))
    answers = [at(1.2 + 0.01 * k, 8.0 + 0.01 * k, flying=False) for k in range(POSES_AFTER_JUMP + 5)]
    assert answers == [""] * len(answers)  # they have agreed with each other for long


def test_latency_and_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    t = tracker()
    cf = SimpleNamespace(loc=SimpleNamespace(send_extpose=lambda *pose: None))
    for k in range(150):
        offer(t, (0.0, 0.0, 0.0), 1.0 + 0.01 * k)
        monkeypatch.setattr(time, "time", lambda k=k: 1000.0 + 1.0 + 0.01 * k + 0.004)
        t.send(cf)
    assert t.rate_hz(2.495) == pytest.approx(100, abs=1)
    assert (quantile(t.latencies, 0.5), quantile(t.latencies, 0.99)) == (pytest.approx(0.004), pytest.approx(0.004))
    assert (t.sent, t.age(2.495)) == (150, pytest.approx(0.005))


def test_a_pose_that_stands_still_in_flight_is_no_pose() -> None:
    """Motion capture that repeats its last pose for two seconds, with new stamps."""
    t = tracker()
    assert offer(t, (0.0, 0.0, 1.0), 1.0, flying=True) == ""
    answers = [offer(t, (0.0, 0.0, 1.0), 1.0 + 0.01 * k, flying=True) for k in range(1, 201)]
    assert all("the same pose again" in answer for answer in answers)
    assert (t.refused, t.age(3.0), t.measured_position(3.0)) == ({"repeated": 200}, pytest.approx(2.0), None)
    assert offer(t, (0.0, 0.0, 1.001), 3.01, flying=True) == ""
    standing = tracker()
    assert [offer(standing, (0.0, 0.0, 0.0), 1.0 + 0.01 * k) for k in range(20)] == [""] * 20


@pytest.mark.parametrize(("q", "words"), [
    ((1.0, 0.0, 0.0, 0.0), "tilted by 180 degrees"), ((0.0, 0.0, 1.0, 0.0), "turns by 180 degrees"),
    ((0.0, 0.0, 0.05, 0.99875), ""), ((0.0, 0.0, -0.05, -0.99875), ""),
])  # fmt: skip
def test_attitudes_that_cannot_be_are_refused(q: Any, words: str) -> None:
    t = tracker()
    assert offer(t, (0.0, 0.0, 1.0), 1.0, flying=True) == ""
    answer = offer(t, (0.0, 0.0, 1.001), 1.01, q=q, flying=True)
    assert (answer == "") == (words == "")
    assert words in answer
    assert dict(t.refused) == ({"attitude": 1} if words else {})
    places = tracker(send="extpos")
    assert offer(places, (0.0, 0.0, 1.0), 1.0, flying=True) == ""
    assert offer(places, (0.0, 0.0, 1.001), 1.01, q=q, flying=True) == ""  # attitudes are not sent


def test_a_pose_goes_over_the_air_as_one_packet_that_nothing_waits_for() -> None:
    pytest.importorskip("cflib")
    from cflib.crazyflie.localization import Localization

    for send, size, header in (("extpose", 29, 0x61), ("extpos", 12, 0x60)):
        captured = tracker(send=send)
        assert captured.receive_pose((1.0, 2.0, 0.5), LEVEL, "world", 0.0, 100.0, flying=False) == ""
        assert captured.last is not None
        sent: list[Any] = []
        cf = SimpleNamespace(send_packet=sent.append, add_port_callback=lambda *_: None)
        captured.send(SimpleNamespace(loc=Localization(cf)))
        data = bytes((sent[0].header,)) + bytes(sent[0].data)
        assert (len(data) - 1, data[0] & 0xF3, captured.sent) == (size, header, 1)
        soon, late = captured.last.time + 0.2, captured.last.time + 1.0
        assert captured.measured_position(soon) == (1.0, 2.0, 0.5)
        assert captured.why_estimate_wrong((1.0, 2.0, 0.45), soon) == ""
        assert "0.30 m from where it believes to be" in captured.why_estimate_wrong((1.0, 2.0, 0.8), soon)
        assert "not seen by motion capture (no pose comes)" in captured.why_estimate_wrong((1.0, 2.0, 0.5), late)


@pytest.mark.parametrize(("place", "variance", "seen", "words"), [
    ((5.0, 0.0, 0.0), 100.0, (0.0, 0.0, 0.0), "motion capture sees it 5.00 m away"),
    ((0.0, 0.0, 0.0), 1e-5, "not", "motion capture does not see it"), ((0.05, 0.0, 0.0), 100.0, (0.0, 0.0, 0.0), ""),
    ((0.0, 0.0, 0.0), 100.0, None, "variance 100 m^2, limit 0.01 m^2"),
    ((5.0, 0.0, 0.0), 1e-5, None, "believes to be outside"), ((math.nan, 0.0, 0.0), 1e-5, None, "not finite"),
    ((0.0, 0.0, 0.0), 1e-5, None, ""),
])  # fmt: skip
def test_settled_is_where_it_stands(place: Any, variance: float, seen: Any, words: str) -> None:
    t = tracker(source="none" if seen is None else "pose")
    if isinstance(seen, tuple):
        assert offer(t, seen, 1.0) == ""
    problem = t.why_not_settled([place] * 10, variance, 0.01, 1.0)
    assert (problem == "") is (words == "")
    assert words in problem


def test_an_estimate_that_wanders_has_not_settled() -> None:
    places = [(0.03 * k, 0.0, 0.0) for k in range(20)]
    assert "its place moves by" in tracker(source="none").why_not_settled(places, 1e-5, 0.01, 1.0)


def flown(
    positions: Any, velocity: Any = (0.0, 0.0, 0.0), seen: Any = None, flying: bool = True, period: float = 0.02
) -> EstimateWatch:
    watch = EstimateWatch(SafetySettings())
    for k, place in enumerate(positions):
        watch.update(VehicleState(place, velocity, LEVEL, 4.0, 0), period * k, seen, flying=flying)
    return watch


def test_jumps_standstill_and_errors_in_flight_are_noticed() -> None:
    still = [(0.0, 0.0, 1.0)] * 50
    assert flown([*still[:10], *[(2.0, 0.0, 1.0)] * 2]).wrong == "the estimate jumps by 2.00 m within 0.02 s"
    assert "has not changed for 0.5" in flown(still).wrong
    assert "though it moved by 0.1" in flown(still[:20], (1.0, 0.0, 0.0)).wrong
    moving = [(0.02 * k, 0.0, 1.0) for k in range(50)]
    assert flown(moving, (1.0, 0.0, 0.0)).wrong == ""
    seldom = [(0.25 * k, 0.0, 1.0) for k in range(10)]  # as with the lowest log_rate_hz
    assert flown(seldom, (1.0, 0.0, 0.0), period=0.25).wrong == ""
    assert "m from where motion capture sees it" in flown(moving, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)).wrong
    assert flown(still, flying=False).wrong == ""
    assert flown([(0.0, 0.0, 0.03)] * 50).wrong == ""  # it may be about to stand


def test_settings_name_topics_and_the_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rclpy")
    from dtsa_agent.crazyflie.node.topics import subscribe_positions

    assert PositionSettings(source="pose").topic_of("cf3") == "/cf3/pose"
    assert PositionSettings(source="named_poses").topic_of("cf3") == "/poses"
    assert PositionSettings(source="pose", topic="/vrpn/{name}/pose").topic_of("cf3") == "/vrpn/cf3/pose"
    with pytest.raises(ConfigError) as error:
        parse_swarm({"robots": {"cf1": {"uri": "udp://h:1"}}, "station": {"positions": {"source": "vicon"}}})
    assert error.value.field == "station.positions.source"
    named, got, callbacks = PositionSettings(source="named_poses"), list[Any](), list[Any]()
    vehicles: Any = {"cf2": SimpleNamespace(receive_pose=lambda *pose: got.append(pose))}
    thread: Any = SimpleNamespace(subscribe=lambda kind, topic, callback, qos: callbacks.append(callback))
    monkeypatch.setitem(sys.modules, "motion_capture_tracking_interfaces", None)
    with pytest.raises(ConfigError, match="motion_capture_tracking_interfaces in the workspace"):
        subscribe_positions(thread, named, vehicles)
    # By name; bodies that are no Crazyflies are of no concern.
    monkeypatch.setitem(sys.modules, "motion_capture_tracking_interfaces", SimpleNamespace())  # type: ignore[arg-type]
    monkeypatch.setitem(sys.modules, "motion_capture_tracking_interfaces.msg", SimpleNamespace(NamedPoseArray=None))  # type: ignore[arg-type]
    subscribe_positions(thread, named, vehicles)
    stamp = SimpleNamespace(sec=5, nanosec=500_000_000)
    position, orientation = SimpleNamespace(x=1.0, y=2.0, z=3.0), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = SimpleNamespace(position=position, orientation=orientation)
    poses = [SimpleNamespace(name=name, pose=pose) for name in ("wand", "cf2")]
    callbacks[0](SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id="world"), poses=poses), 0.0)
    assert got == [((1.0, 2.0, 3.0), LEVEL, "world", 5.5)]


@pytest.mark.slow
@pytest.mark.ros
@pytest.mark.realtime
def test_a_flight_by_motion_capture_and_what_happens_when_it_or_an_estimate_fails(tmp_path: Path) -> None:
    """A publisher at 100 Hz; then an estimate jumps, one freezes, one vehicle is not seen any more; one flies on."""
    pytest.importorskip("cflib")
    pytest.importorskip("dtsa_msgs.srv")
    from bridge_helpers import bridge_process, fake_fleet, settings
    from builtin_interfaces.msg import Duration
    from dtsa_msgs.srv import Arm, Takeoff
    from graph_helpers import Graph

    from dtsa_bench.crazyflies.simulated.truth import read_truth
    from dtsa_bench.flights.domain import ros_domain

    with ros_domain() as domain:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
        helpers = {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])}
        tracked = {"program": ("motion_capture_helper",), "environment": environment | helpers}
        with fake_fleet(tmp_path, 4, **tracked) as fleet:  # type: ignore[arg-type]
            station = {
                "positions": {"source": "pose"},
                "safety": {"link_age_s": 3.0, "command_age_s": 0, "estimate_error_m": 0},
            }
            config = tmp_path / "swarm.yaml"
            config.write_text(yaml.safe_dump(settings(fleet, station)))
            log, output = tmp_path / "bridge.log", (tmp_path / "bridge.log").open("w")
            with output, bridge_process(domain, config, output=output), closing(Graph(domain)) as graph:
                assert graph.call(Arm, "/all/arm", arm=True).success
                wait_for(lambda: all(graph.state(k) == "armed" for k in (1, 2, 3)))
                assert graph.call(Takeoff, "/all/takeoff", height=0.95, duration=Duration(sec=2)).success
                wait_for(
                    lambda: all(graph.state(k) == "flying" and abs(graph.place(k)[2] - 0.95) < 0.1 for k in (1, 2, 3))
                )
                values = {v.key: v.value for v in graph.last["/diagnostics"].status[0].values}
                assert float(values["positions [Hz]"]) > 60
                assert 0.0 < float(values["position latency, median [ms]"]) < 50.0
                t = fleet.fault("estimate_jump", 1, distance=-2.0)
                fleet.fault("estimate_freeze", 2)
                fleet.fault("unseen", 3)
                wait_for(lambda: all(graph.state(k) == "ready" for k in (1, 2, 3)))
                times, track, events = read_truth(fleet.truth)
                words = log.read_text()
                for cf, reason in (
                    (1, "estimate: the estimate jumps by 2.0. m"),
                    (2, "estimate: the estimated? .*not cha"),
                    (3, "positions: not seen by motion capture for"),
                ):
                    assert re.search(f"cf{cf}: {reason}.*: hold\n(.*\n)*.*cf{cf}: {reason}.*: land\n", words), words
                after = times >= t
                moved = np.linalg.norm(track[after][:, :2] - track[after][0, :2], axis=1).max(axis=0)
                assert moved.max() < 0.3, moved
                assert abs(track[-1, 2, 3] - 0.95) < 0.1  # the fourth one flies on
                assert not [e for e in events if e["event"] in ("hard landing", "collision", "crash")]
                assert not [e for e in events if e.get("state") == "locked"]
