"""Who takes part in a run: the processes of its agents."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from typing import Any

from dtsa_msgs.msg import Process

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.config import settings_hash
from dtsa_agent.ros.common import checks
from dtsa_agent.ros.common.checks import BadMessage
from dtsa_agent.ros.common.names import agent_names
from dtsa_agent.ros.common.runs import run_text

from .answers import Places, places_of

_DOUBT_S = 0.5  # two processes with the same agent: which of them is alive shows within this time
_LATE_DOUBT_S = 2.5  # the same once the run is under way: an agent is lost after 2 s
_LEFT_OVER_S = 3.0  # agents whose channel has gone end within this time
_MOST_OTHERS = 256  # processes of other runs, or for the same agents


@dataclass(slots=True)
class Member:
    """One process of agents."""

    process: int
    node: str
    ids: array[int]
    heard_s: float  # monotonic, when its last message about itself came
    sender: bytes | None  # participant of all its messages; None: not known
    places: Places
    dropped: dict[str, int] = field(default_factory=dict)


class Roster:
    """Collects what processes publish about themselves before slot 0, and keeps out those that do not fit.

    All must share the settings ``agreed``. Times are s, monotonic; ``sender`` is the sender of a message, None: not
    known; ``absent`` are ids of agents that are not waited for.
    """

    def __init__(self, agents: int, run: int, agreed: Mapping[str, Any], channel: str) -> None:
        self._agents, self._run = agents, run
        self._agreed = {name: (value, channel) for name, value in agreed.items()}  # and the node that has said so
        self._members: dict[int, Member] = {}  # by process
        self._of: dict[int, Member] = {}  # by agent
        self._rivals: dict[int, tuple[Member, float]] = {}  # processes that claim agents of a member, since when
        self._left_over: dict[int, float] = {}  # processes of another run, since when
        self._gone: Counter[str] = Counter()  # what processes that have been replaced had dropped
        self.closed = False  # slot 0 begins: from now on no settings end the run

    @property
    def missing(self) -> list[int]:
        """Ids of the agents whose processes are not known yet."""
        return [agent for agent in range(1, self._agents + 1) if agent not in self._of]

    def awaited(self, now_s: float, absent: Set[int] = frozenset()) -> set[int]:
        """Return the ids of the agents that have no process yet, or that two processes claim."""
        self.decide(now_s, absent)
        return {agent for rival, _ in self._rivals.values() for agent in rival.ids} | set(self.missing) - absent

    def decide(self, now_s: float, absent: Set[int]) -> list[tuple[int, ConfigError]]:
        """Decide about processes that claim agents of others; return those refused, and why.

        Before slot 0 the newer one counts if the older one is not heard any more. Later it is refused, unless its
        agents are absent.
        """
        refused = []
        for process, (rival, since_s) in list(self._rivals.items()):
            taken = {agent for agent in rival.ids if agent in self._of}
            if self.closed:
                taken -= absent
            if taken and now_s - since_s < (_LATE_DOUBT_S if self.closed else _DOUBT_S):
                continue
            del self._rivals[process]
            if taken and self.closed:
                refused.append((process, self._conflict(rival, taken)))
            else:
                self._replace(rival)
        return refused

    def hear(self, message: Process, now_s: float, sender: bytes | None) -> None:
        """Process a message of a process about itself.

        :raises ConfigError: if it cannot take part, naming setting, both values and node.
        :raises BadMessage: for a message that cannot be, or of another run.
        """
        checks.check_process(message, self._agents)
        message.node = checks.plain(message.node)
        if message.run != self._run:
            self._note_other_run(message, now_s)
            raise BadMessage(checks.OTHER_RUN, f"{message.node} belongs to run {run_text(message.run)}")
        member = self._members.get(message.process) or self._meet(message, now_s, sender)
        if member.sender != sender:
            raise BadMessage(checks.OTHER_SENDER, f"a message about {message.node} that is not its own")
        if member.ids != message.agent:
            raise BadMessage(checks.UNKNOWN, f"{message.node} for other agents than before")
        member.heard_s = now_s
        member.dropped = dict(zip(message.dropped_reason, message.dropped, strict=True))
        for rival, since_s in () if self.closed else self._rivals.values():
            taken = set(rival.ids) & set(member.ids)
            if rival is not member and taken and member.heard_s > since_s:
                raise self._conflict(rival, taken)  # both are alive

    def _meet(self, message: Process, now_s: float, sender: bytes | None) -> Member:
        """A process publishes about itself for the first time."""
        if message.process in self._rivals:
            return self._rivals[message.process][0]
        places = places_of(message.agent, self._agents)
        member = Member(message.process, message.node, message.agent, now_s, sender, places)
        self._compare(message)
        if self._of.keys().isdisjoint(member.ids):
            self._replace(member)
        elif len(self._rivals) >= _MOST_OTHERS:
            raise BadMessage(checks.UNKNOWN, "too many processes for the same agents")
        else:
            self._rivals[member.process] = (member, now_s)
        return member

    def _replace(self, member: Member) -> None:
        """A process takes the place of those that had its agents."""
        for before in [self._of[agent] for agent in member.ids if agent in self._of]:
            if self._members.pop(before.process, None):
                self._gone.update(before.dropped)
                for other in before.ids:
                    self._of.pop(other, None)
        self._members[member.process] = member
        self._of.update(dict.fromkeys(member.ids, member))

    def _conflict(self, rival: Member, taken: Set[int]) -> ConfigError:
        nodes = ", ".join(sorted({self._of[agent].node for agent in taken}))
        return ConfigError(
            f"ids of {rival.node}", list(rival.ids), f"agents of no other process; {nodes} has {agent_names(taken)}"
        )

    def _compare(self, message: Process) -> None:
        """Compare a process's settings with those that all share.

        :raises ConfigError: if they differ.
        :raises BadMessage: if they are none.
        """
        try:
            given = checks.parse_json(message.settings)
        except ValueError:
            given = None
        if not isinstance(given, dict) or settings_hash(given) != message.settings_hash:
            raise BadMessage(checks.RANGE, f"{message.node} says nothing about its settings")
        for name, (value, node) in sorted(self._agreed.items()):
            if name not in given or given[name] != value:
                raise ConfigError(f"{name} of {message.node}", given.get(name), f"{value!r}, as {node} has it")
        # A channel without agents' settings of its own: those of the first process count.
        self._agreed = {name: (value, message.node) for name, value in given.items()} | self._agreed

    def _note_other_run(self, message: Process, now_s: float) -> None:
        """A process of another run answers our call.

        :raises ConfigError: if it stays.
        """
        if self.closed or len(self._left_over) >= _MOST_OTHERS:
            return
        since_s = self._left_over.setdefault(message.process, now_s)
        if now_s - since_s > _LEFT_OVER_S:
            allowed = f"no process of another run on these topics; it has {agent_names(message.agent)}"
            raise ConfigError(f"run of {message.node}", run_text(message.run), allowed)

    def check_sender(self, ids: Any, sender: bytes | None) -> Places:
        """Check that a message can be from the process that has some agents; return their places."""
        member = self._of.get(ids[0]) if ids else None
        return _admit(member if member is not None and member.ids == ids else None, ids, sender).places

    def is_member(self, sender: bytes | None) -> bool:
        """Whether a sender is a process of this run."""
        return any(member.sender == sender for member in self._members.values())

    def check_frame(self, agent: int, sender: bytes | None) -> None:
        """Check that a frame can be from the process that has its sender."""
        _admit(self._of.get(agent), (agent,), sender)

    def dropped(self) -> Counter[str]:
        """Return the number of messages that all processes have dropped, by reason."""
        total = self._gone.copy()
        for member in self._members.values():
            total.update(member.dropped)
        return total


def _admit(member: Member | None, ids: Any, sender: bytes | None) -> Member:
    if member is None:
        raise BadMessage(checks.UNKNOWN, f"a message for {agent_names(ids[:8])}, which no process has")
    if sender != member.sender:
        detail = f"a message for {agent_names(ids[:8])} that is not of {member.node}"
        raise BadMessage(checks.OTHER_SENDER, detail)
    return member
