"""Integration: nodes among other nodes: logs, namespaces, names of frames."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, call

import pytest
from node_helpers import Graph, end_of, ros_graph

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Configuration, RunStatus, Slot
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import DescribeParameters, GetParameters

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.node_process import log_where_possible
from dtsa_agent.ros.common.parameters import check_parameters
from dtsa_agent.ros.common.runs import WaitingLog

AGENT, HOST, CHANNEL = "dtsa_agent.ros.agent_node", "dtsa_agent.ros.swarm_host", "dtsa_channel_sim.ros.channel_node"


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    with ros_graph(tmp_path) as made:
        yield made


def test_waiting_is_said_at_once_and_then_ever_more_seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    logger, now = MagicMock(), 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    waiting, times = WaitingLog(logger), []
    for tenth in range(6000):
        now = 100.0 + 0.1 * tenth
        before = len(logger.mock_calls)
        waiting.log("waiting for cf3")
        if len(logger.mock_calls) > before:
            times.append(round(now - 100.0))
    assert logger.mock_calls[0] == call.info("waiting for cf3")
    assert {level for level, _, _ in logger.mock_calls[1:]} == {"warning"}
    gaps = [later - sooner for sooner, later in pairwise(times)]
    assert gaps == sorted(gaps)
    assert gaps[0] < 10
    assert max(gaps) <= 61
    waiting.log("waiting for cf4")
    assert logger.mock_calls[-1] == call.info("waiting for cf4")


def given_node(**given: object) -> MagicMock:
    """A node that has one parameter, and was given others."""
    node = MagicMock(_parameter_overrides={name: SimpleNamespace(value=value) for name, value in given.items()})
    node.get_parameters_by_prefix.return_value = {"policy": "dtsa"}
    return node


def test_a_misspelt_parameter_is_refused_or_warned_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["agent", "--ros-args", "-p", "polcy:=lease"])
    with pytest.raises(ConfigError, match=r"polcy: got 'lease'; allowed: .*; did you mean policy\?"):
        check_parameters(given_node(polcy="lease"))
    path = tmp_path / "other.yaml"
    path.write_text("/nobody:\n  ros__parameters:\n    policy: lease\n")
    monkeypatch.setattr("sys.argv", ["agent", "--ros-args", "--params-file", str(path)])
    node = given_node(polcy="lease")  # from a file, which may be for others as well
    check_parameters(node)
    assert node.get_logger.return_value.mock_calls == [
        call.warning("parameter polcy: this node has none of this name; did you mean policy?"),
        call.warning(f"{path}: nothing in it is for this node; it is for /nobody"),
    ]
    node = given_node(policy="lease")
    check_parameters(node)
    assert node.get_logger.return_value.mock_calls == []


def test_logs_go_where_they_can(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    home = {"HOME": "/", "ROS_HOME": str(tmp_path / "home")}
    log_where_possible(home)
    assert "ROS_LOG_DIR" not in home
    assert (tmp_path / "home" / "log").is_dir()
    refused = {"ROS_LOG_DIR": "/dev/null/log"}
    log_where_possible(refused)
    made = Path(refused["ROS_LOG_DIR"])
    assert made.is_dir()
    assert capsys.readouterr().err == f"/dev/null/log: Not a directory: logs are in {made}\n"
    made.rmdir()


@pytest.mark.parametrize(("swarm", "before"), [("/swarm", ""), ("/north", "/north")])
def test_names_of_the_default_swarm_are_short(swarm: str, before: str) -> None:
    assert names.agent_namespace(3, swarm) == f"{before}/cf3"
    assert names.body_frame(f"{before}/cf3") == f"{before}/cf3/base_link"[1:]
    assert names.clock_topic(swarm) == f"{before}/clock"


@pytest.mark.ros
def test_an_agent_that_waits_says_for_whom_and_where_it_lives_and_describes_its_parameters(graph: Graph) -> None:
    heard: list[Log] = []
    graph.node.create_subscription(Log, "/rosout", heard.append, 10)
    agent = graph.start(AGENT, "-p", "id:=2", "-p", "agents:=3", "-p", "swarm_namespace:=/north", logs=True)
    graph.until(lambda: any("waiting for a channel on /north/slot" in line.msg for line in heard))
    line = next(line for line in heard if "waiting" in line.msg)
    assert line.name == "north.cf2.agent"
    assert line.level in (Log.INFO, Log.WARN)
    describe = graph.node.create_client(DescribeParameters, "/north/cf2/agent/describe_parameters")
    get = graph.node.create_client(GetParameters, "/north/cf2/agent/get_parameters")
    graph.until(lambda: describe.service_is_ready() and get.service_is_ready())
    fields = [setting for setting in settings_of(SwarmConfig) if setting.kind != "structure"]
    described = graph.ask(describe, DescribeParameters.Request(names=[setting.name for setting in fields]))
    for setting, found in zip(fields, described.descriptors, strict=True):
        assert setting.help in found.description
        assert found.read_only
        assert setting.kind != "int" or found.integer_range
        assert setting.kind != "float" or found.floating_point_range[0].from_value == setting.minimum
        assert ", ".join(setting.choices or ()) in found.additional_constraints
    assert graph.ask(get, GetParameters.Request(names=["id"])).values[0].integer_value == 2
    code, said = end_of(agent, signal.SIGINT)
    assert code == 0
    assert "ends after slot -1: stopped by a signal" in said


@pytest.mark.ros
def test_late_subscribers_get_settings_and_status(graph: Graph) -> None:
    channel = graph.start(CHANNEL, "-r", "__ns:=/north", "-p", "agents:=2", "-p", "loss:=0.25")
    host = graph.start(HOST, "-r", "__ns:=/north", "-p", "agents:=2")
    settings: list[Configuration] = []
    status: list[RunStatus] = []
    graph.until(lambda: graph.node.get_publishers_info_by_topic("/north/status"))
    graph.node.create_subscription(Configuration, "/north/configuration", settings.append, names.latched_qos())
    graph.node.create_subscription(RunStatus, "/north/status", status.append, names.latched_qos())
    slots: list[Slot] = []
    graph.node.create_subscription(Slot, "/north/slot", slots.append, names.lockstep_qos(64))
    graph.until(lambda: settings and status and status[-1].phase == RunStatus.FLYING)
    graph.until(lambda: slots and slots[-1].phase == Slot.RUN and slots[-1].slot > 2)  # calls have numbers, too
    channel.send_signal(signal.SIGINT)
    graph.until(lambda: status[-1].phase == RunStatus.ENDED)
    assert settings[0].run == status[-1].run != 0
    assert '"loss": 0.25' in settings[0].settings
    assert status[-1].reason == "stopped by a signal"
    assert status[-1].slot > 0
    assert end_of(channel)[0] == 0
    assert end_of(host)[0] == 0
