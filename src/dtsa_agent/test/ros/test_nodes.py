"""Integration: the agents' nodes as real processes: parameters, answers, ends. The test plays the channel."""

from __future__ import annotations

import signal
import subprocess
import time
from array import array
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from node_helpers import Graph, end_of, ros_graph
from process_helpers import segments_of

pytest.importorskip("dtsa_msgs.msg")

from builtin_interfaces.msg import Time
from dtsa_msgs.msg import Frame, Process, Report, Slot, SlotRecord, Transmission
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

from dtsa_agent.core import REASONS, SwarmConfig, decode_frame, make_scenario
from dtsa_agent.core.frame import decode_extended
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import split_frames
from dtsa_agent.ros.common.messages import time_of
from dtsa_agent.ros.common.runs import Run

AGENT, HOST = "dtsa_agent.ros.agent_node", "dtsa_agent.ros.swarm_host"
CRAZYFLIE_AGENTS = "dtsa_agent.crazyflie.node.agents_node"


class Channel:
    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self.answers: list[Transmission] = []
        self.run = Run.draw()
        self.processes: list[Process] = []  # what processes have told about themselves
        qos = names.lockstep_qos()
        graph.node.create_subscription(Process, "/swarm/process", self.processes.append, qos)
        self.publisher = graph.node.create_publisher(Slot, "/swarm/slot", qos)
        graph.node.create_subscription(Transmission, "/swarm/transmission", self.answers.append, qos)

    def call(self) -> Process:
        self.graph.until(lambda: self.processes, self.publish_call)
        return self.processes[-1]

    def publish_call(self) -> None:
        self.publisher.publish(Slot(run=self.run.number, phase=Slot.PREPARE, data=array("B", self.run.call("/test"))))

    def end(self, slot: int) -> None:
        proof = array("B", self.run.proof)
        self.publisher.publish(Slot(run=self.run.number, slot=slot, phase=Slot.END, data=proof))

    def ask(self, slot: int, phase: int = Slot.RUN, **fields: object) -> Transmission:
        """Opens a slot and waits for the answer; slot 0 is repeated until the node is there."""
        if not slot:
            self.call()
        message = Slot(run=self.run.number, slot=slot, phase=phase, heard_slot=max(0, slot - 1), **fields)
        before = len(self.answers)
        if slot:
            self.publisher.publish(message)
        repeat = (lambda: None) if slot else (lambda: self.publisher.publish(message))
        self.graph.until(lambda: len(self.answers) > before and self.answers[-1].slot == slot, repeat)
        return self.answers[-1]


@pytest.mark.ros
def test_an_agent_answers_slot_by_slot_sends_odometry_and_ends_when_told(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        channel = Channel(graph)
        heard: list[Odometry] = []
        graph.node.create_subscription(Odometry, "/cf2/odom", heard.append, 5)  # reliably, like RViz
        agent = graph.start(AGENT, "-r", "__ns:=/cf2", "-p", "agents:=3", "-p", "moving:=2", "-p", "seed:=5")
        scenario = make_scenario(SwarmConfig(agents=3, moving=2, seed=5))
        first = channel.ask(0)
        assert list(first.agent) == [2]
        assert list(first.chosen) == [1]
        assert list(first.length) == [0]
        assert np.array_equal(first.track, scenario.start[:, 1])
        second = channel.ask(1, header=Header(stamp=Time(sec=1)))
        assert list(second.chosen) == [2]
        frame = decode_frame(bytes(second.data))
        assert (frame.sender, frame.slot) == (2, 1)
        count = len(channel.answers)
        channel.publisher.publish(Slot(run=channel.run.number, slot=1, heard_slot=0))
        graph.until(lambda: len(channel.answers) > count)
        assert channel.answers[-1] == second  # asked again: the same answer, nothing has moved
        answers = {0: first, 1: second}
        while not heard:
            slot = len(answers)
            answers[slot] = channel.ask(slot, header=Header(stamp=Time(sec=slot)))
        odometry = heard[0]
        assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "cf2/base_link")
        answer = answers[odometry.header.stamp.sec]
        place, speed = odometry.pose.pose.position, odometry.twist.twist.linear
        assert [place.x, place.y, place.z] == list(answer.track)
        assert [speed.x, speed.y, speed.z] == list(answer.velocity)
        channel.end(len(answers))
        assert end_of(agent) == (0, "")


@pytest.mark.ros
def test_an_agent_started_again_after_kill_9_is_heard_from(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        channel = Channel(graph)
        agent = graph.start(AGENT, "-r", "__ns:=/cf2", "-p", "agents:=3")
        first = channel.call()
        assert not segments_of(agent.pid)
        agent.kill()
        agent.communicate()
        graph.processes.remove(agent)
        graph.start(AGENT, "-r", "__ns:=/cf2", "-p", "agents:=3")
        graph.until(lambda: channel.processes[-1].process != first.process, channel.publish_call)


@pytest.mark.ros
def test_strange_slots_and_forged_ends_change_nothing_and_a_node_ends_when_its_channel_has_gone(tmp_path: Path) -> None:
    with ros_graph(tmp_path) as graph:
        channel = Channel(graph)
        agent = graph.start(AGENT, "-p", "id:=1", "-p", "agents:=2")
        channel.ask(0)
        run = channel.run.number
        for strange in (
            Slot(run=run, slot=7, heard_slot=6),
            Slot(run=run, slot=4_000_000_000),
            Slot(run=run, slot=1, phase=Slot.END),
            Slot(run=run, slot=1, phase=Slot.END, data=array("B", bytes(16))),
            Slot(run=run, slot=1, sender=array("H", [1])),
            Slot(run=run, slot=1, sender=[2], length=[3], data=[1, 2, 3], received=[0, 0]),
            Slot(run=run, slot=1, phase=9),
            Slot(run=run + 1, slot=1),
            Slot(slot=1),
        ):
            channel.publisher.publish(strange)
            graph.executor.spin_once(timeout_sec=0.05)
        assert channel.ask(1).slot == 1
        graph.until(lambda: sum(channel.processes[-1].dropped) >= 9)
        assert agent.poll() is None
        told = channel.processes[-1]
        counts = dict(zip(told.dropped_reason, told.dropped, strict=True))
        assert counts == {"slot": 2, "forged end": 2, "sizes": 2, "range": 1, "other run": 2}
        graph.node.destroy_publisher(channel.publisher)
        said = "agent: error: the channel has gone after slot 1 without ending the run\n"
        assert end_of(agent) == (1, said)


@pytest.mark.ros
@pytest.mark.parametrize(("module", "arguments", "said"), [
    (AGENT, ["policy:=fifo"], "agent: error: policy: got 'fifo'; allowed: tdma, dtsa"),
    (AGENT, ["id:=13"], "agent: error: id: got 13; allowed: 1 to 12"),
    (AGENT, ["air:=smoke"], "agent: error: air: got 'smoke'"),
    (AGENT, ["air:=udp", "auth:=false"], "agent: error: interface: got ''"),
    (HOST, ["ids:=[1, 1]"], "swarm_host: error: ids: got [1, 1]; allowed: different ids from 1 to 12"),
    (HOST, ["ids:=3"], "swarm_host: error: ids: got 3; allowed: a list of whole numbers, as [0]"),
    (HOST, ["mode:=realtime", "nice:=20"], "swarm_host: error: nice: got 20; allowed: a whole number, 0 to 19"),
    (HOST, ["policy:=aloha", "shared_table:=true"], "swarm_host: error: shared_table: got True; allowed: false"),
])  # fmt: skip
def test_bad_parameters_are_one_line_and_code_2(tmp_path: Path, module: str, arguments: list[str], said: str) -> None:
    with ros_graph(tmp_path) as graph:
        code, error = end_of(graph.start(module, *[word for value in arguments for word in ("-p", value)]))
        assert code == 2
        assert error.startswith(said)
        assert error.count("\n") == 1


class RealtimeChannel(Channel):
    """The channel in real time, played by the test: agents send when their own clock says so."""

    def __init__(self, graph: Graph) -> None:
        super().__init__(graph)
        self.frames: list[Frame] = []
        self.reports: list[Report] = []
        qos = names.lockstep_qos(names.REALTIME_WAITING)
        graph.node.create_subscription(Frame, f"/swarm/{names.AIR_FRAME}", self.frames.append, qos)
        graph.node.create_subscription(Report, f"/swarm/{names.REPORT}", self.reports.append, qos)

    def start(self, ahead_ns: int) -> None:
        """Says when slot 0 starts, once the agent has been heard: so many ns from now."""
        found = [f"/swarm/{name}" for name in (names.AIR_FRAME, names.REPORT)]
        there = self.graph.node.count_publishers
        self.graph.until(lambda: self.reports and all(map(there, found)), self.publish_call)
        self.publish_start(time.monotonic_ns() + ahead_ns)

    def publish_start(self, zero_ns: int) -> None:
        message = Slot(run=self.run.number, phase=Slot.START, data=array("B", self.run.call("/test")))
        message.header.stamp = time_of(zero_ns)
        self.publisher.publish(message)


def realtime_agent(graph: Graph, *options: str) -> subprocess.Popen[str]:
    words = ("mode:=realtime", "slot_ms:=20.0", *options)
    return graph.start(AGENT, *(word for option in words for word in ("-p", option)))


@pytest.mark.ros
def test_a_frame_whose_slot_is_over_stays_off_the_air(tmp_path: Path) -> None:
    """Slot 0 began 50 slots ago: the agent goes through them all, and sends in none whose first half is over."""
    slot_ns, late = 20_000_000, 50
    with ros_graph(tmp_path) as graph:
        channel = RealtimeChannel(graph)
        agent = realtime_agent(graph, "agents:=2", "id:=1", "policy:=tdma")
        channel.start(-late * slot_ns)
        graph.until(lambda: channel.frames and len(channel.reports) > 1 and channel.reports[-1].slot[-1] > 2 * late)
        channel.end(0)
        assert end_of(agent)[0] == 0
    told = {slot: length for report in channel.reports for slot, length in zip(report.slot, report.length, strict=True)}
    assert set(range(late)) <= set(told)
    assert not any(told[slot] for slot in range(late))
    for frame in channel.frames:
        began_ns = frame.header.stamp.sec * 1_000_000_000 + frame.header.stamp.nanosec
        assert frame.slot >= late
        assert began_ns - names.slot_time_ns(frame.slot, slot_ns) <= slot_ns // 2


@pytest.mark.ros
def test_an_agent_that_leaves_says_so_even_if_its_next_turn_is_k_m_rounds_away(tmp_path: Path) -> None:
    """Agent 2 rests: in slot 1 it has given away all its turns up to its next main anchor, slot 85."""
    config = SwarmConfig(agents=6, moving=1, policy="lease")
    with ros_graph(tmp_path) as graph:
        channel = RealtimeChannel(graph)
        agent = realtime_agent(graph, "agents:=6", "moving:=1", "id:=2", "policy:=lease")
        channel.start(5_000_000_000)  # on a busy machine, too, it hears of it before slot 0
        graph.until(lambda: channel.reports[-1].slot and channel.reports[-1].slot[-1] >= 1)
        agent.send_signal(signal.SIGTERM)
        graph.until(lambda: agent.poll() is not None)
        assert agent.returncode == 0
        graph.until(lambda: channel.frames and decode_extended(bytes(channel.frames[-1].data)).leaving)
    slots = [frame.slot for frame in channel.frames]
    assert slots[:-1] in ([], [1])  # a busy machine may keep its frame of slot 1 off the air
    assert divmod(slots[-1], config.agents) == (config.main_every - 1, 1)  # (R + T mod N) mod (K M) = 0


@pytest.mark.ros
@pytest.mark.parametrize("is_late", [False, True])
def test_agents_of_vehicles_elsewhere_begin_where_odometry_has_seen_these_last(tmp_path: Path, is_late: bool) -> None:
    """The odometry of cf1 has stopped when that of cf2 comes, which the agents wait for."""
    with ros_graph(tmp_path) as graph:
        channel, zero_ns = RealtimeChannel(graph), time.monotonic_ns()
        call = (lambda: channel.publish_start(zero_ns)) if is_late else channel.publish_call
        publishers = [graph.node.create_publisher(Odometry, f"/cf{k}/odom", 1) for k in (1, 2)]
        graph.start(CRAZYFLIE_AGENTS, "-p", "agents:=2", "-p", "policy:=lease", "-p", "slot_ms:=20.0")

        def publish(number: int) -> None:
            message = Odometry(header=Header(frame_id="map"))
            message.pose.pose.position.x, message.pose.pose.orientation.w = 0.5 + number, 1.0
            publishers[number].publish(message)
            call()

        def act_for(duration_s: float, act: Callable[[], None]) -> None:
            end_s = time.monotonic() + duration_s
            graph.until(lambda: time.monotonic() > end_s, act)

        graph.until(lambda: channel.processes and publishers[0].get_subscription_count(), call)
        act_for(1.0, lambda: publish(0))
        act_for(1.0, call)
        assert not channel.reports
        graph.until(lambda: {k for report in channel.reports for k in report.agent} == {1, 2}, lambda: publish(1))
    begun: dict[int, list[float]] = {}
    for report in channel.reports:
        track = np.array(report.track).reshape(len(report.slot), report.steps, 3, len(report.agent))
        begun = dict(zip(report.agent, track[0, -1].T.tolist(), strict=True)) | begun
    assert begun == {1: [0.5, 0.0, 0.0], 2: [1.5, 0.0, 0.0]}


@given(st.lists(st.binary(max_size=60), max_size=8))
def test_frames_survive_the_message(frames: list[bytes]) -> None:
    assert split_frames(b"".join(frames), [len(frame) for frame in frames]) == frames
    with pytest.raises(ValueError, match="bytes of frames"):
        split_frames(b"".join(frames) + b"x", [len(frame) for frame in frames])


def test_reasons_in_the_message_are_those_of_the_core() -> None:
    named = {name: getattr(SlotRecord, name) for name in dir(SlotRecord) if name.startswith("REASON_")}
    assert named == {f"REASON_{name.upper().replace('-', '_')}": code for code, name in enumerate(REASONS)}
