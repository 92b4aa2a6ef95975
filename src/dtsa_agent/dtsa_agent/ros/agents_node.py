"""What nodes of agents have in common: the handshake with the channel, which messages are of their run, odometry."""

from __future__ import annotations

import json
import os
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from dtsa_msgs.msg import Process, Slot
from nav_msgs.msg import Odometry
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_msgs.msg import Header

from dtsa_agent.core import Swarm
from dtsa_agent.core.errors import ConfigError, LocalProtocolError
from dtsa_agent.core.settings.config import SwarmConfig, agreed_settings, settings_hash
from dtsa_agent.ros.common import checks, names
from dtsa_agent.ros.common.cdr import POSE_COVARIANCE, TWIST_COVARIANCE
from dtsa_agent.ros.common.checks import BadMessage, Intake
from dtsa_agent.ros.common.loop import Loop
from dtsa_agent.ros.common.messages import SLOT, Fields, header_of
from dtsa_agent.ros.common.runs import Call, Patience, WaitingLog, run_text
from dtsa_agent.stop import Stop

_OTHER_MESSAGES = 32  # that may wait beside the channel's: they must not push those out before they are read
_ODOMETRY_DEPTH = 10  # messages for a slow reader; reliable, because RViz asks for that
_LOST_S = 6.0  # a channel that is not on the graph for so long will not come back; it announces itself every 3 s
_COUNTS_S = 0.5  # counts are published that often at most
_REFUSABLE_S = 10.0  # a process that has taken part for so long is not sent away any more
_MOST_CALLERS = 16
# A process that comes late shows itself on so many calls, one a second: it may find the channel before that finds it.
_INTRODUCTIONS = 30
_DELIVERY = Duration(seconds=0.2)  # longest wait for the channel to have the last counts


@dataclass(slots=True)
class _Caller:
    call: Call
    sender: bytes | None  # of its messages
    introductions: int = 0  # on calls of a run under way


class AgentsNode(ABC):
    """Agents behind one node: it answers channels that call, binds to the run that begins, and serves its messages.

    Subclasses make their publishers first: a channel that knows this process has then found them, too.

    :param ids: of the agents that live here, ascending.
    :param waiting: a quarter of the messages that may wait to be read.
    """

    mode: str

    def __init__(self, node: Node, config: SwarmConfig, ids: Sequence[int], swarm_namespace: str, waiting: int) -> None:
        self.node, self.config, self.ids = node, config, tuple(ids)
        self.slot = -1  # the last slot that has begun here
        self.run_id = 0  # 0: none has begun yet
        self.intake = Intake(node.get_logger())
        self._odometry: list[tuple[Publisher, str]] = []  # of each agent, and the frame of its body
        self._watched: dict[int, tuple[Publisher, str]] = {}  # those of them with subscribers, by place
        self._waiting = WaitingLog(node.get_logger())
        self._has_begun = False
        self._callers: dict[int, _Caller] = {}  # by run
        self._began_s = self._counts_s = 0.0  # monotonic
        self._unseen = Patience()  # with a channel that is not on the graph
        self._counts: dict[str, int] = {}  # as published last
        self._following = 0  # another run that calls while this one lasts
        self._process = int.from_bytes(os.urandom(8), "little")
        settings = agreed_settings(config, self.mode)
        self._settings = json.dumps(settings, sort_keys=True, separators=(",", ":"))
        self._about = {
            "header": Header(frame_id=names.FRAME), "process": self._process, "node": node.get_fully_qualified_name(),
            "agent": list(ids), "settings_hash": settings_hash(settings),
        }  # fmt: skip
        self._processes = node.create_publisher(Process, f"{swarm_namespace}/{names.PROCESS}", names.lockstep_qos())
        qos, topic = names.lockstep_qos(max(waiting, _OTHER_MESSAGES // 4)), f"{swarm_namespace}/{names.SLOT}"
        self.loop = Loop(node, Slot, topic, qos, intake=self.intake, check=self._check, read=SLOT.read_fields)

    @abstractmethod
    def _serve(self) -> bool:
        """Wait a moment for the next thing to do, and do it; return False when the run is over."""

    @abstractmethod
    def _dropped_frames(self) -> dict[str, int]:
        """Return the number of frames that this process has kept out so far, by reason and over all agents."""

    @abstractmethod
    def _check_next(self, message: Fields) -> None:
        """Raise BadMessage for a slot message that cannot be the next one."""

    def run(self, stop: Stop) -> None:
        """Fly until the run is over or a signal comes; in real time, agents of policy ``lease`` first announce that.

        :raises ConfigError: the channel refuses this process, or its agents cannot come into a flight under way.
        :raises LocalProtocolError: the channel has gone without ending the run.
        """
        while not self._has_ended(stop) and self._serve():
            if self.loop.housekeeping():
                self._check_graph()

    def _has_ended(self, stop: Stop) -> bool:
        """Whether to end now because of a signal."""
        return bool(stop)

    def close(self) -> None:
        """Let the last counts arrive before this process ends: what it has published goes with it."""
        self._processes.wait_for_all_acked(_DELIVERY)
        self.loop.close()

    def _check_graph(self) -> None:
        """Log what is waited for, and that slot 0 has begun; LocalProtocolError: the channel has gone."""
        subscription = self.loop.subscription
        publishers = subscription.get_publisher_count()
        if self.run_id:
            self._check_channel(publishers)
        if self.slot < 0:
            channel = "slot 0: the channel is there" if publishers else f"a channel on {subscription.topic_name}"
            self._waiting.log(f"waiting for {channel}")
        elif not self._has_begun:
            self._has_begun = True
            self.node.get_logger().info(f"slot 0 has begun: run {run_text(self.run_id)}")
        self._watched = {at: entry for at, entry in enumerate(self._odometry) if entry[0].get_subscription_count()}

    def _check_channel(self, publishers: int) -> None:
        self._publish_counts()
        channel = self._callers[self.run_id].call
        if publishers or channel.is_paused:  # one that is stopped for long leaves the graph, too, and comes back
            self._unseen = Patience()
        if self._unseen.spent_s() > _LOST_S or channel.has_ended:
            following = f"; run {run_text(self._following)} calls now" if self._following else ""
            raise LocalProtocolError(f"the channel has gone after slot {self.slot} without ending the run{following}")

    # Messages of the channel.

    def _check(self, message: Fields, sender: bytes | None) -> None:
        """Check that a slot message is one of this run. A channel that calls is answered.

        :raises BadMessage: it is not.
        :raises ConfigError: the channel refuses this process.
        """
        checks.check_slot(message, self.config.agents)
        run, phase = message.run, message.phase
        calls = phase in (Slot.PREPARE, Slot.START)
        if (self.run_id and run != self.run_id) or not (run in self._callers or (run and calls)):
            if self.run_id and phase == Slot.PREPARE:
                self._following = run
                self._publish_counts(left_over=True)
            reason = checks.OTHER_RUN if self.run_id or phase != Slot.RUN else checks.NOT_CALLED
            raise BadMessage(reason, f"slot message of run {run_text(run)}; this one is {run_text(self.run_id)}")
        caller = self._callers.get(run) or self._add_caller(run, message.data, sender)
        if phase == Slot.END:
            if not caller.call.ended_by(message.data):
                raise BadMessage(checks.FORGED_END, f"an end of run {run_text(run)} that is not its channel's")
            self._counts_s = 0.0
            self._publish_counts()
            return
        self._check_next(message)
        if sender != caller.sender:
            raise BadMessage(checks.OTHER_SENDER, f"a slot message of run {run_text(run)}, not of its channel")
        if phase == Slot.REFUSE:
            self._read_refusal(message.data)
        if phase == Slot.PREPARE or (calls and caller.introductions < _INTRODUCTIONS):
            caller.introductions = _INTRODUCTIONS if phase == Slot.PREPARE else caller.introductions + 1
            self._publish_process(run, self._settings)

    def _add_caller(self, run: int, data: bytes, sender: bytes | None) -> _Caller:
        """A channel calls for the first time."""
        try:
            call = Call.from_bytes(data)
        except ValueError as error:
            raise BadMessage(checks.RANGE, f"an unreadable call: {error}") from None
        while len(self._callers) >= _MOST_CALLERS:
            del self._callers[next(run for run in self._callers if run != self.run_id)]
        caller = self._callers[run] = _Caller(call, sender)
        return caller

    def _begin_run(self, run: int) -> int:
        """Belong to this run from now on, and to no other; return the session of its authenticated frames."""
        self.run_id = run
        self._began_s, self._unseen = time.monotonic(), Patience()
        return self._callers[run].call.session

    def _read_refusal(self, data: bytes) -> None:
        """The channel sends a process away; ConfigError: it is this one."""
        if int.from_bytes(data[:8], "little") != self._process:
            return
        if self.run_id and time.monotonic() - self._began_s > _REFUSABLE_S:
            raise BadMessage(checks.OTHER_SENDER, "this process takes part, and is told to go")
        try:
            name, value, allowed = checks.parse_json(data[8:])
        except (ValueError, TypeError):
            raise BadMessage(checks.RANGE, "a refusal without a reason") from None
        raise ConfigError(checks.plain(str(name)), value, checks.plain(str(allowed)))

    def _publish_counts(self, left_over: bool = False) -> None:
        """Publish the counts of this run's messages, not too often."""
        now, counts = time.monotonic(), self._all_counts()
        if now - self._counts_s >= _COUNTS_S and (left_over or (self.run_id and counts != self._counts)):
            self._counts, self._counts_s = counts, now
            self._publish_process(self.run_id)

    def _publish_process(self, run: int, settings: str = "") -> None:
        counts = self._all_counts()
        dropped = {"dropped_reason": list(counts), "dropped": list(counts.values())}
        self._processes.publish(Process(run=run, settings=settings, **self._about, **dropped))

    def _all_counts(self) -> dict[str, int]:
        """Return the number of messages and frames not received so far, by reason."""
        return self.intake.counts + Counter(self._dropped_frames())  # without those that are 0

    # Odometry.

    def offer_odometry(self, namespaces: Sequence[str]) -> None:
        """Offer each agent's true motion as ``odom`` in its namespace; published only while a node subscribes."""
        for space in namespaces:
            topic = f"{space.rstrip('/')}/{names.ODOMETRY}"
            publisher = self.node.create_publisher(Odometry, topic, _ODOMETRY_DEPTH)
            self._odometry.append((publisher, names.body_frame(space)))

    def _publish_odometry(self, index: int, swarm: Swarm, column: int, slot: int) -> None:
        """Publish where an agent, by its place here and a column of its swarm, is at the start of a slot, if asked."""
        if index not in self._watched:
            return
        publisher, body = self._watched[index]
        # The attitude is not modelled, it is the identity: the body's axes are those of the map.
        message = Odometry(header=header_of(names.slot_time_ns(slot, self.config.slot_ns)), child_frame_id=body)
        message.pose.covariance, message.twist.covariance = POSE_COVARIANCE, TWIST_COVARIANCE
        place, speed = message.pose.pose.position, message.twist.twist.linear
        place.x, place.y, place.z = swarm.position[:, column].tolist()
        speed.x, speed.y, speed.z = swarm.velocity[:, column].tolist()
        publisher.publish(message)
