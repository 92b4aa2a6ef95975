"""The small `ros2` command, with a real node. Other tests start nodes with `ros2 run`."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

pytest.importorskip("rclpy")

from waiting import wait_for

from dtsa_bench.flights.domain import ros_domain

TALKER = """
import rclpy
from nav_msgs.msg import Odometry
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("talker")
node.declare_parameter("speed", 2)
publisher = node.create_publisher(String, "words", 10)
place = node.create_publisher(Odometry, "place", 10)
node.create_timer(0.05, lambda: (publisher.publish(String(data="hello")), place.publish(Odometry())))
print("ready", flush=True)
rclpy.spin(node)
"""
Ros2 = Callable[..., tuple[int, str]]


@pytest.fixture(scope="module")
def ros2(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros2]:
    """Exit code and output of a command, beside a node that talks."""
    with ros_domain() as domain:
        logs = str(tmp_path_factory.mktemp("log"))
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": logs, "PYTHONUNBUFFERED": "1"}

        def run(*words: str, lines: int = 0) -> tuple[int, str]:
            with subprocess.Popen(
                [sys.executable, "-m", "dtsa_dev.ros2", *words],
                env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
            ) as process:  # fmt: skip
                assert process.stdout is not None
                if not lines:
                    text = process.stdout.read()
                    return process.wait(60), text
                text = "".join(process.stdout.readline() for _ in range(lines))
                process.terminate()
                return process.wait(60), text

        with subprocess.Popen([sys.executable, "-c", TALKER], env=environment, stdout=subprocess.PIPE) as talker:
            assert talker.stdout is not None
            talker.stdout.readline()
            yield run
            talker.kill()


@pytest.mark.ros
def test_the_graph(ros2: Ros2) -> None:
    wait_for(lambda: ros2("node", "list") == (0, "/talker\n"))
    wait_for(lambda: "/words\n" in ros2("topic", "list")[1])
    wait_for(lambda: "/talker/get_parameters\n" in ros2("service", "list")[1])
    assert ros2("topic", "echo", "/words", "--once") == (0, "data: hello\n---\n")
    code, text = ros2("topic", "hz", "/words", lines=1)
    assert code == 130
    assert 1 < float(text.removeprefix("average rate: ")) < 40
    assert ros2("topic", "echo", "/nothing")[0] == 2
    code, text = ros2("topic", "echo", "/place", "--once")
    assert code == 0
    assert yaml.safe_load(text.removesuffix("---\n"))["pose"]["covariance"] == [0.0] * 36


@pytest.mark.ros
def test_parameters_and_services(ros2: Ros2) -> None:
    assert "speed\n" in ros2("param", "list", "/talker")[1]
    assert ros2("param", "set", "/talker", "speed", "3") == (0, "done\n")
    assert ros2("param", "get", "/talker", "speed") == (0, "3\n")
    kind = "rcl_interfaces/srv/GetParameters"
    assert "integer_value: 3\n" in ros2("service", "call", "/talker/get_parameters", kind, "{names: [speed]}")[1]


@pytest.mark.ros
@pytest.mark.parametrize("words", [
    ("param", "get", "/talker", "nothing"), ("param", "set", "/talker", "speed", "fast"),
    *(("service", "call", "/talker/get_parameters", "rcl_interfaces/srv/GetParameters", text)
      for text in ("{names: [speed", "{nothing: 1}", "{names: 5}", "5")),
    ("service", "call", "/talker/get_parameters", "rcl_interfaces/srv/Nothing"),
    ("service", "call", "/talker/get_parameters", "nothing"),
    ("topic", "echo", "/words", "--nothing"),
])  # fmt: skip
def test_what_is_refused_is_an_error(words: tuple[str, ...], ros2: Ros2) -> None:
    code, text = ros2(*words)
    assert code == 2
    assert "Traceback" not in text


def test_nodes_and_interfaces(ros2: Ros2, tmp_path: Path) -> None:
    assert ros2("--help")[0] == 0
    assert "dtsa_agent agent\n" in ros2("pkg", "executables")[1]
    assert "uint32 run " in ros2("interface", "show", "dtsa_msgs/msg/Slot")[1]
    code, text = ros2("run", "dtsa_bench", "dtsa", "--version")
    assert (code, text.split()[0]) == (0, "dtsa")
    for words in (("run", "dtsa_agent", "nothing"), ("launch", "x"), ("interface", "show", "dtsa_msgs/msg/None")):
        assert ros2(*words)[0] == 2
    assert ros2("bag", "info", str(tmp_path))[0] == 2
