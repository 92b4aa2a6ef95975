"""What the channel's two modes have in common on the graph: topics, observers, and an end that is heard."""

from __future__ import annotations

import json
import time
from array import array
from collections.abc import Callable, Mapping, Set
from itertools import islice
from typing import Any

from dtsa_msgs.msg import Process, Slot
from rclpy.duration import Duration
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from dtsa_agent.core.errors import ConfigError, DtsaError, LocalProtocolError
from dtsa_agent.ros.common import checks, names
from dtsa_agent.ros.common.cdr import pack_received
from dtsa_agent.ros.common.checks import BadMessage, Intake
from dtsa_agent.ros.common.loop import Feed, Loop
from dtsa_agent.ros.common.messages import SLOT, time_of
from dtsa_agent.ros.common.names import agent_names
from dtsa_agent.ros.common.runs import Patience, Run, run_text
from dtsa_channel_sim.model.channel import Channel

from .answers import Answers
from .observer import ChannelObserver, Observers
from .roster import Roster

REPEAT_S = 0.1
_CALL_NS = 5_000_000
_OTHER_CHANNEL_S = 0.3  # a node that calls or opens slots for so long is a channel
_NAME_S = 1.0  # that the name of its node is waited for
_MOST_PROCESSES = 64  # messages of processes read at a time
_HURRY_S = 0.2


class RosChannel:
    """A medium whose agents are nodes.

    It calls its observers when something happens.

    :param waiting: a quarter of the messages of an agent that may wait to be read.
    :param input: type and topic of the messages that the loop waits for.
    :param over: says why the run is over, asked when all agents have answered a slot and all observers know; empty: it
        goes on.
    :param slots: the run ends after so many; 0: by ``over`` or a signal.
    :param startup_s: s of wall time that all agents have to answer for the first time.
    :param end_s: s of wall time that the nodes have to hear of the end.
    :param run: the run's id, which all its messages carry; None: a new one.
    :param agreed: settings that the agents must share; those of the medium in any case.
    """

    mode = "lockstep"

    def __init__(
        self, node: Node, channel: Channel, steps: int, waiting: int, input: tuple[type, str],
        over: Callable[[], str] = str, slots: int = 0, swarm_namespace: str = names.SWARM, startup_s: float = 60.0,
        end_s: float = 4.0, run: Run | None = None, agreed: Mapping[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self.node, self.model = node, channel
        self.agents, self.slot_ns = channel.config.agents, channel.config.slot_ns
        self._identity = run or Run.draw()
        self.intake = Intake(node.get_logger())
        self.slot = -1
        self.answers = Answers(self.agents, steps)
        self.lost: set[int] = set()  # ids of agents that have fallen silent; real time only
        self.returned: set[int] = set()  # ids of agents that had, and report again; real time only
        self._observers = Observers()
        self._over, self._slots = over, slots
        self.fell_behind = ""  # why the run could not go on; real time only
        self.lag_ms = 0.0  # by which the last frame was delivered late; real time only
        self._reason, self._failed = "", False  # why the run has ended, and whether an error ended it
        self._startup_s, self._end_s = startup_s, end_s
        self._publisher = node.create_publisher(Slot, f"{swarm_namespace}/{names.SLOT}", names.lockstep_qos(waiting))
        self._clock = node.create_publisher(Clock, names.clock_topic(swarm_namespace), 10)
        self._clock_watched = False
        kind, topic = input
        qos = names.lockstep_qos(waiting * self.agents)
        self.loop = Loop(node, kind, f"{swarm_namespace}/{topic}", qos, read=bytes)
        name = node.get_fully_qualified_name()
        settings = {"agents": self.agents, "slot_ms": self.slot_ns / 1e6, "steps": steps, "mode": self.mode}
        self.roster = Roster(self.agents, self.run_id, agreed or settings, name)
        topic, qos = f"{swarm_namespace}/{names.PROCESS}", names.lockstep_qos(self.agents)
        self._processes = Feed(node, Process, topic, qos, intake=self.intake)
        self._calling = array("B", self._identity.call(name))

    @property
    def run_id(self) -> int:
        """The run's id."""
        return self._identity.number

    def dropped(self) -> dict[str, int]:
        """Return the number of messages and frames that the channel and the agents have dropped, by reason."""
        return self.intake.counts + self.roster.dropped()

    def observe(self, *observers: ChannelObserver) -> None:
        """Add observers; they are called in this order, after those that are there already."""
        self._observers.add(*observers)

    def change_settings(self, **values: Any) -> None:
        """Change settings of the medium from the next slot on, and tell the observers.

        :raises ConfigError: for values that are not allowed.
        """
        self._observers.settings_changed(self.model.set(**values))

    def run(self, stop: object) -> None:
        """Run until the run is over or ``stop`` is true. The agents are told to end.

        :raises DtsaError: when an agent or an observer fails.
        """
        try:
            try:
                self._run(stop)
            finally:
                self._publish_end()
            self._reason = self._reason or self.fell_behind or str(getattr(stop, "reason", ""))
            self._reason = self._reason or ("stopped by a signal" if stop else "")
        except DtsaError as error:
            self._reason, self._failed = str(error), True
            raise

    def _run(self, stop: object) -> None:
        raise NotImplementedError

    # For the two modes.

    def _call(self, stop: object, absent: Set[int] = frozenset()) -> bool:
        """Call the agents until all have shown their ids and settings; return False when stopped.

        :raises ConfigError: when two do not fit together, or another channel is there.
        :raises LocalProtocolError: when some do not answer in time.
        """
        others = Feed(self.node, Slot, self._publisher.topic_name, names.lockstep_qos(), intake=self.intake)
        first_s: dict[int, float] = {}  # by another run: when its first message came

        def awaited() -> set[int]:
            self._read_processes()
            self._check_other_channels(others, first_s)
            return self.roster.awaited(time.monotonic(), absent)

        try:
            self.roster.closed = self._await_all(stop, awaited, _CALL_NS)
        finally:
            others.close()
            self.node.destroy_subscription(others.subscription)
        return self.roster.closed

    def _publish_call(self, number: int) -> None:
        """Call the agents; each number is answered once."""
        data = self._calling
        self._publisher.publish(Slot(run=self.run_id, phase=Slot.PREPARE, slot=number, data=data))

    def _await_all(self, stop: object, awaited: Callable[[], set[int]], wait_ns: int) -> bool:
        """Call again and again until no agent is awaited any more; return False when stopped.

        :raises LocalProtocolError: when some do not answer in time.
        """
        patience, repeat = Patience(), 0.0
        while agents := awaited():
            if stop:
                return False
            now = time.monotonic()
            if now - repeat > REPEAT_S:
                repeat = now
                self._publish_call(names.FIRST_CALL)
            self.loop.wait(wait_ns)  # what comes before the run begins does not count
            self._housekeeping()
            if patience.spent_s() > self._startup_s:
                raise LocalProtocolError(
                    f"{agent_names(agents)} did not report within {self._startup_s:g} s: dead or hung?"
                )
        return True

    def _check_other_channels(self, feed: Feed, first_s: dict[int, float]) -> None:
        """Check what others publish on the channel's own topic.

        :raises ConfigError: when another channel is there.
        """
        for message in islice(iter(feed.take, None), _MOST_PROCESSES):
            if message.run in (0, self.run_id) or len(first_s) >= _MOST_PROCESSES:
                continue
            with self.intake.guard():
                checks.check_slot(message, self.agents)
                now = time.monotonic()
                waited_s = now - first_s.setdefault(message.run, now)
                if waited_s > _OTHER_CHANNEL_S:
                    topic = self._publisher.topic_name
                    others = self._other_nodes(topic)
                    if others or waited_s > _OTHER_CHANNEL_S + _NAME_S:
                        allowed = f"no other channel on {topic}; there is {others or 'a node without a name yet'}"
                        raise ConfigError("run", str(self._identity), allowed)

    def _other_nodes(self, topic: str) -> str:
        """Return the nodes that publish on a topic beside this one; empty: the graph does not know their names yet."""
        infos = self.node.get_publishers_info_by_topic(topic)
        nodes = [f"{info.node_namespace.rstrip('/')}/{info.node_name}" for info in infos]
        if self.node.get_fully_qualified_name() in nodes:
            nodes.remove(self.node.get_fully_qualified_name())
        return "" if any("UNKNOWN_" in name for name in nodes) else ", ".join(nodes) or "one that has just gone"

    def _decoded(self, data: bytes, kind: type, read: Callable[[bytes], Any]) -> Any:
        """Return a message of this run.

        :raises BadMessage: if it is none.
        """
        try:
            message = read(data)
        except Exception:  # rclpy has no common base for what a message can do to it
            raise BadMessage(checks.UNREADABLE, f"a message of {len(data)} bytes that is no {kind.__name__}") from None
        if message.run != self.run_id:
            raise BadMessage(checks.OTHER_RUN, f"a {kind.__name__} of run {run_text(message.run)}")
        return message

    def _pack_slot(
        self, time_ns: int, slot: int, heard_slot: int, senders: Any = (), frames: Any = (), mask: Any = None
    ) -> bytes:
        """Return the message that opens a slot or delivers frames, by their receivers' mask (F, N)."""
        return SLOT.pack(time_ns, (
            self.run_id, slot, Slot.RUN, heard_slot, array("H", senders).tobytes(), bytes(map(len, frames)),
            b"".join(frames), b"" if mask is None else pack_received(mask),
        ))  # fmt: skip

    def _read_processes(self) -> None:
        """Process the messages of processes about themselves.

        :raises ConfigError: before the run has begun, when two do not fit together.
        """
        for message in islice(iter(self._processes.take, None), _MOST_PROCESSES):
            with self.intake.guard():
                try:
                    self.roster.hear(message, time.monotonic(), self._processes.sender)
                except ConfigError as error:
                    self._refuse(message.process, error)
                    if not self.roster.closed:
                        raise
                    self.intake.drop(checks.OTHER_SENDER, f"{message.node}: {error}")

    def _refuse(self, process: int, error: ConfigError) -> None:
        """Tell a process that it cannot take part."""
        reason = json.dumps([error.field, error.value, error.allowed], default=str).encode()
        data = array("B", process.to_bytes(8, "little") + reason)
        self._publisher.publish(Slot(run=self.run_id, phase=Slot.REFUSE, data=data))

    def _meet_processes(self) -> None:
        """Process the messages of processes about themselves, and decide about those that came late."""
        self._read_processes()
        for process, error in self.roster.decide(time.monotonic(), self.lost) if self.roster.closed else ():
            self._refuse(process, error)

    def _housekeeping(self) -> None:
        if self.loop.housekeeping():
            self._clock_watched = self._clock.get_subscription_count() > 0
            self._meet_processes()
            awaited = self.answers.silent if self.roster.closed else self.roster.missing
            self._observers.idle(self.slot, awaited)

    def _goes_on(self, slot: int, answers: Answers) -> bool:
        """All agents have answered a slot; return whether the run goes on."""
        self._observers.all_answered(slot, answers)
        self._reason = self._over() or (f"{self._slots} slots have passed" if 0 < self._slots <= slot else "")
        return not self._reason

    def _publish_clock(self, time_ns: int) -> None:
        if self._clock_watched:
            self._clock.publish(Clock(clock=time_of(time_ns)))

    def _publish_end(self) -> None:
        """Tell all nodes that the run is over."""
        if self.node.context.ok():
            proof = array("B", self._identity.proof)
            self._publisher.publish(Slot(run=self.run_id, slot=max(0, self.slot + 1), phase=Slot.END, data=proof))

    def hurry(self) -> None:
        """The user waits for the end: nodes that do not hear of it at once are not waited for."""
        self._end_s = min(self._end_s, _HURRY_S)

    def close(self) -> None:
        """Close the observers first, wait until all nodes know that the run is over or have left, free the handles.

        :raises DtsaError: when an observer could not be closed.
        """
        try:
            self._observers.ended(self.slot, self._reason or "ended early", self._failed)
        finally:
            try:
                self._observers.close()
            finally:
                self._await_end()
                self._processes.close()
                self.loop.close()

    def _await_end(self) -> None:
        """Wait until all nodes know that the run is over, or have left."""
        deadline = time.monotonic() + self._end_s
        while self.node.context.ok() and time.monotonic() < deadline:
            # The middleware asks for acknowledgements, and repeats what was lost, every 3 s only: so publish it again.
            if self._publisher.wait_for_all_acked(Duration(seconds=REPEAT_S)):
                break
            self._publish_end()
        self._read_processes()  # they end with their last counts
