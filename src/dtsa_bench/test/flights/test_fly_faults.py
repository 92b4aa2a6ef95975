"""Integration: nodes that send garbage are named, and everything ends. What else may fail: tools/test/faults."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from node_helpers import end_of, ros_graph

pytest.importorskip("dtsa_msgs.msg")


pytestmark = pytest.mark.ros


NOISE = """
import json, sys, rclpy
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.settings.config import agreed_settings, settings_hash
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
        ("nan", "channel: error: cf2 sent garbage in slot 5: cf2 sent an unusable answer: positions, velocities or"),
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
