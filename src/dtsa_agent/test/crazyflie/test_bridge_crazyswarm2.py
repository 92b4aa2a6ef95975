"""Integration: a flight as Crazyswarm2's programs fly, with its messages."""

from __future__ import annotations

import importlib.util
import signal
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("cflib")
rclpy = pytest.importorskip("rclpy")
pytest.importorskip("dtsa_msgs.srv")

from bridge_helpers import bridge_process, fake_fleet, settings  # noqa: E402
from builtin_interfaces.msg import Duration  # noqa: E402
from geometry_msgs.msg import Point, PoseStamped  # noqa: E402
from node_helpers import ServedNode  # noqa: E402
from rcl_interfaces.msg import Parameter, ParameterValue  # noqa: E402
from rcl_interfaces.srv import GetParameters, SetParameters  # noqa: E402
from std_srvs.srv import Empty  # noqa: E402
from waiting import wait_for  # noqa: E402

from dtsa_bench.flights.domain import ros_domain  # noqa: E402

pytestmark = pytest.mark.ros
MESSAGES = importlib.util.find_spec("crazyflie_interfaces") is not None


class Program(ServedNode):
    def __init__(self, domain: int) -> None:
        super().__init__(domain, "program")

    def listen(self, kind: Any, topic: str) -> list[Any]:
        heard: list[Any] = []
        self.node.create_subscription(kind, topic, heard.append, 10)
        return heard

    def get(self, name: str) -> ParameterValue:
        (value,) = self.call(GetParameters, "/crazyflie_server/get_parameters", names=[name]).values
        return value

    def set(self, name: str, number: int) -> bool:
        value = ParameterValue(type=2, integer_value=number)
        parameters = [Parameter(name=name, value=value)]
        (result,) = self.call(SetParameters, "/crazyflie_server/set_parameters", parameters=parameters).results
        return bool(result.successful)


@pytest.mark.slow
@pytest.mark.skipif(not MESSAGES, reason="crazyflie_interfaces is not in the workspace")
@pytest.mark.realtime
def test_a_flight_as_its_programs_fly(tmp_path: Path) -> None:
    from crazyflie_interfaces.msg import Status
    from crazyflie_interfaces.srv import GoTo, Land, StartTrajectory, Takeoff, UploadTrajectory

    with ros_domain() as domain, fake_fleet(tmp_path, 2) as fleet:
        config = tmp_path / "swarm.yaml"
        data = settings(fleet, {"safety": {"link_age_s": 3.0}})
        for k, robot in enumerate(data["robots"].values()):
            robot["initial_position"] = [(1.2, -1.2)[k], 0.0, 0.0]
        config.write_text(yaml.safe_dump(data))
        with bridge_process(domain, config) as process, closing(Program(domain)) as program:
            program.client(Empty, "/all/emergency")
            poses, status = program.listen(PoseStamped, "/cf1/pose"), program.listen(Status, "/cf1/status")
            # Parameters: of one, of all, of the robots; what cannot be is refused.
            assert list(program.get("robots.cf1.initial_position").double_array_value) == [1.2, 0.0, 0.0]
            assert program.get("robots.cf2.uri").string_value == fleet.uri(2)
            assert program.set("cf1.params.ring.effect", 7)
            assert program.set("all.params.led.bitmask", 128)
            assert not program.set("cf1.params.ring.effect", 300)
            assert not program.set("cf1.params.firmware.modified", 1)
            assert program.get("cf1.params.ring.effect").integer_value == 7
            assert program.get("cf2.params.ring.effect").integer_value == 6
            assert program.get("cf2.params.led.bitmask").integer_value == 128
            # Its library waits for the services of trajectories, which refuse. Nobody is armed: they arm themselves.
            for name in ("cf1", "cf2"):
                program.call(UploadTrajectory, f"/{name}/upload_trajectory", trajectory_id=1)
            program.call(StartTrajectory, "/all/start_trajectory", trajectory_id=1, timescale=1.0)
            assert program.set("cf1.params.hlCommander.groupmask", 2)
            program.call(Takeoff, "/all/takeoff", height=1.0, duration=Duration(sec=2), group_mask=4)
            program.call(Takeoff, "/all/takeoff", height=1.0, duration=Duration(sec=2))
            wait_for(lambda: abs(poses[-1].pose.position.z - 1.0) < 0.05)
            assert poses[-1].header.frame_id == "world"
            time.sleep(0.5)
            goal = Point(x=0.9, y=0.1, z=1.1)
            time.sleep(0.6)
            program.call(GoTo, "/cf1/go_to", goal=goal, yaw=1.0, duration=Duration(sec=1))
            wait_for(lambda: abs(poses[-1].pose.position.x - 0.9) < 0.03 and poses[-1].pose.orientation.z > 0.45)
            assert status[-1].supervisor_info & Status.SUPERVISOR_INFO_IS_FLYING
            assert 3.0 < status[-1].battery_voltage < 4.3
            program.call(Land, "/all/land", height=0.04, duration=Duration(sec=2))
            wait_for(lambda: len(fleet.events(name="land")) == 2)
            process.send_signal(signal.SIGINT)
            output, _ = process.communicate(timeout=60)
            assert process.returncode == 0, output
            for words in (
                "parameter cf1.params.ring.effect: ring.effect: 300 is no uint8_t",
                "none of cf1, cf2 is in a group of 4", "order /cf1/upload_trajectory",
                "trajectories are not supported",
            ):  # fmt: skip
                assert words in output
