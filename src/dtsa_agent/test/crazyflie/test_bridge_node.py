"""The bridge as a ROS node: names, units on the graph, services, Ctrl-C."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import yaml

pytest.importorskip("cflib")
rclpy = pytest.importorskip("rclpy")
pytest.importorskip("dtsa_msgs.srv")

from bridge_helpers import FakeFleet, bridge_process, fake_fleet, settings  # noqa: E402
from builtin_interfaces.msg import Duration  # noqa: E402
from dtsa_msgs.msg import Position, Status, VelocityWorld  # noqa: E402
from dtsa_msgs.srv import Arm, GoTo, Land, Takeoff  # noqa: E402
from geometry_msgs.msg import Point  # noqa: E402
from graph_helpers import COUNT, Graph  # noqa: E402
from std_msgs.msg import Empty as EmptyMessage  # noqa: E402
from std_srvs.srv import Empty, Trigger  # noqa: E402
from waiting import wait_for  # noqa: E402

from dtsa_agent.crazyflie.node import bridge_node  # noqa: E402
from dtsa_agent.crazyflie.node.topics import VehicleOutputs  # noqa: E402
from dtsa_agent.crazyflie.positions import PositionSettings  # noqa: E402
from dtsa_agent.crazyflie.state import State, VehicleState  # noqa: E402
from dtsa_bench.flights.domain import ros_domain  # noqa: E402

pytestmark = [pytest.mark.slow, pytest.mark.ros]
PATIENT = {"safety": {"link_age_s": 3.0, "command_age_s": 0.45}}  # not what is tested here


@contextmanager
def swarm(tmp_path: Path, **station: Any) -> Iterator[tuple[FakeFleet, subprocess.Popen[str], Graph]]:
    with ros_domain() as domain, fake_fleet(tmp_path, COUNT, "--arming", "mixed") as fleet:
        config = tmp_path / "swarm.yaml"
        data = settings(fleet, PATIENT | station)
        data["robots"]["cf3"]["group_mask"] = 2
        config.write_text(yaml.safe_dump(data))
        with bridge_process(domain, config) as process, closing(Graph(domain)) as graph:
            yield fleet, process, graph


def up(graph: Graph) -> None:
    # all/emergency is the last service to come: everything else is there.
    graph.client(Empty, "/all/emergency")
    names = {name for name, _ in graph.node.get_service_names_and_types()}
    for prefix in ("/all", "/cf1", "/cf2", "/cf3"):
        for service in ("takeoff", "land", "go_to", "arm", "emergency", "notify_setpoints_stop"):
            assert f"{prefix}/{service}" in names
    assert graph.call(Arm, "/all/arm", arm=True).success  # they are armed by then: a take-off may follow at once
    assert graph.call(Takeoff, "/all/takeoff", height=0.95, duration=Duration(sec=2)).success
    wait_for(lambda: all(graph.state(k) == "flying" and abs(graph.place(k)[2] - 0.95) < 0.1 for k in (1, 2, 3)))


def refused_commands(graph: Graph, k: int) -> int:
    values = graph.last["/diagnostics"].status[k - 1].values
    return next(int(v.value) for v in values if v.key == "commands refused")


@contextmanager
def heartbeats(graph: Graph) -> Iterator[None]:
    """The ground station's, ten a second."""
    publisher, over = graph.node.create_publisher(EmptyMessage, "/all/heartbeat", 1), threading.Event()

    def beat() -> None:
        while not over.wait(0.1):
            publisher.publish(EmptyMessage())

    thread = threading.Thread(target=beat)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def test_odometry_is_dated_by_when_its_values_were_taken() -> None:
    """A packet waits for its turn on the air, and for the end of a gap: agents move a vehicle on by its age."""
    late_s, vehicle = 0.5, SimpleNamespace(state=State.READY)
    report = VehicleState((1.0, 0.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 4.0, 0)
    with ros_domain() as domain, closing(Graph(domain)) as graph:
        outputs = VehicleOutputs(graph.node, "cf1", PositionSettings())
        outputs._reported, outputs._odom_wanted = State.READY, True

        def received() -> bool:
            outputs.publish_report(vehicle, report, time.monotonic() - late_s)  # type: ignore[arg-type]
            return "/cf1/odom" in graph.last

        wait_for(received)
        stamp = graph.last["/cf1/odom"].header.stamp
        assert time.time() - (stamp.sec + stamp.nanosec * 1e-9) >= late_s


@pytest.mark.realtime
def test_a_flight_over_the_graph_and_ctrl_c_lands(tmp_path: Path) -> None:
    safety = PATIENT["safety"] | {"emergency_watchdog": False}
    with swarm(tmp_path, safety=safety) as (fleet, process, graph):
        up(graph)
        with heartbeats(graph):  # the bridge stands still: it has missed heartbeats that were sent, and stops nobody
            wait_for(lambda: graph.node.count_subscribers("/all/heartbeat"))
            time.sleep(0.3)
            process.send_signal(signal.SIGSTOP)
            time.sleep(1.3)
            process.send_signal(signal.SIGCONT)
            time.sleep(0.3)
        assert graph.call(Trigger, "/all/end_heartbeat").success
        odometry = graph.last["/cf1/odom"]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("world", "cf1/base_link")
        assert graph.last["/cf1/pose"].header.frame_id == "world"
        x = graph.place(1)[0]
        # go_to in the world; commands are not taken before it has been flown.
        goal = Point(x=x - 0.3, y=0.2, z=1.05)
        assert graph.call(GoTo, "/cf1/go_to", goal=goal, duration=Duration(sec=1)).success
        wait_for(lambda: graph.place(1) == pytest.approx((x - 0.3, 0.2, 1.05), abs=0.05))
        # Streamed commands, with yaw: cf2 by velocity, cf1 by position.
        y = graph.place(2)[1]

        def followed() -> bool:
            message = VelocityWorld(yaw_rate=57.3)
            message.vel.y = -0.4
            graph.velocity[2].publish(message)
            graph.position.publish(Position(x=x - 0.3, y=0.0, z=0.95, yaw=57.3))
            time.sleep(0.01)
            turned = graph.last["/cf2/odom"].pose.pose.orientation.z > 0.2  # counter-clockwise
            there = graph.place(1) == pytest.approx((x - 0.3, 0.0, 0.95), abs=0.15)
            return bool(graph.place(2)[1] < y - 0.2 and turned and there)

        wait_for(followed)
        status = graph.last["/cf2/status"]
        assert status.supervisor_info & Status.SUPERVISOR_INFO_IS_FLYING
        assert 3.0 < status.battery_voltage < 4.2
        assert not graph.call(Trigger, "/cf2/reconnect").success
        diagnostics = {s.hardware_id: s for s in graph.last["/diagnostics"].status}
        assert {"cf1", "cf2", "cf3"} == set(diagnostics)
        assert "battery [V]" in {v.key for v in diagnostics["cf1"].values}
        # Groups: nobody is in the fourth, cf3 alone is in the second.
        here = Point(x=graph.place(3)[0], y=graph.place(3)[1], z=1.05)
        answer = graph.call(GoTo, "/all/go_to", group_mask=4, goal=here, duration=Duration(sec=1))
        assert (answer.success, answer.message) == (False, "none of cf1, cf2, cf3 is in a group of 4")
        assert graph.call(GoTo, "/all/go_to", group_mask=2, goal=here, duration=Duration(sec=1)).success
        goal = pytest.approx([here.x, here.y, here.z], abs=0.002)
        wait_for(lambda: any(event["goal"] == goal for event in fleet.events(3, "go_to")))
        assert not any(event["goal"] == goal for event in fleet.events(1, "go_to"))  # it may hold its place meanwhile
        # Goals, heights and commands outside the fence, or faster than anybody means, are refused in so many words.
        answer = graph.call(GoTo, "/cf3/go_to", goal=Point(x=1.95, z=0.95), duration=Duration(sec=5))
        assert "cf3: the goal (1.95, 0.00, 0.00) is 0.45 m outside the geofence in x" in answer.message
        answer = graph.call(GoTo, "/all/go_to", goal=here, duration=Duration(sec=1))
        assert answer.message == "a go_to of all must be relative: they would meet in one place"
        answer = graph.call(GoTo, "/cf3/go_to", relative=True, goal=Point(y=9.0), duration=Duration(sec=50))
        assert "outside the geofence in y" in answer.message
        answer = graph.call(Takeoff, "/cf3/takeoff", height=3.0, duration=Duration(sec=9))
        assert "cf3: the take-off to" in answer.message
        refused = next(int(v.value) for v in diagnostics["cf2"].values if v.key == "commands refused")
        rushing = VelocityWorld()
        rushing.vel.x = 50.0
        graph.velocity[2].publish(rushing)
        wait_for(lambda: refused_commands(graph, 2) > refused)
        # A go_to that no Crazyflie can keep is refused; a landing is not, it takes longer.
        answer = graph.call(
            GoTo, "/cf3/go_to", relative=True, goal=Point(y=0.5), duration=Duration(nanosec=100_000_000)
        )
        assert not answer.success
        assert "cf3: duration 0.10 s is too short for 0.50 m" in answer.message
        # The stream ends: the bridge holds. Landing one by service, the others by Ctrl-C.
        answer = graph.call(Land, "/cf3/land", height=0.0, duration=Duration(nanosec=200_000_000))
        assert answer.success
        assert "cf3: landing takes" in answer.message
        with heartbeats(graph):  # of a ground station that ends a moment later: that stops nobody on the way down
            time.sleep(0.3)
            process.send_signal(signal.SIGINT)
            wait_for(lambda: all(fleet.events(k, "land") for k in (1, 2, 3)))
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 0, output
        assert "landing" in output
        assert "cf2: a command with 50.00 m/s is refused" in output
        for k in (1, 2, 3):
            assert fleet.events(k, "land")
            assert fleet.flown(k)[2] == "landed"
        assert not [e for e in fleet.events() if e["event"] in ("hard landing", "collision", "crash")]


@pytest.mark.parametrize(("state", "code"), [(State.READY, 0), (State.LOST, 1), (State.EMERGENCY, 1)])
def test_one_that_is_lost_or_falls_on_the_way_down_is_named_at_the_end(state: State, code: int) -> None:
    bridge, said = MagicMock(), []
    bridge.names_in_air.return_value = ["cf1", "cf2"]
    bridge.wait_landed.return_value = []
    bridge.vehicles = {"cf1": SimpleNamespace(state=State.READY), "cf2": SimpleNamespace(state=state)}
    node = SimpleNamespace(bridge=bridge, log=lambda level, line: said.append(line))
    assert bridge_node._end(node, SimpleNamespace(signal=signal.SIGINT, interrupts=1)) == code  # type: ignore[arg-type]
    assert ("not known to have landed: cf2" in said) == bool(code)
    bridge.close.assert_called_once_with()


@pytest.mark.realtime
def test_second_ctrl_c_is_the_emergency_stop(tmp_path: Path) -> None:
    slowly = 0.05  # m/s: the second signal comes before they stand, on a busy machine, too
    with swarm(tmp_path, land_speed_mps=slowly) as (fleet, process, graph):
        up(graph)
        process.send_signal(signal.SIGINT)
        wait_for(lambda: len(fleet.events(name="land")) == COUNT)
        assert not any(e["state"] == "locked" for e in fleet.events(name="state"))
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=60)
        assert process.returncode == 1
        assert "EMERGENCY STOP of all: second Ctrl-C" in output
        for k in (1, 2, 3):
            assert fleet.state_event(k, "locked")["reason"] == "emergency stop"


@pytest.mark.realtime
def test_emergency_service(tmp_path: Path) -> None:
    with swarm(tmp_path) as (fleet, _, graph):
        up(graph)
        graph.call(Empty, "/cf1/emergency")
        wait_for(lambda: graph.state(1) == "emergency")
        assert graph.state(2) == "flying"
        graph.call(Empty, "/all/emergency")
        wait_for(lambda: graph.state(2) == graph.state(3) == "emergency")
        for k in (1, 2, 3):
            assert fleet.state_event(k, "locked")["reason"] == "emergency stop"
        # Nobody starts in an emergency, and the answer says what to do.
        answer = graph.call(Arm, "/cf1/arm", arm=True)
        assert "cf1 is emergency (emergency stop: service emergency): switch it off and on" in answer.message
        answer = graph.call(Takeoff, "/all/takeoff", height=0.5, duration=Duration(sec=2))
        assert (answer.success, "0 Crazyflies are usable, min_connected is 1" in answer.message) == (False, True)
        # A second bridge to the same Crazyflies does not start.
        result = run_bridge(f"config:={tmp_path / 'swarm.yaml'}")
        assert (result.returncode, "robots.cf1.uri" in result.stderr) == (2, True)


def run_bridge(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "dtsa_agent.crazyflie.node.bridge_node", "--ros-args"]
    for argument in arguments:
        command += ["-p", argument]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_bad_input_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    config = tmp_path / "swarm.yaml"
    config.write_text(yaml.safe_dump({"robots": {"cf1": {"uri": "udp://127.0.0.1:9"}}}))
    result = run_bridge("config:=/nowhere/swarm.yaml")
    assert (result.returncode, len(result.stderr.splitlines()), "config" in result.stderr) == (2, 1, True)
    for words in (
        (f"config:={config}", "safety.heartbeat_s:=-1.0"),
        (f"config:={config}", "safety.heart_beat_s:=1.0"),
        ("config=/nowhere/swarm.yaml",),
    ):
        result = run_bridge(*words)
        assert (result.returncode, "Traceback" in result.stderr) == (2, False)
        assert words[-1].partition(":=")[0] in result.stderr


def test_too_few_connected_ends_the_bridge(tmp_path: Path) -> None:
    config = tmp_path / "swarm.yaml"
    robots = {"cf1": {"uri": "udp://127.0.0.1:9"}}
    common = {"connect_attempts": 1, "connect_timeout_s": 0.3}
    config.write_text(yaml.safe_dump({"robots": robots, "all": common, "station": {"toc_cache": str(tmp_path)}}))
    result = run_bridge(f"config:={config}")
    assert result.returncode == 1
    assert "0 connected, min_connected is 1" in result.stdout + result.stderr
