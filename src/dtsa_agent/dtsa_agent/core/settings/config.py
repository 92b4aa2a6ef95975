"""The settings of a swarm: frozen, documented, validated once and in one place."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import (
    EXTENT_M,
    FRAME_MAX,
    LENGTHS,
    MAX_EXTENDED_AGENTS,
    PROFILE_EXTENDED,
    PROFILE_PAPER,
    PROFILE_PAPER_INTENT,
    TAG_LENGTH,
)  # fmt: skip
from dtsa_agent.core.registry import ESTIMATORS, POLICIES, SELECTIONS, EstimatorRow, PolicyRow, Registry

from .declaration import Settings, check, setting
from .flight_models import AVOIDERS, flight_model

FRAMES = ("auto", "paper", "extended")
SHAPES = ("circle", "ellipse", "ellipsoid")
SCENARIOS = ("exchange", "staggered", "waypoints", "streams", "stop-and-go")
MAX_AGENTS = 1024
MOST_ROUNDS = 15  # from one anchor that nobody gives away to the next: so far lease bytes reach

REGISTRIES: dict[str, Registry[Any]] = {registry.kind: registry for registry in (POLICIES, ESTIMATORS, AVOIDERS)}
_ACCEPTED: set[str] = set()  # options of plug-ins that did not fly: to look for those takes milliseconds


@dataclass(frozen=True, slots=True, repr=False)
class SwarmConfig(Settings):
    """Everything that all agents of one swarm must agree on.

    :raises ConfigError: at creation, naming the field, the value and what is allowed.
    """

    # fmt: off
    agents: int = setting(12, "number of agents, N = |A|", minimum=1, maximum=MAX_AGENTS, group="The swarm")
    moving: int | None = setting(None, "how many of them move, in antipodal pairs, an odd one to a far point of its "
        "own; default: all in pairs", minimum=0, maximum=MAX_AGENTS)
    policy: str = setting("dtsa", "rule by which agents decide which agent sends", choices=POLICIES.names,
        open_choices=True)
    estimator: str = setting("linear", "where the others are by now", choices=ESTIMATORS.names, open_choices=True)
    avoider: str = setting("orca", "flight model: collision avoidance and vehicle", choices=AVOIDERS.names,
        open_choices=True)
    slot_ms: float = setting(10.0, "length of a time slot, t_s", "ms", 0.3, 1000)
    seed: int = setting(1, "seed of the whole run", minimum=0, maximum=2**63 - 1)

    epsilon: float = setting(0.5, "least relative difference of priorities that counts (eq:pfs)", minimum=0, maximum=1,
        group="Priority and selection")
    selection: str = setting("candidates", "reading of the selection function", choices=SELECTIONS)
    boot_round: bool = setting(True, "everyone sends once, in id order, before priorities decide")
    age_cap: float = setting(1.5, "an agent silent for age_cap * N_p slots goes first; 0: never (the paper's text)",
        minimum=0, maximum=1000)
    return_every: int = setting(20, "one of so many slots belongs to an agent outside A_p; 0: none (the paper's text)",
        minimum=0, maximum=100000)
    r_min: float = setting(0.3, "distance to the target at which an agent has arrived (eq:remaining_t_slots)", "m",
        0.001, 100)
    c_r: int = setting(1, "the constant C sent while not arrived (eq:remaining_t_slots)", minimum=1, maximum=255)
    targets_known: bool = setting(True, "all know all targets: an agent that has arrived is taken to stand there")

    frame: str = setting("auto", "frames on the air; auto: extended with policy lease, else paper", choices=FRAMES,
        group="Frames and leases")
    extent_m: float = setting(EXTENT_M, "largest coordinate that frames can say, half of it in gossip; scales the "
        "steps of positions: 2 mm by default", "m", 1, 10000)
    gossip: bool = setting(True, "extended frames carry what their sender last heard of others")
    anchor_every: int = setting(3, "lease: every so many rounds an agent's turn is an anchor: no other agent gives "
        "it away, M", minimum=1, maximum=MOST_ROUNDS)
    anchor_rest: int = setting(5, "lease: an agent that knows that it will rest gives all but one of so many anchors "
        "away, K; K M is at most 15, M without open turns or adoption", minimum=1, maximum=MOST_ROUNDS)
    open_every: int = setting(11, "lease: one of so many turns of resting agents is open to all that start moving, S "
        "(at least N / 5); 0: none", minimum=0, maximum=1000)
    adoption: bool = setting(True, "lease: the turns of the dead are given away by the next agent alive")
    depth_rate: float = setting(0.5, "lease: turns given away ahead, per round of idleness, c", minimum=0, maximum=15)
    lease_share: float = setting(1.0, "lease: no leases when more than this share of the agents has something to say",
        minimum=0, maximum=1)

    auth: bool = setting(False, "frames carry a 4-byte code that only holders of the key can make; the key is in the "
        "environment: DTSA_AUTH_KEY, 32 to 64 hexadecimal digits", group="Authentication")
    auth_session: int = setting(0, "number of the flight for that code, so that frames of other flights are none of "
        "this; 0: nodes take a random one for each flight; agents on a network, which have no node to draw it, "
        "refuse 0", minimum=0, maximum=2**63 - 1)

    scenario: str = setting("exchange", "what the swarm does", choices=SCENARIOS, group="What it does")
    shape: str = setting("circle", "where the agents start", choices=SHAPES)
    axis_x_m: float = setting(0.0, "half axis of the start shape in x; 0: from the number of agents", "m", 0, 1000)
    axis_y_m: float = setting(0.0, "half axis in y; 0: as x (circle) or 5/3 of x", "m", 0, 1000)
    axis_z_m: float = setting(0.0, "half axis in z (ellipsoid); 0: as x", "m", 0, 1000)
    jitter_m: float = setting(0.05, "starts are moved at random by up to this in x, y and z", "m", 0, 1)
    permute: bool = setting(True, "ids are dealt out at random around the shape")
    places: str = setting("", "where each agent begins: by id, the number of a place around the shape; empty: see "
        "permute")
    stagger_slots: int = setting(100, "staggered: slots between the starts of two pairs", minimum=0, maximum=100000)
    stops: int = setting(2, "waypoints, stop-and-go: goals on the way to the last one", minimum=1, maximum=100)
    pause_slots: int = setting(50, "waypoints, stop-and-go: slots of rest at each of them", minimum=0, maximum=1000000)
    announce: bool = setting(True, "an agent with a new goal does not move before it has sent a frame that says so")
    control_ms: float = setting(10.0, "longest control period", "ms", 0.5, 100)
    options: Mapping[str, float] = setting({}, "values that replace those of the flight model, by name; those of a "
        "plug-in as plug-in.option")
    # fmt: on

    def __post_init__(self) -> None:
        check(self)
        if self.moving is None:
            object.__setattr__(self, "moving", self.agents - self.agents % 2)
        if self.movers > self.agents:
            raise ConfigError("moving", self.moving, f"0 to {self.agents}, the number of agents")
        POLICIES.row(self.policy)
        ESTIMATORS.row(self.estimator)
        flight_model(self.avoider, self.options)
        self._check_plug_in_options()
        self._check_frames()
        if self.places and sorted(self.place_numbers) != list(range(1, self.agents + 1)):
            raise ConfigError("places", self.places, f"the numbers 1 to {self.agents}, each once, in any order")

    def _check_plug_in_options(self) -> None:
        """Check that plug-ins declare the options with a dot, also those of plug-ins that do not fly."""
        for key in self.options:
            owner, registries = key.rpartition(".")[0], REGISTRIES.values()
            flying = [REGISTRIES[kind] for kind, name in self.plug_ins if name == owner]
            if not owner or (not flying and key in _ACCEPTED):
                continue
            owners = flying or [registry for registry in registries if owner in registry.plug_in_names()]
            if not owners:
                names = ", ".join(sorted({name for registry in registries for name in registry.plug_in_names()}))
                raise ConfigError("options", key, f"the name of a plug-in before the dot; {names}")
            declared = sorted(f"{owner}.{word}" for r in owners for word in _declared(owner, r.factory(owner)))
            if key not in declared:
                nothing = f"none: {owner} declares no options (class attribute options)"
                raise ConfigError("options", key, ", ".join(declared) or nothing)
            if not flying:
                _ACCEPTED.add(key)

    def _check_frames(self) -> None:
        """Check that ids, and what plug-ins append, fit into frames."""
        row, estimator = self.policy_row, self.estimator_row
        if row.extended and self.frame == "paper":
            raise ConfigError("frame", self.frame, f"auto or extended with policy {self.policy}")
        if self.extended and self.agents > MAX_EXTENDED_AGENTS:
            allowed = f"1 to {MAX_EXTENDED_AGENTS} with extended frames, whose ids have 8 bits"
            others = [row.name for row in POLICIES.rows.values() if not row.extended]
            instead = f"policy {', '.join(others)}" if row.extended else "frame: paper"
            raise ConfigError("agents", self.agents, f"{allowed}; up to {MAX_AGENTS} with {instead}")
        tag = TAG_LENGTH if self.auth else 0
        room = FRAME_MAX - LENGTHS[PROFILE_EXTENDED if self.extended else PROFILE_PAPER_INTENT] - tag
        if self.own_bytes > room:
            names = " and ".join(part.name for part in (row, estimator) if part.own_bytes)
            raise ConfigError(f"own_bytes of {names}", self.own_bytes, f"0 to {room} with these frames")

    @property
    def place_numbers(self) -> list[int]:
        """Numbers (from 1) of the places at which the agents begin, by id; empty: not said."""
        words = self.places.replace(",", " ").split()
        return [int(word) if word.isascii() and word.isdigit() and len(word) < 10 else 0 for word in words]

    @property
    def plug_ins(self) -> list[tuple[str, str]]:
        """Kind and name of each part that is not built in."""
        names = {kind: str(getattr(self, kind)) for kind in REGISTRIES}
        return [(kind, name) for kind, name in names.items() if name not in REGISTRIES[kind].rows]

    @property
    def may_share_table(self) -> bool:
        """Whether agents of one process may share a table for as long as all of them receive the same frames."""
        return self.policy_row.may_share and not self.plug_ins

    @property
    def own_bytes(self) -> int:
        """Bytes that plug-ins append to each frame."""
        return self.policy_row.own_bytes + self.estimator_row.own_bytes

    @property
    def profile(self) -> int:
        """Number of the profile of frames."""
        paper = PROFILE_PAPER_INTENT if self.estimator_row.needs_intent else PROFILE_PAPER
        return PROFILE_EXTENDED if self.extended else paper

    @property
    def frame_length(self) -> int:
        """Length of each frame on the air, bytes, with what plug-ins and authentication append."""
        return LENGTHS[self.profile] + self.own_bytes + (TAG_LENGTH if self.auth else 0)

    def protocol_part(self, data: bytes, sealed: bool = False) -> bytes:
        """A frame without what plug-ins, and where it is sealed authentication, append to it.

        :param data: the frame.
        :param sealed: whether it ends with a tag, if the swarm has authentication.
        """
        return data[: max(0, len(data) - self.own_bytes - (TAG_LENGTH if sealed and self.auth else 0))]

    @property
    def policy_row(self) -> PolicyRow:
        """What is known about the policy."""
        return POLICIES.row(self.policy)

    @property
    def estimator_row(self) -> EstimatorRow:
        """What is known about the estimator."""
        return ESTIMATORS.row(self.estimator)

    @property
    def movers(self) -> int:
        """Number of moving agents."""
        return self.moving or 0

    @property
    def extended(self) -> bool:
        """Whether frames on the air have profile ``extended``."""
        return self.frame == "extended" or (self.frame == "auto" and self.policy_row.extended)

    @property
    def open_period(self) -> int:
        """S: one of so many turns of those that rest is open to all who wake, at least N / 5; 0: none is."""
        return max(self.open_every, self.agents // 5) if self.open_every else 0

    @property
    def turn_every(self) -> int:
        """Rounds within which each agent that moves sends: M; 5 with policies that have no anchors."""
        return self.anchor_every if self.policy_row.probation else 5

    @property
    def main_every(self) -> int:
        """Rounds from one main anchor of an agent, which nobody gives away, to the next: K M.

        Where there are no open turns, or nobody speaks for the absent, every anchor is a main one: who wakes or comes
        back would have nothing else.
        """
        rest = min(self.anchor_rest, MOST_ROUNDS // self.anchor_every)
        return self.anchor_every * (rest if self.open_every and self.adoption else 1)

    @property
    def slot_s(self) -> float:
        """Length of a slot, s."""
        return self.slot_ms / 1000.0

    @property
    def slot_ns(self) -> int:
        """Length of a slot, ns."""
        return round(self.slot_ms * 1_000_000)

    @property
    def steps(self) -> int:
        """Control instants in one slot."""
        return max(1, math.ceil(self.slot_ms / self.control_ms - 1e-9))


def _declared(name: str, factory: Any) -> Iterable[str]:
    options: Any = getattr(factory, "options", ())
    if not isinstance(options, (tuple, list, set, frozenset)) or not all(isinstance(word, str) for word in options):
        raise ConfigError(f"{name}.options", options, 'a tuple of names, as ("error_m", "rounds")')
    return options


def agreed_settings(config: SwarmConfig, mode: str) -> dict[str, Any]:
    """The settings that all processes of a flight (mode lockstep, realtime or udp) must share, as plain values."""
    values = {**config.to_dict(), "steps": config.steps, "mode": mode}
    return dict(json.loads(json.dumps(values, sort_keys=True, default=str)))


def settings_hash(settings: Mapping[str, Any]) -> int:
    """A number of 64 bits that two sets of settings, as plain values, share only if they are equal."""
    import hashlib  # brings OpenSSL along: 0.6 MB that an agent in flight does without

    text = json.dumps(settings, sort_keys=True, separators=(",", ":"))
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "little")
