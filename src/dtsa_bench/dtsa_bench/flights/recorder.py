"""Writes a flight into a bag: every message that went over the graph, and what follows from them, slot by slot."""

from __future__ import annotations

import json
from pathlib import Path

from dtsa_msgs.msg import RunStatus
from rcl_interfaces.msg import ParameterType
from rclpy.serialization import serialize_message

from dtsa_agent.core import Scenario
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.cdr import REPRESENTATION, SECOND
from dtsa_agent.ros.common.wire.messages import Fields
from dtsa_bench.recordings.bag.cdr import CdrBuilder, OdometryPacker
from dtsa_bench.recordings.bag.metadata import RUN_ID
from dtsa_bench.recordings.bag.writer import BagWriter
from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_channel_sim import Change
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.run_topics import RunState, configuration_message

from .slot_messages import SlotMessages

_MARKER_RECORD_NS = 100_000_000  # simulated time from one picture of the swarm to the next


class FlightRecorder(ChannelObserver):
    """Writes a flight into a bag, slot after slot; see docs/reference/bag.md for topics and times.

    A slot counts as flown once all agents have told where it took them, in their answers to the next one. What a flight
    that is cut short leaves half done does not get into its bag.

    :param directory: the bag's directory.
    """

    def __init__(self, directory: Path, run: RunConfig, scenario: Scenario, run_id: int) -> None:
        self._slot_ns = run.swarm.slot_ns
        self._marker_slots = max(1, round(_MARKER_RECORD_NS / self._slot_ns))
        self._packed = SlotMessages(scenario, self._slot_ns, run_id)
        agents = run.swarm.agents
        self.bag = BagWriter(
            directory, run.to_dict(), custom_data={"seed": str(run.swarm.seed), RUN_ID: f"{run_id:08x}"}, marked=True
        )
        add = self.bag.add_topic
        self._slot = add(f"{names.SWARM}/{names.SLOT}", "dtsa_msgs/msg/Slot")
        self._transmission = add(f"{names.SWARM}/{names.TRANSMISSION}", "dtsa_msgs/msg/Transmission")
        self._reception = add(f"{names.SWARM}/{names.RECEPTION}", "dtsa_msgs/msg/Reception")
        self._decision = add(f"{names.SWARM}/{names.DECISION}", "dtsa_msgs/msg/Decision")
        self._markers = add(f"{names.SWARM}/{names.MARKERS}", "visualization_msgs/msg/MarkerArray")
        self._status = add(f"{names.SWARM}/{names.STATUS}", "dtsa_msgs/msg/RunStatus", "latched")
        settings = add(f"{names.SWARM}/{names.CONFIGURATION}", "dtsa_msgs/msg/Configuration", "latched")
        self._event = 0
        self._realtime = run.mode != LOCKSTEP
        if self._realtime:
            self._frame = add(f"{names.SWARM}/{names.AIR_FRAME}", "dtsa_msgs/msg/Frame")
            self._report = add(f"{names.SWARM}/{names.REPORT}", "dtsa_msgs/msg/Report")
        self._frames: dict[int, list[tuple[bytes, int]]] = {}
        spaces = [names.agent_namespace(agent) for agent in range(1, agents + 1)]
        self._odometry = [add(f"{space}/{names.ODOMETRY}", "nav_msgs/msg/Odometry") for space in spaces]
        self._packer = OdometryPacker([f"{space[1:]}/base_link" for space in spaces], names.FRAME)
        self._messages: dict[int, list[tuple[bytes, int]]] = {}
        self._answers: dict[int, list[tuple[bytes, bytes]]] = {}
        self._pending: list[tuple[int, bytes, int]] = []  # channel, message, time: of the slot that is being flown
        self._pending_slot = -1
        self._complete = -1  # last slot that all have answered
        self._begun: Answers | None = None  # what they answered
        self._state = RunState(run_id, self._slot_ns)
        told = bytes(serialize_message(configuration_message(run.to_dict(), run_id)))
        self.bag.write(settings, told, names.TIME_ZERO_NS, names.TIME_ZERO_NS)

    def _time_ns(self, slot: int) -> int:
        """Simulated time at which a slot starts, ns."""
        return names.slot_time_ns(slot, self._slot_ns)

    def slot_published(self, slot: int, data: bytes, time_ns: int) -> None:
        self._messages.setdefault(slot, []).append((data, time_ns))

    def answer_received(self, slot: int, ids: bytes, data: bytes) -> None:
        self._answers.setdefault(slot, []).append((ids, data))

    def frame_sent(self, slot: int, data: bytes, time_ns: int) -> None:
        self._frames.setdefault(slot, []).append((data, time_ns))

    def report(self, message: Fields, data: bytes) -> None:
        if len(message.slot):
            at = self._time_ns(int(message.slot[-1]))
            self.bag.write(self._report, data, at, at)

    def all_answered(self, slot: int, answers: Answers) -> None:
        self._complete = slot
        self._begun = answers
        if not slot:
            self._state.phase = RunStatus.FLYING
            self._write_status()

    def agent_silent(self, agent: int) -> None:
        self._state.lose(agent)
        if self._complete >= 0:
            self._write_status()

    def agents_back(self, agents: list[int]) -> None:
        self._state.regain(agents)
        self._write_status()

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        self._state.phase, self._state.reason = RunStatus.ENDED, reason

    def _write_status(self) -> None:
        self._state.slot = max(0, self._complete)
        at = self._time_ns(self._state.slot)
        self.bag.write(self._status, bytes(serialize_message(self._state.message())), at, at)

    def _write_messages(self, slot: int) -> None:
        """Writes a slot's own message and all answers to it, in the order of their ids."""
        at = self._time_ns(slot)
        for data, time_ns in self._frames.pop(slot, []):
            self.bag.write(self._frame, data, time_ns, time_ns)
        for data, time_ns in self._messages.pop(slot, []):
            self.bag.write(self._slot, data, time_ns, time_ns)
        for _, answer in sorted(self._answers.pop(slot, [])):
            self.bag.write(self._transmission, answer, at, at)

    def _write_pending(self) -> None:
        """Writes all about the slot before the last one that was answered."""
        if self._pending_slot < self._complete:
            # What came too late for its own slot is written with the next one.
            for slot in sorted(
                slot for slot in {*self._messages, *self._answers, *self._frames} if slot <= self._pending_slot
            ):
                self._write_messages(slot)
            for channel, data, at in self._pending:
                self.bag.write(channel, data, at, at)
            if self._pending:  # before that no slot is complete
                self.bag.mark()
            self._pending = []

    def _keep_reports(self, slot: int, answers: Answers) -> None:
        """In real time: what has been reported for a slot, kept as one transmission."""
        if self._realtime and answers.answered.any():
            self._answers[slot] = [(b"", self._packed.transmission(slot, answers))]

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self._write_pending()
        self._keep_reports(slot, answers)  # as its decisions: more may have come since all had answered
        begin, end = self._time_ns(slot), self._time_ns(slot + 1)
        motion = self._packer.pack(begin, answers.position, answers.velocity)
        self._pending_slot = slot
        self._pending = [(self._decision, self._packed.decision(slot, answers), begin)]
        self._pending += [(channel, data, begin) for channel, data in zip(self._odometry, motion, strict=True)]
        self._pending.append((self._reception, self._packed.reception(slot, verdict), end))
        if slot % self._marker_slots == 0:
            self._pending.append((self._markers, self._packed.markers(slot, answers, verdict), begin))

    def settings_changed(self, change: Change) -> None:
        if not self._event:  # the topic is in the bags of such flights only
            self._event = self.bag.add_topic("/parameter_events", "rcl_interfaces/msg/ParameterEvent")
        at = self._time_ns(change.slot)
        self.bag.write(self._event, _parameter_event(at, f"{names.SWARM}/channel", change), at, at)

    def close(self) -> None:
        """Writes what is complete and finishes the bag."""
        if self._begun is not None and self._complete > self._pending_slot:
            self._keep_reports(self._complete, self._begun)
        self._write_pending()
        for slot in sorted({*self._messages, *self._answers, *self._frames}):
            if slot <= self._complete:
                self._write_messages(slot)
        self._write_status()
        self.bag.close()


def _parameter_event(time_ns: int, node: str, change: Change) -> bytes:
    """A rcl_interfaces/ParameterEvent as CDR; rclpy would leave unused bytes at its end, which some readers refuse."""
    values = [(name, value) for name, value in change.to_dict().items() if name != "slot"]
    values = [(name, json.dumps(value) if isinstance(value, list) else value) for name, value in values]
    message = CdrBuilder()
    seconds, nanoseconds = divmod(time_ns, SECOND)
    message.number("i", seconds)
    message.number("I", nanoseconds)
    message.text(node)
    message.number("I", 0, len(values))  # new_parameters, changed_parameters
    for name, value in values:
        kind = next(
            i for i, cls in enumerate((bool, int, float, str), ParameterType.PARAMETER_BOOL) if isinstance(value, cls)
        )
        message.text(name)
        message.number("B", kind, value if isinstance(value, bool) else 0)
        message.number("q", value if kind == ParameterType.PARAMETER_INTEGER else 0)
        message.number("d", value if isinstance(value, float) else 0.0)
        message.text(value if isinstance(value, str) else "")
        message.number("I", 0, 0, 0, 0, 0)  # the five kinds of arrays
    message.number("I", 0)  # deleted_parameters
    return REPRESENTATION + bytes(message.data)
