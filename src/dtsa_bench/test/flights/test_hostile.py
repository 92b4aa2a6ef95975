"""Integration: strangers that publish into a flight change nothing; nodes that do not fit together begin none."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import threading
import time
from array import array
from pathlib import Path
from random import Random
from typing import Any

import pytest
from faults.graph import random_message
from fly_helpers import children, fly, frames, start_flight, summary_of
from node_helpers import Graph, end_of, graph_in, ros_graph
from waiting import wait_for

pytest.importorskip("dtsa_msgs.msg")

from dtsa_msgs.msg import Frame, Process, Report, Slot, Transmission
from frame_helpers import encode_extended
from rclpy.serialization import serialize_message

from dtsa_agent.core import Frame as OwnState
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.frame import ExtendedFrame
from dtsa_agent.core.settings.config import agreed_settings, settings_hash
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.messages import header_of
from dtsa_bench.log.record import load_log
from dtsa_bench.log.verify.check import verify_bag

pytestmark = pytest.mark.ros

CHANNEL, AGENT, HOST = ("dtsa_channel_sim.ros.channel_node", "dtsa_agent.ros.agent_node", "dtsa_agent.ros.swarm_host")
TOPICS = {
    names.SLOT: Slot, names.TRANSMISSION: Transmission, names.AIR_FRAME: Frame, names.REPORT: Report,
    names.PROCESS: Process,
}  # fmt: skip
SHAPE = ("--agents", "4", "--policy", "dtsa", "--processes", "2", "--no-picture", "--tail-s", "15", "--seed", "3")
REALTIME = ("--mode", "realtime", "--slot-ms", "20", "--policy", "lease", "--tail-s", "8")


def malformed(pick: Random, cls: Any, run: int, slot: int) -> bytes:
    """A message of a type with junk in all its fields; most carry the run's id and a slot of these moments."""
    message = random_message(cls, pick)
    if pick.random() < 0.8:
        message.run = run
    if hasattr(message, "slot") and pick.random() < 0.5:
        message.slot = slot if isinstance(message.slot, int) else [slot]
    data = bytes(serialize_message(message))
    if pick.random() < 0.2:
        data = data[: pick.randrange(len(data))] + pick.randbytes(5)
    return data


class Stranger:
    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.last = Slot()
        self.slot = 0  # the last that has begun
        qos = names.lockstep_qos(8)
        self.publishers = {
            topic: graph.node.create_publisher(kind, f"/swarm/{topic}", qos) for topic, kind in TOPICS.items()
        }
        graph.node.create_subscription(Slot, "/swarm/slot", self._hear, qos)

    def _hear(self, message: Slot) -> None:
        if message.phase in (Slot.RUN, Slot.PREPARE):
            self.last = message
            self.slot = message.slot if message.phase == Slot.RUN else 0

    def listen(self, slot: int, process: subprocess.Popen[str]) -> None:
        """Waits until a slot has begun, and all that listen to the topics of a run would hear what is published."""
        count = self.graph.node.count_subscribers

        def heard() -> bool:
            found = {topic: count(f"/swarm/{topic}") for topic in self.publishers}
            agents = found[names.SLOT] > 1  # and not this node alone
            return agents and all(p.get_subscription_count() >= found[t] for t, p in self.publishers.items())

        self.graph.until(lambda: (self.last.run and self.slot >= slot and heard()) or process.poll() is not None)


def two_in_flight(graph: Graph, *parameters: str) -> tuple[Stranger, subprocess.Popen[str], subprocess.Popen[str]]:
    stranger = Stranger(graph)
    host = graph.start(HOST, "-p", "agents:=2")
    channel = graph.start(CHANNEL, *(word for given in ("agents:=2", *parameters) for word in ("-p", given)))
    stranger.listen(5, channel)
    return stranger, host, channel


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("undisturbed") / "flight"
    fly(out, *SHAPE)
    return out


def disturbed(tmp_path: Path, disturb: Any, *words: str) -> dict[str, Any]:
    with start_flight(tmp_path, *words, begun=False) as flight:
        node = wait_for(lambda: children(flight.process.pid))[0]
        domain = int(flight.environment(node)["ROS_DOMAIN_ID"])
        with graph_in(domain, tmp_path / "log") as graph:
            disturb(Stranger(graph), flight.process)
            flight.assert_ends(0)
    flight.assert_verifies()
    return summary_of(flight.out)


def flood(stranger: Stranger, process: subprocess.Popen[str]) -> None:
    pick = Random(11)
    stranger.listen(3, process)
    for _ in range(60):
        for topic, kind in TOPICS.items():
            stranger.publishers[topic].publish(malformed(pick, kind, stranger.last.run, stranger.slot))
        stranger.graph.executor.spin_once(timeout_sec=0.01)


def test_malformed_messages_and_the_live_run_id_change_nothing_in_lockstep(tmp_path: Path, undisturbed: Path) -> None:
    """The second ones once ended flights."""

    def attack(stranger: Stranger, process: subprocess.Popen[str]) -> None:
        flood(stranger, process)
        agents = children(process.pid)
        for number in (signal.SIGSTOP, signal.SIGCONT):  # they are slow: a stranger's garbage is not taken for theirs
            for pid in agents:
                os.kill(pid, number)
            stranger.publishers[names.TRANSMISSION].publish(bytes([0, 1, 0, 0]) + bytes([255]) * 40)
            time.sleep(0.8)
        stranger.listen(10, process)
        run = stranger.last.run
        for slot in (0, 5, stranger.slot + 1, 4_000_000_000):
            for message in (
                Slot(run=run, slot=slot, sender=array("H", [1])),
                Slot(run=run, slot=slot, phase=Slot.END),
                Slot(run=run, slot=slot, phase=Slot.END, data=array("B", bytes(16))),
                Slot(run=run, slot=slot, phase=Slot.PREPARE),
            ):
                stranger.publishers[names.SLOT].publish(message)
                stranger.graph.executor.spin_once(timeout_sec=0.01)
            stranger.publishers[names.TRANSMISSION].publish(
                Transmission(run=run, slot=slot, agent=[1, 2], offset_ns=[2**62, 0], length=[60, 0], data=[1] * 60)
            )

    summary = disturbed(tmp_path, attack, *SHAPE)
    assert frames(tmp_path / "out") == frames(undisturbed)
    assert sum(summary["not_taken_in"].values()) > 60
    assert {"other run", "sizes", "unreadable"} <= set(summary["not_taken_in"])
    assert summary["not_taken_in"]["forged end"] >= 2


def test_messages_of_every_kind_end_and_freeze_nobody_in_real_time_and_are_not_believed(tmp_path: Path) -> None:
    forged = []

    def attack(stranger: Stranger, process: subprocess.Popen[str]) -> None:
        """Frames in the name of agent 1, as they will be due, and deliveries of them that the channel never made."""
        stranger.listen(3, process)
        run, begun = stranger.last.run, stranger.slot
        for _ in range(400):
            slot = stranger.slot + 2
            said = OwnState(sender=1, slot=slot, c_r=1, position=(9.0, 9.0, 1.0), velocity=(0.0, 0.0, 0.0))
            data = array("B", encode_extended(ExtendedFrame(said)))
            header = header_of(names.slot_time_ns(slot, 20_000_000))
            stranger.publishers[names.AIR_FRAME].publish(Frame(header=header, run=run, slot=slot, agent=1, data=data))
            delivery = Slot(
                header=header, run=run, slot=slot, phase=Slot.RUN, heard_slot=slot, sender=array("H", [1]),
                length=array("B", [len(data)]), data=data, received=array("B", [15]),
            )  # fmt: skip
            stranger.publishers[names.SLOT].publish(delivery)
            forged.append(bytes(data))
            stranger.graph.executor.spin_once(timeout_sec=0.005)
            if stranger.slot > begun + 40:
                break
        hosted = Transmission(run=run, slot=stranger.slot, agent=[1, 2], length=[0, 0], offset_ns=[2**62, -(2**62)])
        for message in (hosted, Transmission(run=run, slot=4_000_000_000, agent=[1, 2], offset_ns=[0, 0])):
            stranger.publishers[names.TRANSMISSION].publish(message)
        for late_s in (2**31 - 1, 0):
            start = Slot(run=run, phase=Slot.START)
            start.header.stamp.sec = late_s
            stranger.publishers[names.SLOT].publish(start)
        flood(stranger, process)

    summary = disturbed(tmp_path, attack, *SHAPE, *REALTIME)
    assert summary["end"] == "completed"
    assert summary["lost_agents"] == []
    assert sum(summary["not_taken_in"].values()) > len(forged) + 60
    assert summary["not_taken_in"]["other sender"] >= len(forged)
    sent = load_log(tmp_path / "out").sent_frames.data
    assert not [data for data in forged if any(data in frame for frame in sent)]


@pytest.mark.parametrize(("second", "said"), [
    ("seed:=7", r"seed of /cf[12]/agent: got [17]; allowed: [17], as /cf[12]/agent has it"),
    ("slot_ms:=20", r"slot_ms of /cf2/agent: got 20\.0; allowed: 10\.0, as /swarm/channel has it"),
    ("mode:=realtime", r"mode of /cf2/agent: got 'realtime'; allowed: 'lockstep', as /swarm"),
    ("policy:=aloha", r"policy of /cf[12]/agent: got '\w+'; allowed: '\w+', as /cf[12]/agent"),
])  # fmt: skip
def test_settings_that_differ_are_refused_before_slot_0(tmp_path: Path, second: str, said: str) -> None:
    with ros_graph(tmp_path) as graph:
        for words in (["-p", "id:=1"], ["-p", "id:=2", "-p", second]):
            graph.start(AGENT, "-p", "agents:=2", *words)
        code, line = end_of(graph.start(CHANNEL, "-p", "agents:=2"))
        assert code == 2, line
        refused = re.search(r" of /cf(\d)/agent", line)
        assert refused
        code, told = end_of(graph.processes[int(refused[1]) - 1])
        assert code == 2
        assert told.strip().splitlines()[-1].startswith(f"agent: error: {line.split('error: ')[1][:20]}")
    assert re.search(f"channel: error: {said}", line.strip().splitlines()[-1]), line


def test_processes_of_another_run_are_refused_and_fly_on_in_their_own(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        stranger, host, channel = two_in_flight(graph)
        channel.send_signal(signal.SIGSTOP)
        code, said = end_of(graph.start(CHANNEL, "-r", "__node:=second", "-p", "agents:=2"))
        graph.processes.pop()
        assert code == 2
        assert re.search(r"run of /swarm/swarm_host: got '[0-9a-f]{8}'; allowed: no process of another run", said)
        slot = stranger.slot
        channel.send_signal(signal.SIGCONT)
        graph.until(lambda: stranger.slot > slot + 20)
        assert host.poll() is channel.poll() is None


def test_a_channel_that_stood_still_waits_for_answers_that_it_has_not_read_yet(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        stranger, host, channel = two_in_flight(graph, "answer_s:=0.5")
        for _ in range(3):
            host.send_signal(signal.SIGSTOP)
            time.sleep(0.2)  # the channel waits for its answer now
            channel.send_signal(signal.SIGSTOP)
            host.send_signal(signal.SIGCONT)
            time.sleep(0.6)
            channel.send_signal(signal.SIGCONT)
            slot = stranger.slot + 20
            graph.until(lambda slot=slot: stranger.slot > slot)
        assert host.poll() is channel.poll() is None


def test_a_channel_whose_agents_hang_ends_however_much_others_say(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        stranger, host, channel = two_in_flight(graph, "answer_s:=0.5")
        host.send_signal(signal.SIGSTOP)
        graph.processes.remove(channel)
        answer = Transmission(run=stranger.last.run + 1)
        heard = threading.Event()

        def talk() -> None:  # without a pause as long as the channel waits for a message
            while not heard.wait(0.005):
                stranger.publishers[names.TRANSMISSION].publish(answer)

        talking = threading.Thread(target=talk, daemon=True)
        talking.start()
        try:
            code, said = end_of(channel)
        finally:
            heard.set()
            talking.join()
        assert code == 1
        assert "did not answer slot" in said


def test_late_duplicates_and_late_conflicts_are_sent_away_and_the_flight_goes_on(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        stranger = Stranger(graph)
        shared = ("-p", "mode:=realtime", "-p", "agents:=2")
        swarm = (*shared, "-p", "policy:=lease", "-p", "slot_ms:=20")
        host = graph.start(HOST, *swarm)
        channel = graph.start(CHANNEL, *shared, "-p", "slot_ns:=20000000", "-p", "steps:=2")
        stranger.listen(5, channel)
        for more, said in (
            ((), r"ids of /cf1/agent: got \[1\]; allowed: agents of no other process; /swarm/swarm_host has cf1"),
            (("-p", "seed:=9"), r"seed of /cf1/agent: got 9; allowed: 1, as /swarm/swarm_host has it"),
        ):
            late = graph.start(AGENT, *swarm, "-p", "id:=1", *more)
            code, told = end_of(late)
            assert code == 2
            assert re.search(said, told)
            graph.processes.remove(late)
        slot = stranger.slot
        graph.until(lambda: stranger.slot > slot + 5)
        assert host.poll() is channel.poll() is None
        assert end_of(channel, signal.SIGTERM)[0] == 0
        assert end_of(host)[0] == 0


def test_each_flight_has_a_session_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", "7c1f0a93e4d25b6880b13f96c2de470a")
    sent, sessions = [], []
    for name in ("one", "two"):
        fly(tmp_path / name, *SHAPE, "--auth", "--timeout-s", "0.3")
        sent.append(frames(tmp_path / name))
        sessions.append(load_log(tmp_path / name).settings["swarm"]["auth_session"])
        assert verify_bag(tmp_path / name).ok
    assert len(set(sessions)) == 2
    assert all(sessions)
    assert [entry[:2] for entry in sent[0]] == [entry[:2] for entry in sent[1]]
    assert all(a[2][:-4] == b[2][:-4] and a[2] != b[2] for a, b in zip(*sent, strict=True))


UNUSABLE = "cf2 sent an unusable answer: "


@pytest.mark.parametrize(
    ("garbage", "said"),
    [
        (bytes([0, 1, 0, 0]) + bytes([255]) * 40, "a message of 44 bytes that is no Transmission"),
        ([float("nan")] * 3, f"{UNUSABLE}positions, velocities or"),
        ([0.0] * 4, f"{UNUSABLE}4 numbers in track for 1 agents"),
    ],
    ids=["bytes", "nan", "shape"],
)
def test_a_node_that_sends_garbage_is_named_and_the_others_end(tmp_path, garbage, said):
    settings = agreed_settings(SwarmConfig(agents=2), "lockstep")
    shown = {"settings": json.dumps(settings), "settings_hash": settings_hash(settings)}
    nothing = [0.0] * 3
    answer = Transmission(
        agent=[2], length=[0], steps=1, track=nothing, velocity=nothing, command=nothing,
        chosen=[0], reason=[0], digest=[0], score=[0.0],
    )  # fmt: skip
    with ros_graph(tmp_path) as graph:
        hello = graph.node.create_publisher(Process, "/swarm/process", 10)
        answers = graph.node.create_publisher(Transmission, "/swarm/transmission", 10)

        def hear(slot: Slot) -> None:
            if slot.phase == Slot.PREPARE:
                hello.publish(Process(run=slot.run, process=2, node="/noise", agent=[2], **shown))
            if slot.phase == Slot.RUN:
                answer.run, answer.slot = slot.run, slot.slot
                if slot.slot >= 5 and isinstance(garbage, list):
                    answer.track = garbage
                is_noise = slot.slot >= 5 and isinstance(garbage, bytes)
                answers.publish(garbage if is_noise else bytes(serialize_message(answer)))

        graph.node.create_subscription(Slot, "/swarm/slot", hear, 10)
        channel = graph.start("dtsa_channel_sim.ros.channel_node", "-p", "agents:=2")
        agent = graph.start("dtsa_agent.ros.agent_node", "-p", "id:=1", "-p", "agents:=2")
        graph.processes.remove(channel)
        graph.until(lambda: channel.poll() is not None)
        code, error = end_of(channel)
        assert code == 1  # the middleware may have said something before
        assert error.splitlines()[-1].startswith(f"channel: error: cf2 sent garbage in slot 5: {said}")
        assert end_of(agent) == (0, "")
