"""Policies and estimators: one row each. Whatever depends on the nature of one asks its row.

Avoiders and their vehicles are rows as well: :data:`.settings.flight_models.AVOIDERS`. Rows are in the order of
the kernel's numbers, which is checked when this module is imported. Plug-ins get their rows from what they declare.

A built-in policy is a row here, a file in ``libdtsa/policy``, and its number and name in ``libdtsa``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from .compiled import MISSING, NAMES
from .errors import ConfigError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

PORT = ("send", "sent", "received", "busy")  # what an air offers; see docs/reference/protocol.md


class _Named(Protocol):
    @property
    def name(self) -> str: ...


Row = TypeVar("Row", bound=_Named)


@dataclass(frozen=True, slots=True)
class PolicyRow:
    """Who sends next: what the rest of the software has to know about a policy.

    :param name: what the setting ``policy`` calls it.
    :param label: what figures call it.
    :param decides: who sends in a slot, in a few words.
    :param under_loss: what becomes of it on a channel that loses frames.
    :param may_share: agents that have heard the same decide the same: one table may serve all of them.
    :param may_join: agents may come late or come back, because nobody needs a table that all have equal.
    :param says_leaving: an agent that leaves says so in a last frame.
    :param probation: an agent that is new or stood still for long may not use all of its turns yet.
    :param extended: its frames are extended ones.
    :param agent_state: it keeps state of its own for each agent (``lease_state`` of a swarm).
    :param weighs_all: it computes the priorities of all agents in every slot.
    :param most_agents: largest number of agents; None: as many as a swarm may have.
    :param port: what it uses of the air, of :data:`PORT`.
    :param own_bytes: bytes of its own that a plug-in appends to frames.
    :param needs_everybody: it looks into all agents: they must be in one process. For comparison only.
    :param unslotted: it sends at any instant; slots only say how often vehicles are steered and ages are counted.
    :param reacts: unslotted, and it acts on each packet as it arrives. For comparison only.
    """

    name: str
    label: str
    decides: str
    under_loss: str
    may_share: bool = False
    may_join: bool = False
    says_leaving: bool = False
    probation: bool = False
    extended: bool = False
    agent_state: bool = False
    weighs_all: bool = False
    most_agents: int | None = None
    port: tuple[str, ...] = ("send", "received")
    own_bytes: int = 0
    needs_everybody: bool = False
    unslotted: bool = False
    reacts: bool = False

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
    """Where the others are by now.

    :param name: what the setting ``estimator`` calls it.
    :param text: what it supposes, in a few words.
    :param needs_intent: frames carry the commanded velocity.
    :param needs_everybody: it knows the truth: all agents must be in one process.
    :param own_bytes: bytes of its own that a plug-in appends to frames.
    """

    name: str
    text: str
    needs_intent: bool = False
    needs_everybody: bool = False
    own_bytes: int = 0


class Registry(Generic[Row]):
    """Rows by name: the built-in ones, in the order of the kernel's numbers, and those of plug-ins.

    :param kind: the setting that names a row.
    :param group: the group of entry points in which packages announce plug-ins.
    :param rows: the built-in rows.
    :param plug_in_row: makes the row of a plug-in from its name and its factory.
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
        """The kernel's number of a row; plug-ins have the one after the last.

        :param name: the name.
        """
        return self.names.index(name) if name in self.rows else len(self.rows)

    def row(self, name: str) -> Row:
        """The row of a name.

        :param name: the name.
        :raises ConfigError: if there is none, or it is a plug-in that cannot be used.
        """
        return self.rows[name] if name in self.rows else self._plug_in(name)[1]

    def factory(self, name: str) -> Any:
        """The factory of a plug-in.

        :param name: the name it was announced by.
        :raises ConfigError: if there is none, or it cannot be used.
        """
        return self._plug_in(name)[0]

    def register(self, name: str, factory: Any) -> None:
        """Makes a plug-in known to this process, under a name that no built-in row has; an older one is replaced.

        :param name: what the setting calls it.
        :param factory: called as ``factory(config, agent)`` for every observer.
        :raises ConfigError: for a name or a factory that cannot be used.
        """
        if not isinstance(name, str) or not name or name in self.rows:
            raise ConfigError(self.kind, name, f"another name: {', '.join(self.rows)} are built in")
        if not callable(factory):
            raise ConfigError(name, factory, "a class, or a function of the configuration and an agent's id")
        self._plug_ins[name] = factory, self._plug_in_row(name, factory)
        self.registered.add(name)

    def plug_ins(self) -> dict[str, EntryPoint]:
        """The plug-ins installed on this machine, by name.

        :raises ConfigError: if one has the name of a built-in row.
        """
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
        if name not in self._plug_ins:
            points = self.plug_ins()
            if name not in points:
                raise ConfigError(self.kind, name, ", ".join((*self.rows, *sorted(points))))
            try:
                factory = points[name].load()
            except Exception as error:
                source = f"{points[name].value} ({type(error).__name__}: {error})"
                raise ConfigError(self.kind, name, f"a plug-in that can be imported, unlike {source}") from error
            self._plug_ins[name] = factory, self._plug_in_row(name, factory)
        return self._plug_ins[name]


MAX_OWN_BYTES = 16  # of one plug-in


def _own_bytes(name: str, factory: Any) -> int:
    own = getattr(factory, "own_bytes", 0)
    if isinstance(own, bool) or not isinstance(own, int) or not 0 <= own <= MAX_OWN_BYTES:
        raise ConfigError(f"{name}.own_bytes", own, f"0 to {MAX_OWN_BYTES}")
    return own


def _flag(name: str, factory: Any, attribute: str) -> bool:
    value = getattr(factory, attribute, False)
    if not isinstance(value, bool):
        raise ConfigError(f"{name}.{attribute}", value, "True or False")
    return value


def _policy_plug_in(name: str, factory: Any) -> PolicyRow:
    port = getattr(factory, "port", ("send", "received"))
    if not isinstance(port, (tuple, list)) or any(part not in PORT for part in port):
        raise ConfigError(f"{name}.port", port, "a tuple of some of " + ", ".join(PORT))
    needs_everybody = callable(getattr(factory, "senders", None))
    if needs_everybody and _own_bytes(name, factory):
        raise ConfigError(f"{name}.own_bytes", factory.own_bytes, "0 for a policy that looks into all agents")
    unslotted = callable(getattr(factory, "wake", None))
    if unslotted and "busy" in port and not all(callable(getattr(factory, part, None)) for part in ("sensed", "sent")):
        raise ConfigError(f"{name}.port", port, "'busy' with the methods sensed and sent beside wake")
    reacts = unslotted and callable(getattr(factory, "received", None))
    if reacts and "busy" in port:
        raise ConfigError(f"{name}.port", port, "no 'busy' where a method received answers packets")
    return PolicyRow(
        name,
        name,
        "plug-in",
        "as it was written",
        may_join=_flag(name, factory, "may_join"),
        port=tuple(port),
        own_bytes=_own_bytes(name, factory),
        needs_everybody=needs_everybody,
        unslotted=unslotted,
        reacts=reacts,
    )


def _estimator_plug_in(name: str, factory: Any) -> EstimatorRow:
    needs_intent = _flag(name, factory, "needs_intent")
    return EstimatorRow(name, "plug-in", needs_intent, own_bytes=_own_bytes(name, factory))


POLICIES = Registry(
    "policy",
    "dtsa.policies",
    (
        PolicyRow("tdma", "TDMA", "slot modulo N", "works", may_share=True, may_join=True, port=("send",)),
        PolicyRow(
            "dtsa",
            "DTSA",
            "the agent whose state is most urgent, as in the paper",
            "tables diverge, slots collide, for good",
            may_share=True,
            weighs_all=True,
        ),
        PolicyRow("age", "age", "the longest silent of those that have not arrived", "the same", may_share=True),
        PolicyRow("aloha", "aloha", "everybody with probability 1/N_p", "collides by design", may_join=True),
        PolicyRow(
            "lease",
            "lease",
            "the owner; an owner with nothing to say leases its slot, in its own frame, to an agent that has",
            "works; no two senders by construction",
            may_join=True,
            says_leaving=True,
            probation=True,
            extended=True,
            agent_state=True,
        ),
    ),
    _policy_plug_in,
)

ESTIMATORS = Registry(
    "estimator",
    "dtsa.estimators",
    (
        EstimatorRow("hold", "where last heard"),
        EstimatorRow("linear", "on with the velocity last heard (eq:estimate)"),
        EstimatorRow("intent", "towards the commanded velocity, which the frame carries", needs_intent=True),
        EstimatorRow("oracle", "the truth, for comparison", needs_everybody=True),
    ),
    _estimator_plug_in,
)

SELECTIONS = ("candidates", "pairwise")  # readings of the selection function
PROFILES = ("paper", "paper-intent", "extended")  # of frames
# Why an agent takes whom it takes for the sender of a slot, and what that means.
REASON_TEXTS: Mapping[str, str] = MappingProxyType(
    {
        "nobody": "nobody moves any more, so nobody has a claim to the slot",
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
        "anchor": "the owner's turn that nobody else gives away, so that all hear of it now and then",
        "leased": "the owner gave this turn to an agent that has more to say",
        "adopted": "the owner is thought dead; the next one alive gave its turn away",
        "open": "turn for whoever has just woken or joined; nobody in particular is expected",
        "absent": "the owner is thought dead, and nobody was given its turn",
        "probation": "the owner is new or was away, and may send at its anchors only",
    }
)
REASONS: tuple[str, ...] = tuple(REASON_TEXTS)


def check_kernel(kind: str, names: tuple[str, ...]) -> None:
    """Compares a list of names with the compiled kernel's, whose numbers are places in it.

    :param kind: the list's name in the kernel.
    :param names: the list as Python has it.
    :raises ImportError: if they differ: kernel and Python are not of the same version.
    """
    compiled = names if MISSING else NAMES.get(kind)
    if compiled != names:
        raise ImportError(f"{kind}: Python has {names}, the compiled kernel has {compiled}; build dtsa_agent again")


for _kind, _names in (
    ("policies", POLICIES.names),
    ("estimators", ESTIMATORS.names),
    ("selections", SELECTIONS),
    ("profiles", PROFILES),
    ("reasons", REASONS),
):
    check_kernel(_kind, _names)
