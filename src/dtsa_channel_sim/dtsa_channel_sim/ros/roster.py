"""The processes of a run: who they are, what they fly with, and what they have not taken in."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from typing import Any

from dtsa_msgs.msg import Process

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import settings_hash
from dtsa_agent.ros.common.graph.names import named
from dtsa_agent.ros.common.process.runs import run_text
from dtsa_agent.ros.common.wire.checks import (
    OTHER_RUN,
    OTHER_SENDER,
    RANGE,
    UNKNOWN,
    OnePublisher,
    Unusable,
    check_process,
    parse_json,
    plain,
)
from dtsa_agent.ros.common.wire.intake import add_counts

_DOUBT_S = 0.5  # two processes with the same agent: which of them is alive shows within this time
_LATE_DOUBT_S = 2.5  # the same once the run is under way: an agent is lost after 2 s
_LEFT_OVER_S = 3.0  # agents whose channel has gone end within this time
_MOST_STRANGERS = 256


@dataclass(slots=True)
class Member:
    """One process of agents."""

    process: int
    node: str
    ids: tuple[int, ...]
    heard_s: float  # monotonic, when it last told about itself
    sender: bytes | None  # participant of all its messages; None: not known
    dropped: dict[str, int] = field(default_factory=dict)
    publisher: OnePublisher = field(init=False)
    frames: OnePublisher = field(init=False)  # likewise of frames, in real time

    def __post_init__(self) -> None:
        self.publisher, self.frames = OnePublisher(self.sender), OnePublisher(self.sender)


class Roster:
    """Collects what the processes say about themselves before slot 0, and keeps out those that do not fit.

    All must share the settings ``agreed``. Times are s, monotonic; ``sender`` is who sent a message, None: not known;
    ``number`` is the message's number, as its publisher counts; ``absent`` are ids of agents that nobody waits for.
    """

    def __init__(self, agents: int, run: int, agreed: Mapping[str, Any], channel: str) -> None:
        self._agents, self._run = agents, run
        self._agreed = dict(agreed)
        self._agreed_by = dict.fromkeys(agreed, channel)  # who has said so, by setting
        self._members: dict[int, Member] = {}  # by process
        self._of: dict[int, Member] = {}  # by agent
        self._groups: dict[bytes, Member] = {}  # by the ids of all agents of a process, as messages carry them
        self._rivals: dict[int, tuple[Member, float]] = {}  # processes that claim agents of a member, since when
        self._left_over: dict[int, float] = {}  # processes of another run, since when
        self._gone: dict[str, int] = {}  # what processes that have been replaced had dropped
        self.closed = False

    @property
    def missing(self) -> list[int]:
        """Ids of the agents whose processes have not told about themselves."""
        return [agent for agent in range(1, self._agents + 1) if agent not in self._of]

    def complete(self, now_s: float, absent: Set[int] = frozenset()) -> bool:
        """Whether all agents have one process, and nothing is in doubt."""
        for process, (rival, since_s) in list(self._rivals.items()):
            if now_s - since_s > _DOUBT_S:  # the older process has not been heard since: it has gone
                del self._rivals[process]
                self._replace(rival)
        return not self._rivals and not set(self.missing) - absent

    def settle(self, now_s: float, absent: Set[int]) -> list[tuple[int, ConfigError]]:
        """Decide about processes that came while the run was under way; return those refused, and why."""
        refused = []
        for process, (rival, since_s) in list(self._rivals.items()):
            taken = {agent for agent in rival.ids if agent in self._of} - absent
            if taken and now_s - since_s < _LATE_DOUBT_S:
                continue
            del self._rivals[process]
            if taken:
                refused.append((process, self._conflict(rival, taken)))
            else:
                self._replace(rival)
        return refused

    def close(self) -> None:
        """Slot 0 begins: from now on nobody's settings end the run."""
        self.closed = True

    def hear(self, message: Process, now_s: float, sender: bytes | None = None) -> None:
        """Takes in what a process says about itself.

        :raises ConfigError: if it cannot take part, naming setting, both values and node.
        :raises Unusable: for a message that cannot be, or of another run.
        """
        check_process(message, self._agents)
        message.node = plain(message.node)
        if message.run != self._run:
            self._hear_other(message, now_s)
            raise Unusable(OTHER_RUN, f"{message.node} belongs to run {run_text(message.run)}")
        member = self._members.get(message.process)
        if member is None:
            member = self._meet(message, now_s, sender)
        if member.sender != sender:
            raise Unusable(OTHER_SENDER, f"a message about {message.node} that is not its own")
        if member.ids != tuple(message.agent):
            raise Unusable(UNKNOWN, f"{message.node} for other agents than before")
        member.heard_s = now_s
        member.dropped = dict(zip(message.dropped_reason, message.dropped, strict=True))
        self._check_rivals(member)

    def _meet(self, message: Process, now_s: float, sender: bytes | None) -> Member:
        """A process tells about itself for the first time."""
        rival = self._rivals.get(message.process)
        if rival is not None:
            return rival[0]
        member = Member(message.process, message.node, tuple(message.agent), now_s, sender)
        self._compare(message)
        if any(agent in self._of for agent in member.ids):
            if len(self._rivals) >= _MOST_STRANGERS:
                raise Unusable(UNKNOWN, "too many processes for the same agents")
            self._rivals[member.process] = (member, now_s)
        else:
            self._replace(member)
        return member

    def _replace(self, member: Member) -> None:
        """A process takes the place of those that had its agents."""
        for agent in member.ids:
            before = self._of.get(agent)
            if before is not None and self._members.pop(before.process, None):
                add_counts(self._gone, before.dropped)
                del self._groups[_key(before.ids)]
                for other in before.ids:
                    self._of.pop(other, None)
        self._members[member.process] = self._groups[_key(member.ids)] = member
        for agent in member.ids:
            self._of[agent] = member

    def _check_rivals(self, member: Member) -> None:
        """Whether a member tells about itself after another process has claimed its agents.

        :raises ConfigError: then both are alive.
        """
        for rival, since_s in self._rivals.values():
            taken = set(rival.ids) & set(member.ids)
            if rival is not member and taken and member.heard_s > since_s and not self.closed:
                raise self._conflict(rival, taken)

    def _conflict(self, rival: Member, taken: Set[int]) -> ConfigError:
        nodes = ", ".join(sorted({self._of[agent].node for agent in taken}))
        return ConfigError(
            f"ids of {rival.node}", list(rival.ids), f"agents of no other process; {nodes} has {named(taken)}"
        )

    def _compare(self, message: Process) -> None:
        """Compares a process's settings with those that all share.

        :raises ConfigError: if they differ.
        :raises Unusable: if they are none.
        """
        try:
            given = parse_json(message.settings)
        except ValueError:
            given = None
        if not isinstance(given, dict) or settings_hash(given) != message.settings_hash:
            raise Unusable(RANGE, f"{message.node} says nothing about its settings")
        for name in sorted(self._agreed):
            if name not in given or given[name] != self._agreed[name]:
                raise ConfigError(
                    f"{name} of {message.node}",
                    given.get(name),
                    f"{self._agreed[name]!r}, as {self._agreed_by[name]} has it",
                )
        further = sorted(set(given) - set(self._agreed))
        if further:  # a channel without agents' settings of its own: those of the first process count
            self._agreed.update((name, given[name]) for name in further)
            self._agreed_by.update(dict.fromkeys(further, message.node))

    def _hear_other(self, message: Process, now_s: float) -> None:
        """A process of another run answers our call.

        :raises ConfigError: if it stays.
        """
        if self.closed or len(self._left_over) >= _MOST_STRANGERS:
            return
        since_s = self._left_over.setdefault(message.process, now_s)
        if now_s - since_s > _LEFT_OVER_S:
            raise ConfigError(
                f"run of {message.node}",
                run_text(message.run),
                f"no process of another run on these topics; it has {named(message.agent)}",
            )

    def check_sender(self, ids: Any, number: int | None, now_s: float, sender: bytes | None = None) -> None:
        """Whether a message can be from the process that has some agents.

        :raises Unusable: if it cannot.
        """
        member = self._groups.get(ids.tobytes())
        if member is None:
            raise Unusable(UNKNOWN, f"a message for agents {list(ids[:8])}, which no process has")
        if not member.publisher.admits(number, now_s, sender):
            raise Unusable(OTHER_SENDER, f"a message for {named(ids)} that is not of {member.node}")

    def check_frame(self, agent: int, number: int | None, now_s: float, sender: bytes | None = None) -> None:
        """Whether a frame can be from the process that has its sender.

        :raises Unusable: if it cannot.
        """
        member = self._of.get(agent)
        if member is None:
            raise Unusable(UNKNOWN, f"a frame of cf{agent}, which no process has")
        if not member.frames.admits(number, now_s, sender):
            raise Unusable(OTHER_SENDER, f"a frame of cf{agent} that is not of {member.node}")

    def dropped(self) -> dict[str, int]:
        """What all processes have not taken in, by reason."""
        total = dict(self._gone)
        for member in self._members.values():
            add_counts(total, member.dropped)
        return total


def _key(ids: tuple[int, ...]) -> bytes:
    return array("H", ids).tobytes()
