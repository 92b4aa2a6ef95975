"""Policies and estimators: one row each. Whatever depends on the nature of one asks its row.

Avoiders and their vehicles are rows as well: :data:`.settings.flight_models.AVOIDERS`. Built-in rows are in the order
of libdtsa's numbers; plug-ins get their rows from what they declare. A built-in policy is a row here, a file in
``libdtsa/policy``, and its number and name in ``libdtsa``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from .errors import ConfigError
from .kernel import NAMES

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

PORT = ("send", "sent", "received", "busy")  # what an air offers; see docs/reference/protocol.md
MAX_OWN_BYTES = 16  # of one plug-in
SELECTIONS, REASONS = NAMES["selections"], NAMES["reasons"]

# Why an agent expects another one (or none) to send in a slot, and what that means.
REASON_TEXTS: Mapping[str, str] = MappingProxyType(
    {
        "nobody": "no agent moves any more, so no agent has a claim to the slot",
        "tdma": "the slot's number says whose turn it is: slot modulo N",
        "boot": "first round: every agent sends once, in the order of ids, so that all know all",
        "age-cap": "was silent for longer than the age cap allows, whatever its priority",
        "priority": "has the largest priority g, and no other comes within epsilon of it",
        "tie": "several priorities are within epsilon of the largest: of these, the longest silent",
        "oldest": "the longest silent of those that move, because priorities say nothing here or are not used",
        "return": "slot kept for agents that have arrived, so that they can say that they move again",
        "random": "a draw decides whether the agent sends",
        "plugin": "a policy from another package decided",
        "own": "the owner uses its own turn",
        "anchor": "the owner's turn that no other agent gives away, so that all hear of the owner now and then",
        "leased": "the owner gave this turn to an agent that has more to say",
        "adopted": "the owner is absent; the next agent that is not gave its turn away",
        "open": "turn for any agent that has just started moving or joined; no particular agent is expected",
        "absent": "the owner is absent, and its turn was given to no agent",
        "probation": "the owner is new or was away, and may send at its anchors only",
        "innovation": "of those that move the longest silent, weighed by how much its velocity has just changed",
    }
)


Row = TypeVar("Row", bound=Any)  # has a name


@dataclass(frozen=True, slots=True)
class PolicyRow:
    """Who sends next: what the rest of the software has to know about a policy."""

    name: str  # what the setting ``policy`` calls it
    label: str  # what figures call it
    may_share: bool = False  # agents that have heard the same decide the same: one table may serve all of them
    may_join: bool = False  # agents may come late or come back: nobody needs a table that all have equal
    says_leaving: bool = False  # an agent that leaves says so in a last frame
    probation: bool = False  # an agent that is new or stood still for long may not use all of its turns yet
    extended: bool = False  # its frames are extended ones
    agent_state: bool = False  # it keeps state of its own for each agent (``lease_state`` of a swarm)
    weighs_all: bool = False  # it computes the priorities of all agents in every slot
    port: tuple[str, ...] = ("send", "received")  # what it uses of the air, of :data:`PORT`
    own_bytes: int = 0  # bytes of its own that a plug-in appends to frames
    needs_everybody: bool = False  # it looks into all agents: they must be in one process; for comparison only
    unslotted: bool = False  # it sends at any instant; slots only say how often vehicles are steered and ages counted
    reacts: bool = False  # unslotted, and it acts on each packet as it arrives; for comparison only

    @property
    def listens(self) -> bool:
        """Whether an agent's radio listens before it sends, and so decides itself when it begins."""
        return self.unslotted and "busy" in self.port

    @property
    def needs_frame(self) -> bool:
        """Whether an agent must have a slot's frame before it knows who sends in the next one: all tables are equal."""
        return not (self.may_join or self.needs_everybody or self.unslotted)


@dataclass(frozen=True, slots=True)
class EstimatorRow:
    """Where the others are by now."""

    name: str  # what the setting ``estimator`` calls it
    needs_intent: bool = False  # frames carry the commanded velocity
    needs_everybody: bool = False  # it knows the truth: all agents must be in one process
    own_bytes: int = 0  # bytes of its own that a plug-in appends to frames


class Registry(Generic[Row]):
    """Rows by name: the built-in ones, in the order of libdtsa's numbers, and those of plug-ins.

    ``kind`` is the setting that names a row, ``group`` that of the entry points in which packages announce plug-ins.
    ``row`` and ``factory`` raise a ConfigError if there is none of a name, or it cannot be used.
    """

    def __init__(self, kind: str, group: str, rows: Iterable[Row], plug_in_row: Callable[[str, Any], Row]) -> None:
        self.kind, self.group = kind, group
        self.rows: Mapping[str, Row] = MappingProxyType({row.name: row for row in rows})
        self._plug_in_row = plug_in_row
        self._plug_ins: dict[str, tuple[Any, Row]] = {}  # looking for them takes milliseconds
        self.registered: set[str] = set()  # names of plug-ins that only this process knows

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the built-in rows."""
        return tuple(self.rows)

    def number(self, name: str) -> int:
        """The number of a row in libdtsa; plug-ins have the one after the last."""
        return self.names.index(name) if name in self.rows else len(self.rows)

    def row(self, name: str) -> Row:
        """The row of a name."""
        return self.rows[name] if name in self.rows else self._plug_in(name)[1]

    def factory(self, name: str) -> Any:
        """The factory of a plug-in."""
        return self._plug_in(name)[0]

    def register(self, name: str, factory: Any) -> None:
        """Make a plug-in known to this process, under a name that no built-in row has; an older one is replaced."""
        if not isinstance(name, str) or not name or name in self.rows:
            raise ConfigError(self.kind, name, f"another name: {', '.join(self.rows)} are built in")
        if not callable(factory):
            raise ConfigError(name, factory, "a class, or a function of the configuration and an agent's id")
        self._plug_ins[name] = factory, self._plug_in_row(name, factory)
        self.registered.add(name)

    def plug_ins(self) -> dict[str, EntryPoint]:
        """The plug-ins installed on this machine, by name; ConfigError: one has the name of a built-in row."""
        from importlib.metadata import entry_points  # a tenth of a node's start, which mostly needs no plug-in

        points = {point.name: point for point in entry_points(group=self.group)}
        for name in self.rows:
            if name in points:
                allowed = f"another name for {points[name].value}: {', '.join(self.rows)} are built in"
                raise ConfigError(self.group, name, allowed)
        return points

    def plug_in_names(self) -> set[str]:
        """Names of the plug-ins that this process can use."""
        return self.registered | self.plug_ins().keys()

    def _plug_in(self, name: str) -> tuple[Any, Row]:
        if name in self._plug_ins:
            return self._plug_ins[name]
        points = self.plug_ins()
        if name not in points:
            raise ConfigError(self.kind, name, ", ".join((*self.rows, *sorted(points))))
        try:
            factory = points[name].load()
        except Exception as error:
            source = f"{points[name].value} ({type(error).__name__}: {error})"
            raise ConfigError(self.kind, name, f"a plug-in that can be imported, unlike {source}") from error
        return self._plug_ins.setdefault(name, (factory, self._plug_in_row(name, factory)))


def _declared(name: str, factory: Any, flag: str) -> dict[str, Any]:
    """What policies and estimators of other packages declare: a flag, and ``own_bytes``."""
    values = {flag: getattr(factory, flag, False), "own_bytes": getattr(factory, "own_bytes", 0)}
    if not isinstance(values[flag], bool):
        raise ConfigError(f"{name}.{flag}", values[flag], "True or False")
    if type(values["own_bytes"]) is not int or not 0 <= values["own_bytes"] <= MAX_OWN_BYTES:
        raise ConfigError(f"{name}.own_bytes", values["own_bytes"], f"0 to {MAX_OWN_BYTES}")
    return values


def _policy_plug_in(name: str, factory: Any) -> PolicyRow:
    def has(*methods: str) -> bool:
        return all(callable(getattr(factory, method, None)) for method in methods)

    port, declared = getattr(factory, "port", ("send", "received")), _declared(name, factory, "may_join")
    if not isinstance(port, (tuple, list)) or any(part not in PORT for part in port):
        raise ConfigError(f"{name}.port", port, "a tuple of some of " + ", ".join(PORT))
    needs_everybody, unslotted = has("senders"), has("wake")
    if needs_everybody and declared["own_bytes"]:
        raise ConfigError(f"{name}.own_bytes", factory.own_bytes, "0 for a policy that looks into all agents")
    reacts = unslotted and has("received")
    if unslotted and "busy" in port and not has("sensed", "sent"):
        raise ConfigError(f"{name}.port", port, "'busy' with the methods sensed and sent beside wake")
    if reacts and "busy" in port:
        raise ConfigError(f"{name}.port", port, "no 'busy' where a method received answers packets")
    return PolicyRow(
        name, name, port=tuple(port), needs_everybody=needs_everybody, unslotted=unslotted, reacts=reacts, **declared
    )


def _estimator_plug_in(name: str, factory: Any) -> EstimatorRow:
    return EstimatorRow(name, **_declared(name, factory, "needs_intent"))


_POLICIES = (
    PolicyRow("tdma", "TDMA", may_share=True, may_join=True, port=("send",)),
    PolicyRow("dtsa", "DTSA", may_share=True, weighs_all=True),
    PolicyRow("age", "age", may_share=True),
    PolicyRow("aloha", "aloha", may_join=True),
    PolicyRow("lease", "lease", may_join=True, says_leaving=True, probation=True, extended=True, agent_state=True),
    PolicyRow("innovation", "innovation", may_share=True),
)
_ESTIMATORS = (
    EstimatorRow("hold"),
    EstimatorRow("linear"),
    EstimatorRow("intent", needs_intent=True),
    EstimatorRow("oracle", needs_everybody=True),
)
POLICIES = Registry("policy", "dtsa.policies", _POLICIES, _policy_plug_in)
ESTIMATORS = Registry("estimator", "dtsa.estimators", _ESTIMATORS, _estimator_plug_in)

for _kind, _names in (("policies", POLICIES.names), ("estimators", ESTIMATORS.names), ("reasons", tuple(REASON_TEXTS))):
    if _names != NAMES[_kind]:
        raise ImportError(f"{_kind}: Python has {_names}, libdtsa has {NAMES[_kind]}; build dtsa_agent again")
