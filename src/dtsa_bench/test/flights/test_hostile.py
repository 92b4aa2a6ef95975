"""Integration: strangers that publish into a flight change nothing; nodes that do not fit together begin none."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import subprocess
import threading
import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fly_helpers import PATIENCE_S, children, command, end_all, fly, frames
from node_helpers import Graph, end_of, graph_in, ros_graph
from waiting import wait_for

pytest.importorskip("dtsa_msgs.msg")

import dtsa_msgs.msg
from dtsa_msgs.msg import Frame, Process, Report, Slot, Transmission
from rclpy.serialization import serialize_message

from dtsa_agent.core import Frame as OwnState
from dtsa_agent.core.frame import ExtendedFrame, encode_extended
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.stamps import header_of
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.verify import verify_bag

pytestmark = pytest.mark.ros

CHANNEL, AGENT, HOST = ("dtsa_channel_sim.ros.channel_node", "dtsa_agent.ros.agent_node", "dtsa_agent.ros.swarm_host")
TOPICS = {
    names.SLOT: Slot,
    names.TRANSMISSION: Transmission,
    names.AIR_FRAME: Frame,
    names.REPORT: Report,
    names.PROCESS: Process,
}
SHAPE = ("--agents", "4", "--policy", "dtsa", "--processes", "2", "--no-picture", "--tail-s", "15", "--seed", "3")


def junk(random: np.random.Generator, kind: str, depth: int = 0) -> Any:
    """A value of a field, made from its type: often at the edge of what it can be, or beyond what it may be."""
    sequence = re.fullmatch(r"sequence<(\w+)>", kind)
    if sequence:
        count = int(random.choice([0, 0, 1, 2, 3, 4, 12, 300]))
        return [junk(random, sequence[1], depth + 1) for _ in range(count)]
    whole = re.fullmatch(r"(u?)int(\d+)", kind)
    if whole:
        low, high = (
            (0, 2 ** int(whole[2]) - 1) if whole[1] else (-(2 ** (int(whole[2]) - 1)), 2 ** (int(whole[2]) - 1) - 1)
        )
        return int(
            random.choice(
                np.array(
                    [0, 1, 2, 3, 4, 60, low, high, high // 2 + 1, int(random.integers(2**31)) % (high + 1)],
                    dtype=object,
                )
            )
        )
    if kind in ("double", "float"):
        return float(random.choice([0.0, -1.5, 1e300, math.nan, math.inf, -math.inf]))
    if kind == "string":
        return str(random.choice(["", "x", "{}", "[1]", "\u00e9" * 40]))
    assert kind == "std_msgs/Header", kind
    message = dtsa_msgs.msg.Slot().header
    message.stamp.sec, message.stamp.nanosec = (int(random.choice([0, 1, 2**31 - 1])) for _ in range(2))
    message.frame_id = junk(random, "string")
    return message


def malformed(random: np.random.Generator, cls: Any, run: int, slot: int) -> bytes:
    """A message of a type with junk in all its fields; most carry the run's id and a slot of these moments."""
    message = cls()
    for name, kind in cls.get_fields_and_field_types().items():
        setattr(message, name, junk(random, kind))
    if random.random() < 0.8:
        message.run = run
    if hasattr(message, "slot") and random.random() < 0.5:
        message.slot = slot if isinstance(message.slot, int) else [slot]
    data = bytes(serialize_message(message))
    if random.random() < 0.2:
        data = data[: int(random.integers(len(data)))] + bytes(random.bytes(5))
    return data


class Stranger:
    """Somebody in the flight's domain who hears its slot messages."""

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
    """Somebody who hears two agents fly in lockstep, their process, and their channel's.

    :param parameters: of the channel, beside the number of agents.
    """
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
    """A flight into which somebody publishes; its summary."""
    out = tmp_path / "flight"
    process = subprocess.Popen(
        command("--out", str(out), *words), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    try:
        wait_for(lambda: process.poll() is not None or children(process.pid))
        environment = Path(f"/proc/{children(process.pid)[0]}/environ").read_bytes().split(b"\0")
        domain = next(int(entry.partition(b"=")[2]) for entry in environment if entry.startswith(b"ROS_DOMAIN_ID="))
        with graph_in(domain, tmp_path / "log") as graph:
            disturb(Stranger(graph), process)
            _, said = process.communicate(timeout=PATIENCE_S)
    finally:
        end_all(process)
    assert process.returncode == 0, said
    assert "Traceback" not in said
    result = verify_bag(out)
    assert result.ok, result.difference
    return json.loads((out / "summary.json").read_text())


def flood(stranger: Stranger, process: subprocess.Popen[str]) -> None:
    random = np.random.default_rng(11)
    stranger.listen(3, process)
    for _ in range(60):
        for topic, kind in TOPICS.items():
            data = malformed(random, kind, stranger.last.run, stranger.slot)
            stranger.publishers[topic].publish(data)
        stranger.graph.executor.spin_once(timeout_sec=0.01)


def test_malformed_messages_of_every_kind_change_nothing_in_lockstep(tmp_path: Path, undisturbed: Path) -> None:
    summary = disturbed(tmp_path, flood, *SHAPE)
    assert frames(tmp_path / "flight") == frames(undisturbed)
    assert sum(summary["not_taken_in"].values()) > 60
    assert {"other run", "sizes", "unreadable"} <= set(summary["not_taken_in"])


def test_messages_with_the_live_run_id_that_once_ended_flights_change_nothing(
    tmp_path: Path, undisturbed: Path
) -> None:
    def attack(stranger: Stranger, process: subprocess.Popen[str]) -> None:
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
    assert frames(tmp_path / "flight") == frames(undisturbed)
    assert summary["not_taken_in"]["forged end"] >= 2


def test_a_bag_played_into_a_live_flight_changes_nothing(tmp_path: Path, undisturbed: Path) -> None:
    recorded = []
    with Bag(undisturbed / "bag") as bag:
        for record in bag.messages():
            recorded.append((record.topic, bytes(record.data)))

    def play(stranger: Stranger, process: subprocess.Popen[str]) -> None:
        stranger.listen(3, process)
        for topic, data in [entry for entry in recorded if entry[0].startswith("/swarm/")][:200]:
            name = topic.rpartition("/")[2]
            if name in TOPICS:
                stranger.publishers[name].publish(data)
                stranger.graph.executor.spin_once(timeout_sec=0.002)

    summary = disturbed(tmp_path, play, *SHAPE)
    assert frames(tmp_path / "flight") == frames(undisturbed)
    assert set(summary["not_taken_in"]) == {"other run"}


def test_malformed_messages_of_every_kind_end_and_freeze_nobody_in_real_time(tmp_path: Path) -> None:
    def attack(stranger: Stranger, process: subprocess.Popen[str]) -> None:
        stranger.listen(3, process)
        run = stranger.last.run
        hosted = Transmission(run=run, slot=stranger.slot, agent=[1, 2], length=[0, 0], offset_ns=[2**62, -(2**62)])
        for message in (hosted, Transmission(run=run, slot=4_000_000_000, agent=[1, 2], offset_ns=[0, 0])):
            stranger.publishers[names.TRANSMISSION].publish(message)
        for late_s in (2**31 - 1, 0):
            start = Slot(run=run, phase=Slot.START)
            start.header.stamp.sec = late_s
            stranger.publishers[names.SLOT].publish(start)
        flood(stranger, process)

    shape = ("--mode", "realtime", "--slot-ms", "20", "--policy", "lease", "--tail-s", "4")
    summary = disturbed(tmp_path, attack, *SHAPE, *shape)
    assert summary["end"] == "completed"
    assert summary["lost_agents"] == []
    assert sum(summary["not_taken_in"].values()) > 60


def test_well_formed_messages_of_a_stranger_with_the_live_run_id_are_not_believed(tmp_path: Path) -> None:
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
            stranger.publishers[names.SLOT].publish(
                Slot(
                    header=header,
                    run=run,
                    slot=slot,
                    phase=Slot.RUN,
                    heard_slot=slot,
                    sender=array("H", [1]),
                    length=array("B", [len(data)]),
                    data=data,
                    received=array("B", [15]),
                )
            )
            forged.append(bytes(data))
            stranger.graph.executor.spin_once(timeout_sec=0.005)
            if stranger.slot > begun + 40:
                return

    shape = ("--mode", "realtime", "--slot-ms", "20", "--policy", "lease", "--tail-s", "4")
    summary = disturbed(tmp_path, attack, *SHAPE, *shape)
    assert summary["not_taken_in"]["other sender"] >= len(forged)
    with Bag(tmp_path / "flight" / "bag") as bag:
        sent = {bytes(record.data) for record in bag.messages() if record.topic == "/swarm/frame"}
    assert not [data for data in forged if any(data in message for message in sent)]


# -- the handshake


def refused(tmp_path: Path, channel: tuple[str, ...], *agents: tuple[str, ...]) -> str:
    """What a channel says that refuses to begin a run with some agents."""
    with ros_graph(tmp_path) as graph:
        for values in agents:
            graph.start(AGENT, *(word for value in values for word in ("-p", value)))
        code, said = end_of(graph.start(CHANNEL, *(word for value in channel for word in ("-p", value))))
        assert code == 2, said
        refused = re.search(r" of /cf(\d)/agent", said)
        assert refused
        index = next(i for i, values in enumerate(agents) if f"id:={refused[1]}" in values)
        code, told = end_of(graph.processes[index])
        assert code == 2
        assert told.strip().splitlines()[-1].startswith(f"agent: error: {said.split('error: ')[1][:20]}")
    return said.strip().splitlines()[-1]


@pytest.mark.parametrize(
    ("channel", "second", "said"),
    [
        (
            ("agents:=2",),
            ("id:=2", "seed:=7"),
            r"seed of /cf[12]/agent: got [17]; allowed: [17], as /cf[12]/agent has it",
        ),
        (
            ("agents:=2",),
            ("id:=2", "slot_ms:=20"),
            r"slot_ms of /cf2/agent: got 20\.0; allowed: 10\.0, as /swarm/channel has it",
        ),
        (
            ("agents:=2",),
            ("id:=2", "mode:=realtime"),
            r"mode of /cf2/agent: got 'realtime'; allowed: 'lockstep', as /swarm",
        ),
        (
            ("agents:=2",),
            ("id:=2", "policy:=aloha"),
            r"policy of /cf[12]/agent: got '\w+'; allowed: '\w+', as /cf[12]/agent",
        ),
    ],
)
def test_settings_that_differ_are_refused_before_slot_0(
    tmp_path: Path, channel: tuple[str, ...], second: tuple[str, ...], said: str
) -> None:
    line = refused(tmp_path, channel, ("id:=1", "agents:=2"), ("agents:=2", *second))
    assert re.search(f"channel: error: {said}", line), line


def test_two_processes_with_the_same_agent_are_refused_before_slot_0(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        for name in ("one", "two"):
            graph.start(AGENT, "-r", f"__node:={name}", "-p", "id:=1", "-p", "agents:=2")
        code, said = end_of(graph.start(CHANNEL, "-p", "agents:=2"))
    assert code == 2
    assert re.search(
        r"ids of /cf1/(one|two): got \[1\]; allowed: agents of no other process; /cf1/(one|two) has cf1", said
    )


def test_a_second_channel_is_refused_and_the_first_flies_on(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        stranger, host, first = two_in_flight(graph)
        run, slot = stranger.last.run, stranger.slot
        code, said = end_of(graph.start(CHANNEL, "-r", "__node:=second", "-p", "agents:=2"))
        graph.processes.pop()
        assert code == 2
        # The other channel, or its agents, whichever is noticed first; the test's own node publishes there as well.
        channel = r"allowed: no other channel on /swarm/slot; there is .*/swarm/channel"
        agents = r"run of /swarm/swarm_host: got '[0-9a-f]{8}'; allowed: no process of another run"
        assert re.search(f"{channel}|{agents}", said)
        graph.until(lambda: stranger.last.run == run and stranger.slot > slot + 5)
        assert host.poll() is None
        assert end_of(first, signal.SIGTERM)[0] == 0
        assert end_of(host)[0] == 0


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


@pytest.mark.parametrize("restarted", [False, True])
def test_agents_end_when_their_channel_is_killed_whoever_comes_after_it(tmp_path: Path, restarted: bool) -> None:
    with ros_graph(tmp_path) as graph:
        _, host, channel = two_in_flight(graph)
        channel.kill()
        channel.communicate()
        killed = time.monotonic()
        graph.processes.remove(channel)
        if restarted:
            graph.start(CHANNEL, "-p", "agents:=2")
        code, said = end_of(host)
        took = time.monotonic() - killed
        assert code == 1
        assert re.search(r"error: the channel has gone after slot \d+ without ending the run", said)
        assert took < 30.0  # 2 s on a machine with nothing else to do


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


def test_a_missing_key_is_noticed_before_anything_is_written(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "DTSA_AUTH_KEY"}
    for key in ({}, {"DTSA_AUTH_KEY": "ab" * 16}):
        done = subprocess.run(
            command("--out", str(tmp_path / "flight"), "--agents", "2", "--auth"),
            env={**environment, **key},
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert not (tmp_path / "flight").exists()


def test_each_flight_has_a_session_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", "7c1f0a93e4d25b6880b13f96c2de470a")
    sent, sessions = [], []
    for name in ("one", "two"):
        fly(tmp_path / name, *SHAPE, "--auth", "--timeout-s", "0.3")
        sent.append(frames(tmp_path / name))
        with Bag(tmp_path / name / "bag") as bag:
            sessions.append(bag.config["swarm"]["auth_session"])
        assert verify_bag(tmp_path / name).ok
    assert len(set(sessions)) == 2
    assert all(sessions)
    assert [entry[:2] for entry in sent[0]] == [entry[:2] for entry in sent[1]]
    assert all(a[2][:-4] == b[2][:-4] and a[2] != b[2] for a, b in zip(*sent, strict=True))
