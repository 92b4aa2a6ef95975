"""Flights that do not go well: signals, dead, hung and mad nodes. Everything ends, and the bag can be read."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from fly_helpers import ENDLESS, PATIENCE_S, children, command, flying, pid_of, readable, until
from node_helpers import end_of, ros_graph

pytest.importorskip("dtsa_msgs.msg")


pytestmark = pytest.mark.ros


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_flight_leaves_no_process_and_a_readable_bag(tmp_path: Path, number: int) -> None:
    with flying(tmp_path / "out", *ENDLESS) as process:
        assert len(children(process.pid)) == 3
        process.send_signal(number)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 130
        assert "interrupted" in said
        assert children(process.pid) == []
        assert readable(tmp_path / "out") > 10
        assert json.loads((tmp_path / "out" / "summary.json").read_text())["end"] == "stopped"


@pytest.mark.parametrize("started", [1, 3])
def test_a_signal_during_the_start_leaves_no_process(tmp_path: Path, started: int) -> None:
    process = subprocess.Popen(command("--out", str(tmp_path / "out"), *ENDLESS), stderr=subprocess.PIPE, text=True)
    until(lambda: len(children(process.pid)) >= started)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 130
    assert "Traceback" not in said
    assert children(process.pid) == []


def test_a_killed_agent_is_named_and_everything_ends(tmp_path: Path) -> None:
    with flying(tmp_path / "out", *ENDLESS) as process:
        victim = pid_of(process.pid, 2)
        os.kill(victim, signal.SIGKILL)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1
        assert said.splitlines()[-1] == f"dtsa: error: cf2 (process {victim}) was killed by SIGKILL"
        assert children(process.pid) == []
        assert readable(tmp_path / "out") > 10


def test_a_hung_agent_is_named_and_everything_ends(tmp_path: Path) -> None:
    with flying(tmp_path / "out", *ENDLESS, "--answer-s", "1") as process:
        os.kill(pid_of(process.pid, 3), signal.SIGSTOP)
        _, said = process.communicate(timeout=PATIENCE_S)
        assert process.returncode == 1
        assert re.search(r"cf3 did not answer slot \d+ within 1 s: dead or hung\?$", said.strip())
        assert children(process.pid) == []
        assert readable(tmp_path / "out") > 10


def test_agents_do_not_outlive_a_killed_flight(tmp_path: Path) -> None:
    with flying(tmp_path / "out", *ENDLESS) as process:
        assert len(children(process.pid)) == 3
        process.kill()
        process.wait()
        until(lambda: not children(process.pid))
    recovered = subprocess.run(
        [sys.executable, "-m", "dtsa_bench", "recover", str(tmp_path / "out" / "bag")],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
    )
    assert recovered.returncode == 0, recovered.stderr


NOISE = """
import json, sys, rclpy
from dtsa_agent.core import SwarmConfig
from dtsa_agent.ros.common.agreement import agreed_settings, settings_hash
from dtsa_msgs.msg import Process, Slot, Transmission
from rclpy.serialization import serialize_message
rclpy.init()
node = rclpy.create_node("noise")
publisher = node.create_publisher(Transmission, "/swarm/transmission", 10)
message = Transmission(agent=[2], length=[0], steps=1, track=[0.0] * 3, velocity=[0.0] * 3, command=[0.0] * 3,
                       chosen=[0], reason=[0], digest=[0], score=[0.0])
settings = agreed_settings(SwarmConfig(agents=2), "lockstep")
shown = dict(settings=json.dumps(settings), settings_hash=settings_hash(settings))
hello = node.create_publisher(Process, "/swarm/process", 10)
def answer(slot):
    if slot.phase == Slot.PREPARE:
        hello.publish(Process(run=slot.run, process=2, node="/noise", agent=[2], **shown))
    if slot.phase != Slot.RUN:
        return
    message.run, message.slot = slot.run, slot.slot
    data = bytes(serialize_message(message))
    if slot.slot >= 5:
        kind = sys.argv[1]
        if kind == "bytes":
            data = bytes([0, 1, 0, 0]) + bytes([255]) * 40
        else:
            message.track = [float("nan")] * 3 if kind == "nan" else [0.0] * 4
            data = bytes(serialize_message(message))
    publisher.publish(data)
node.create_subscription(Slot, "/swarm/slot", answer, 10)
rclpy.spin(node)
"""


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("bytes", "channel: error: cf2 sent garbage in slot 5: a message of 44 bytes that is no Transmission"),
        (
            "nan",
            "channel: error: cf2 sent garbage in slot 5: cf2 sent an unusable answer: positions, velocities or",
        ),
        (
            "shape",
            "channel: error: cf2 sent garbage in slot 5: cf2 sent an unusable answer: 4 numbers in track for 1 agents",
        ),
    ],
)
def test_a_node_that_sends_garbage_is_named_and_the_others_end(tmp_path: Path, kind: str, said: str) -> None:
    with ros_graph(tmp_path) as graph:
        channel = graph.start("dtsa_channel_sim.ros.channel_node", "-p", "agents:=2")
        agent = graph.start("dtsa_agent.ros.agent_node", "-p", "id:=1", "-p", "agents:=2")
        noise = subprocess.Popen([sys.executable, "-c", NOISE, kind], env=graph.environment, stderr=subprocess.DEVNULL)
        try:
            code, error = end_of(channel)
            assert code == 1
            assert error.splitlines()[-1].startswith(said)  # the middleware may have said something before
            assert end_of(agent) == (0, "")
        finally:
            noise.kill()
            noise.wait()
