"""Writes a flight into a bag: a record a slot, and what viewers show, 20 times a simulated second."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from dtsa_msgs.msg import RunStatus
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterType
from rclpy.serialization import serialize_message

from dtsa_agent.core import Scenario
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import REPRESENTATION, SECOND, pack_received
from dtsa_agent.ros.common.messages import Fields
from dtsa_bench.log.arrays import PRESENT, UNRECORDED
from dtsa_bench.log.bag.cdr import CdrBuilder, OdometryPacker
from dtsa_bench.log.bag.metadata import RUN_ID
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import FORMAT, FORMAT_KEY, add_records, frame_fields, pack_record
from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_channel_sim import Change
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS, Verdict
from dtsa_channel_sim.ros.answers import Answers, received_in
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.ros_channel import RosChannel
from dtsa_channel_sim.ros.run_topics import configuration_message, status_message

from .measurement import TimingStatistics
from .slot_messages import SlotMessages

_WAIT_NS = 10_000_000_000  # for reports of agents that are not lost: a channel that stood still gets them late
_REPORTED = ("chosen", "reason", "digest", "score", "offset_ns", "track", "velocity", "command", "goal")


class FlightRecorder(ChannelObserver):
    """Writes a flight into a bag, slot after slot; see docs/reference/nodes.md for topics and times.

    A slot counts as flown once all agents have told where it took them, in their answers to the next one. What a flight
    that is cut short leaves half done does not get into its bag.
    """

    def __init__(
        self, directory: Path, run: RunConfig, scenario: Scenario, channel: RosChannel, timing: TimingStatistics
    ) -> None:
        self._slot_ns, self._steps, self._channel, run_id = run.swarm.slot_ns, run.swarm.steps, channel, channel.run_id
        self._packed = SlotMessages(scenario, self._slot_ns, run_id)
        agents = run.swarm.agents
        custom = {"seed": str(run.swarm.seed), RUN_ID: f"{run_id:08x}", FORMAT_KEY: FORMAT}
        self.bag = BagWriter(directory, run.to_dict(), custom_data=custom, marked=True)
        add = self.bag.add_topic
        self._record = add_records(self.bag)
        self._markers = add(f"{names.SWARM}/{names.MARKERS}", "visualization_msgs/msg/MarkerArray")
        self._status = add(f"{names.SWARM}/{names.STATUS}", "dtsa_msgs/msg/RunStatus", "latched")
        settings = add(f"{names.SWARM}/{names.CONFIGURATION}", "dtsa_msgs/msg/Configuration", "latched")
        self._event = 0
        spaces = [names.agent_namespace(agent) for agent in range(1, agents + 1)]
        self._odometry = [add(f"{space}/{names.ODOMETRY}", "nav_msgs/msg/Odometry") for space in spaces]
        self._packer = OdometryPacker([names.body_frame(space) for space in spaces])
        self._accounts = None if run.mode == LOCKSTEP else RealtimeAccounts(agents, self._steps, self._slot_ns)
        self._timing = timing
        self._pending: list[tuple[int, bytes, int]] = []  # channel, message, time: of the slot that is being flown
        self._pending_slot = -1
        self._complete = -1  # last slot that all have answered,
        self._answered, self._track = np.zeros(agents, np.bool_), np.zeros((self._steps, 3, agents))  # and who, where
        self._reason = ""  # why the run has ended
        data = bytes(serialize_message(configuration_message(run.to_dict(), run_id)))
        self.bag.write(settings, data, names.TIME_ZERO_NS, names.TIME_ZERO_NS)

    def _time_ns(self, slot: int) -> int:
        """Simulated time at which a slot starts, ns."""
        return names.slot_time_ns(slot, self._slot_ns)

    def frame_sent(self, slot: int, sender: int, data: bytes, start_ns: int) -> None:
        if self._accounts is not None:
            self._accounts.add_frame(slot, sender, data, start_ns)

    def report(self, message: Fields) -> None:
        if self._accounts is not None:
            self._accounts.add_report(message)

    def all_answered(self, slot: int, answers: Answers) -> None:
        self._complete = slot
        self._answered[:], self._track[:] = answers.answered, answers.track
        if not slot:
            self._write_status(RunStatus.FLYING)

    def agent_silent(self, agent: int) -> None:
        if self._accounts is not None:
            self._accounts.lost.add(agent)
        if self._complete >= 0:
            self._write_status(RunStatus.FLYING)

    def agents_back(self, agents: list[int]) -> None:
        if self._accounts is not None:
            self._accounts.lost -= set(agents)
        self._write_status(RunStatus.FLYING)

    def ended(self, slot: int, reason: str, failed: bool) -> None:
        self._reason = reason

    def _write_status(self, phase: int, reason: str = "") -> None:
        message = status_message(self._channel, phase, self._complete, reason=reason)
        at = self._time_ns(max(0, self._complete))
        self.bag.write(self._status, bytes(serialize_message(message)), at, at)

    def _write_pending(self) -> None:
        """Write all about the slot before the last one that was answered."""
        if self._pending and self._pending_slot < self._complete:
            for channel, data, at in self._pending:
                self.bag.write(channel, data, at, at)
            self._pending = []
            self._write_accounts(self._pending_slot)
            self.bag.mark()

    def _write_accounts(self, closed: int, at_end: bool = False) -> None:
        """Write the records of slots in real time for which nothing is waited for any more."""
        for slot, account in self._accounts.pop(closed, at_end) if self._accounts is not None else ():
            self._timing.add_slot(account.answered, account.sent, account.offset_ns, account.chosen)
            self._write_record(slot, account.fields(slot * self._slot_ns))

    def _write_record(self, slot: int, fields: dict[str, Any]) -> None:
        at = self._time_ns(slot)
        self.bag.write(self._record, pack_record(self._channel.run_id, slot, at, self._steps, **fields), at, at)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self._write_pending()
        at = self._time_ns(slot)
        self._pending_slot = slot
        if self._accounts is None:
            self._pending.append((self._record, self._packed.record(slot, answers, verdict), at))
        else:
            self._accounts.resolve(verdict)
        if slot % self._packed.view_slots == 0:
            motion = self._packer.pack(at, answers.position, answers.velocity)
            # Where an agent is that has not reported is not known: its report may come later, into the record alone.
            reported = zip(self._odometry, motion, answers.answered, strict=True)
            self._pending += [(channel, data, at) for channel, data, is_known in reported if is_known]
            self._pending.append((self._markers, self._packed.markers(slot, answers, verdict), at))

    def settings_changed(self, change: Change) -> None:
        if not self._event:  # the topic is in the bags of such flights only
            self._event = self.bag.add_topic("/parameter_events", "rcl_interfaces/msg/ParameterEvent")
        at = self._time_ns(change.slot)
        self.bag.write(self._event, _parameter_event(at, f"{names.SWARM}/channel", change), at, at)

    def close(self) -> None:
        """Write what is complete and finish the bag."""
        self._write_pending()
        if self._complete >= 0:
            self._write_accounts(self._complete - 1, at_end=True)
            here = np.flatnonzero(self._answered)
            self._write_record(self._complete, {"agent": here + 1, "track": self._track[:, :, here]})
        self._write_status(RunStatus.ENDED, self._reason)
        self.bag.close()


@dataclass
class _SentFrame:
    """A frame in real time, and what became of it."""

    data: bytes
    start_ns: int
    verdict: tuple[NDArray[np.bool_], int, int] | None = None  # (N,) received, lost, collided


class _Account(Answers):
    """What is known of one slot in real time."""

    def __init__(self, agents: int, steps: int) -> None:
        super().__init__(agents, steps)
        self.sent = np.zeros(agents, np.bool_)  # agents that have sent a frame
        self.sent_frames: dict[int, _SentFrame] = {}  # by sender
        self.heard: list[tuple[int, int, int, NDArray[np.bool_]]] = []  # sender, its slot, ns, (N,) receivers

    def fields(self, start_ns: int) -> dict[str, Any]:
        """The fields of the slot's record; ``start_ns``: when it began, from the start of slot 0."""
        here = np.flatnonzero(self.answered)
        frames = {agent: frame for agent, frame in sorted(self.sent_frames.items()) if frame.verdict is not None}
        verdicts = [frame.verdict for frame in frames.values() if frame.verdict is not None]
        received = np.array([verdict[0] for verdict in verdicts]) if verdicts else None
        heard, unrecorded = self.heard, self.sent.copy()
        unrecorded[np.array(list(frames), np.intp) - 1] = False
        presence = PRESENT + UNRECORDED * unrecorded[here] if unrecorded.any() else []
        return {
            "outcome": (COLLISION if any(v[2] for v in verdicts) else SUCCESS) if verdicts else IDLE,
            "agent": here + 1, "presence": presence, **{name: getattr(self, name)[..., here] for name in _REPORTED},
            **frame_fields({agent: frame.data for agent, frame in frames.items()}, received),
            "sent_ns": [frame.start_ns - start_ns for frame in frames.values()],
            "lost": [verdict[1] for verdict in verdicts], "collided": [verdict[2] for verdict in verdicts],
            "heard_sender": [entry[0] for entry in heard], "heard_slot": [entry[1] for entry in heard],
            "heard_ns": [entry[2] - start_ns for entry in heard],
            "heard_by": np.frombuffer(pack_received(np.array([e[3] for e in heard])), np.uint8) if heard else [],
        }  # fmt: skip


class RealtimeAccounts:
    """Slots of which not all is known yet, by what agents report and the channel decides."""

    def __init__(self, agents: int, steps: int, slot_ns: int) -> None:
        self._agents, self._steps = agents, steps
        self._wait = max(2, _WAIT_NS // slot_ns)
        self._open: dict[int, _Account] = {}
        self._next = 0  # first slot that is not written
        self._unresolved: dict[int, deque[_SentFrame]] = {}  # by sender
        self.lost: set[int] = set()  # ids of agents that nothing is waited for from

    def _account(self, slot: int) -> _Account:
        """The account of a slot; of one that is written already, one that nothing comes of."""
        if slot in self._open:
            return self._open[slot]
        account = _Account(self._agents, self._steps)
        if slot >= self._next:
            self._open[slot] = account
        return account

    def add_frame(self, slot: int, sender: int, data: bytes, start_ns: int) -> None:
        """A frame goes on the air."""
        frame = _SentFrame(data, start_ns)
        self._unresolved.setdefault(sender, deque()).append(frame)
        self._account(slot).sent_frames.setdefault(sender, frame)

    def resolve(self, verdict: Verdict) -> None:
        """The channel has resolved frames, those of each sender in the order in which they were sent."""
        mask = verdict.mask(self._agents)
        nothing = (0,) * len(verdict.senders)
        for row, sender in enumerate(verdict.senders):
            if waiting := self._unresolved.get(sender):
                lost, collided = (values[row] for values in (verdict.lost or nothing, verdict.collided or nothing))
                waiting.popleft().verdict = mask[row], lost, collided

    def add_report(self, message: Fields) -> None:
        """Agents of one process report slots, and the frames that they received."""
        at, count = np.array(message.agent, np.intp) - 1, len(message.agent)
        for row, slot in enumerate(message.slot.tolist()):
            account = self._account(slot)
            if not account.answered[at].any():  # else reported twice
                account.add_report(at, message, row)
                account.sent[at] = message.length[row * count : (row + 1) * count] > 0
        for slot, sender, here, at_ns, mask in received_in(message):
            receivers = np.zeros(self._agents, np.bool_)
            receivers[at] = mask
            self._account(here).heard.append((sender, slot, at_ns, receivers))

    def pop(self, closed: int, at_end: bool) -> list[tuple[int, _Account]]:
        """Slots up to the last closed one for which nothing is waited for any more, and what is known of them."""
        found = []
        while self._next <= closed and (at_end or self._next <= closed - self._wait or self._is_whole(self._next)):
            account = self._account(self._next)
            self._open.pop(self._next)
            found.append((self._next, account))
            self._next += 1
        return found

    def _is_whole(self, slot: int) -> bool:
        """Whether all agents have reported a slot, and the frames of it, which are all resolved."""
        here, after = self._open.get(slot), self._open.get(slot + 1)
        if here is None or after is None:
            return False
        silent = set((np.flatnonzero(~(here.answered & after.answered)) + 1).tolist())
        if silent - self.lost:
            return False
        return all(frame.verdict is not None for frame in here.sent_frames.values())


def _parameter_event(time_ns: int, node: str, change: Change) -> bytes:
    """A rcl_interfaces/ParameterEvent as CDR; rclpy would leave unused bytes at its end, which some readers refuse."""
    values = [(name, value) for name, value in change.to_dict().items() if name != "slot"]
    values = [(name, json.dumps(value) if isinstance(value, list) else value) for name, value in values]
    message = CdrBuilder()
    for code, part in zip("iI", divmod(time_ns, SECOND), strict=True):
        message.number(code, part)
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
