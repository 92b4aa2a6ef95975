"""Which run a process of agents belongs to: the handshake with the channel, and which messages are that run's."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from dtsa_msgs.msg import Process, Slot
from rclpy.duration import Duration
from rclpy.node import Node
from std_msgs.msg import Header

from dtsa_agent.core.errors import ConfigError, LocalProtocolError
from dtsa_agent.core.settings.config import settings_hash
from dtsa_agent.ros.common import checks, names
from dtsa_agent.ros.common.checks import BadMessage, Intake, PublisherGuard
from dtsa_agent.ros.common.messages import Fields
from dtsa_agent.ros.common.runs import Call, Patience, run_text

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
    publisher: PublisherGuard
    introductions: int = 0  # on calls of a run under way


class Membership:
    """Answers channels that call, binds to the run that begins, and keeps out what is not of that run.

    :param ids: of the agents here.
    :param settings: as :func:`agreed_settings` gives them.
    :param dropped_frames: returns the number of frames kept out so far, by reason.
    :param check_next: raises :class:`BadMessage` for a slot message that cannot be the next one.
    """

    def __init__(
        self, node: Node, ids: Sequence[int], settings: Mapping[str, Any], swarm_namespace: str,
        dropped_frames: Callable[[], dict[str, int]], check_next: Callable[[Fields], None],
    ) -> None:  # fmt: skip
        self.run = 0  # the run's id; 0: none has begun yet
        self.intake = Intake(node.get_logger())
        self._agents, self._dropped_frames, self._check_next = int(settings["agents"]), dropped_frames, check_next
        self._callers: dict[int, _Caller] = {}  # by run
        self._began_s = self._counts_s = 0.0  # monotonic
        self._unseen = Patience()  # with a channel that is not on the graph
        self._counts: dict[str, int] = {}  # as published last
        self._following = 0  # another run that calls while this one lasts
        self._process, self._ids = int.from_bytes(os.urandom(8), "little"), list(ids)
        self._about = {
            "header": Header(frame_id=names.FRAME), "process": self._process, "node": node.get_fully_qualified_name(),
            "agent": self._ids, "settings_hash": settings_hash(settings),
        }  # fmt: skip
        self._settings = json.dumps(settings, sort_keys=True, separators=(",", ":"))
        self._publisher = node.create_publisher(Process, f"{swarm_namespace}/{names.PROCESS}", names.lockstep_qos())

    def admits(self, message: Fields, sender: bytes | None) -> bool:
        """Whether a slot message is one of this run; others are counted. A channel that calls is answered.

        ConfigError: the channel refuses this process.
        """
        try:
            self._check(message, sender)
        except BadMessage as error:
            self.intake.drop(error.reason, str(error))
            return False
        return True

    def _check(self, message: Fields, sender: bytes | None) -> None:
        checks.check_slot(message, self._agents)
        run, phase = message.run, message.phase
        calls = phase in (Slot.PREPARE, Slot.START)
        if (self.run and run != self.run) or not (run in self._callers or (run and calls)):
            if self.run and phase == Slot.PREPARE:
                self._following = run
                self._publish_counts(left_over=True)
            detail = f"slot message of run {run_text(run)}"
            raise BadMessage(checks.OTHER_RUN, f"{detail}; this one is {run_text(self.run)}" if self.run else detail)
        caller = self._callers.get(run) or self._add_caller(run, message.data, sender)
        if phase == Slot.END:
            if not caller.call.ended_by(message.data):
                raise BadMessage(checks.FORGED_END, f"an end of run {run_text(run)} that is not its channel's")
            self._counts_s = 0.0
            self._publish_counts()
            return
        self._check_next(message)
        if not caller.publisher.admits(time.monotonic(), sender):
            raise BadMessage(checks.OTHER_SENDER, f"a slot message of run {run_text(run)}, not of its channel")
        if phase == Slot.REFUSE:
            self._read_refusal(message.data)
        if phase == Slot.PREPARE or (calls and caller.introductions < _INTRODUCTIONS):
            caller.introductions = _INTRODUCTIONS if phase == Slot.PREPARE else caller.introductions + 1
            self._publish(run, self._settings)

    def _add_caller(self, run: int, data: bytes, sender: bytes | None) -> _Caller:
        """A channel calls for the first time."""
        try:
            call = Call.from_bytes(data)
        except ValueError as error:
            raise BadMessage(checks.RANGE, f"an unreadable call: {error}") from None
        while len(self._callers) >= _MOST_CALLERS:
            del self._callers[next(run for run in self._callers if run != self.run)]
        caller = self._callers[run] = _Caller(call, PublisherGuard(sender))
        return caller

    def is_connected(self) -> bool:
        """Whether a channel receives what this process publishes about itself."""
        return bool(self._publisher.get_subscription_count())

    def begin(self, run: int) -> None:
        """The run begins for this process: from now on it belongs to no other."""
        self.run = run
        self._began_s, self._unseen = time.monotonic(), Patience()

    @property
    def session(self) -> int:
        """Session of authenticated frames in this run, as its channel has announced it."""
        return self._callers[self.run].call.session

    def _read_refusal(self, data: bytes) -> None:
        """The channel sends a process away; ConfigError: it is this one."""
        if int.from_bytes(data[:8], "little") != self._process:
            return
        if self.run and time.monotonic() - self._began_s > _REFUSABLE_S:
            raise BadMessage(checks.OTHER_SENDER, "this process takes part, and is told to go")
        try:
            name, value, allowed = checks.parse_json(data[8:])
        except (ValueError, TypeError):
            raise BadMessage(checks.RANGE, "a refusal without a reason") from None
        raise ConfigError(checks.plain(str(name)), value, checks.plain(str(allowed)))

    def _publish_counts(self, left_over: bool = False) -> None:
        """Publish the counts of this run's messages, not too often."""
        now, counts = time.monotonic(), self.counts()
        if now - self._counts_s >= _COUNTS_S and (left_over or (self.run and counts != self._counts)):
            self._counts, self._counts_s = counts, now
            self._publish(self.run)

    def _publish(self, run: int, settings: str = "") -> None:
        counts = self.counts()
        dropped = {"dropped_reason": list(counts), "dropped": list(counts.values())}
        self._publisher.publish(Process(run=run, settings=settings, **self._about, **dropped))

    def counts(self) -> dict[str, int]:
        """Return the number of messages and frames not received so far, by reason."""
        return dict(self.intake.counts) | {name: count for name, count in self._dropped_frames().items() if count}

    def idle(self, publishers: int, slot: int) -> None:
        """Look around, about ten times a second: number of publishers of slot messages, last slot answered.

        :raises LocalProtocolError: when the channel has gone without ending the run.
        """
        if not self.run:
            return
        self._publish_counts()
        channel = self._callers[self.run].call
        if publishers or channel.is_paused:  # one that is stopped for long leaves the graph, too, and comes back
            self._unseen = Patience()
        if self._unseen.spent_s() > _LOST_S or channel.has_ended:
            following = f"; run {run_text(self._following)} calls now" if self._following else ""
            raise LocalProtocolError(f"the channel has gone after slot {slot} without ending the run{following}")

    def close(self) -> None:
        """Let the last counts arrive before this process ends: what it has published goes with it."""
        self._publisher.wait_for_all_acked(_DELIVERY)
