"""The compiled core beside the specification: the same flights on both, equal in every frame, decision and position."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from dtsa_agent.core import REASONS, Swarm, SwarmConfig, make_scenario
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.reference.stepper import ReferenceSwarm
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_dev.protocol.experiment import random_schedule

POLICIES = ("tdma", "dtsa", "age", "aloha", "innovation", "lease", "lease")
ESTIMATORS = ("hold", "linear", "intent", "oracle")
AVOIDERS = ("orca", "potential", "bvc", "none", "crazyflie", "jerky", "bvc-firmware")
SCENARIOS = ("exchange", "staggered", "waypoints", "streams", "stop-and-go")
GOALS, FAR = ("go", "go", "stop", "rest"), 30.0  # m
SHORT, LONG = 300, 1700  # slots
FAULTS = ("die", "join", "join", "restart", "leave")

# Compared after every slot, besides senders and frames: values of agents, of tables, and estimates, which a shared
# table has of all.
_OF_AGENTS = (
    "chosen", "reason", "score", "digest", "sends", "present", "position", "velocity", "command", "track",
)  # fmt: skip
_OF_TABLES = (
    "sent_position", "sent_velocity", "sent_intent", "innovation", "sent_slot", "last_turn", "in_ap", "entry_hash",
    "table_hash", "priority", "counter",
)  # fmt: skip
_ESTIMATES = ("estimate_position", "estimate_velocity")


class Differs(DtsaError):
    """The compiled core and the specification do not agree; the message says where first."""


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that befalls an agent before a slot.

    ``die``, ``join``, ``restart``, ``leave``; ``go``: gets a far goal; ``stop``, ``rest``: its goal is where it is, and
    it may get another one, or knows that it will not.
    """

    slot: int
    kind: str
    agent: int  # id


@dataclass(frozen=True, slots=True)
class CheckedFlight:
    """A flight with everything that happens in it."""

    swarm: SwarmConfig
    channel: ChannelConfig
    slots: int
    faults: tuple[Fault, ...] = ()
    shared: bool = False

    def name(self) -> str:
        """The setting in a few words."""
        s = self.swarm
        loss = "loss" if self.channel.loss or self.channel.loss_matrix else "no loss"
        return f"{s.policy} {s.estimator} {s.avoider} {s.scenario} N={s.agents} {loss}"


def random_setting(seed: int, policy: str | None = None, *, lasts: bool | None = None) -> CheckedFlight:
    """A flight with a random policy, estimator, avoider, scenario, channel and random misfortune.

    One that `lasts` has policy ``lease`` and few agents, so that the dead are adopted and some come back.
    """
    random = np.random.default_rng([seed, 13])
    pick = random.choice
    policy = str(pick(POLICIES)) if policy is None else policy
    lasts = policy == "lease" and (bool(random.random() < 0.25) if lasts is None else lasts)
    agents, slots = int(random.integers(2, 12 if lasts else 10)), LONG if lasts else SHORT
    kind: dict[str, Any]
    if lasts:  # far enough to fly all the time
        kind = {"avoider": "none", "axis_x_m": 20.0, "adoption": True, "anchor_every": int(random.integers(2, 6))}
    else:
        kind = {
            "avoider": str(pick(AVOIDERS)), "axis_x_m": float(pick([0.0, 1.2])),
            "anchor_every": int(random.integers(1, 8)), "adoption": bool(random.random() < 0.7),
            "extent_m": float(pick([65.534, 20.0, 200.0])),
        }  # fmt: skip
    swarm = SwarmConfig(
        agents=agents, moving=int(random.integers(2 if lasts else 0, agents + 1)), policy=policy, seed=seed,
        estimator=str(pick(ESTIMATORS)), scenario=str(pick(SCENARIOS)), slot_ms=float(pick([10.0, 10.0, 20.0, 25.0])),
        selection=str(pick(["candidates", "pairwise"])), epsilon=float(pick([0.0, 0.1, 0.5, 1.0])),
        boot_round=bool(random.random() < 0.7), age_cap=float(pick([0.0, 1.0, 1.5, 10.0])),
        return_every=int(pick([0, 1, 20])), c_r=int(pick([1, 7, 255])), targets_known=bool(random.random() < 0.7),
        gossip=bool(random.random() < 0.8), frame="extended" if random.random() < 0.3 else "auto",
        open_every=int(pick([0, 3, 11])), depth_rate=float(pick([0.1, 1.0, 5.0])),
        lease_share=float(pick([0.75, 1.0])), stops=3, stagger_slots=int(pick([5, 60])),
        pause_slots=int(pick([5, 40])), announce=bool(random.random() < 0.7),
        options={"margin_rate": 0.1} if random.random() < 0.3 else {}, **kind,
    )  # fmt: skip
    return CheckedFlight(
        swarm,
        _random_channel(random, swarm, slots),
        slots,
        tuple(_deaths_and_returns(random, swarm) if lasts else _random_faults(random, swarm, slots)),
        shared=policy != "lease" and bool(random.random() < 0.15),
    )


def _random_channel(random: np.random.Generator, swarm: SwarmConfig, slots: int) -> ChannelConfig:
    agents, loss = swarm.agents, float(random.choice([0.0, 0.0, 0.1, 0.3]))
    matrix: tuple[tuple[float, ...], ...] = ()
    if random.random() < 0.2:
        links = random.uniform(0.0, 0.6, (agents, agents))
        np.fill_diagonal(links, 0.0)
        matrix = tuple(tuple(float(x) for x in row) for row in links)
    return ChannelConfig(
        agents=agents, slot_ns=swarm.slot_ns, seed=swarm.seed, loss=loss, loss_matrix=matrix,
        burst_length=float(random.choice([0.0, 10.0])) if loss else 0.0,
        range_m=0.0 if slots == LONG else float(random.choice([0.0, 0.0, 3.0])),
        schedule=tuple(random_schedule(random, agents, slots)) if random.random() < 0.3 else (),
    )  # fmt: skip


def _random_faults(random: np.random.Generator, swarm: SwarmConfig, slots: int) -> Iterator[Fault]:
    if not swarm.policy_row.may_join or random.random() < 0.3:
        return
    for slot in range(1, slots):
        if random.random() < 0.02:
            yield Fault(slot, FAULTS[random.integers(len(FAULTS))], int(random.integers(1, swarm.agents + 1)))


def _deaths_and_returns(random: np.random.Generator, swarm: SwarmConfig) -> Iterator[Fault]:
    """Some die early and come back after the others have adopted their turns; all get goals, and lose them."""
    for agent in range(1, swarm.agents + 1):
        chance = random.random()
        if chance < 0.5 and agent > 1:
            yield Fault(int(random.integers(1, 60)), "die", agent)
            yield Fault(int(random.integers(LONG - 400, LONG)), "join", agent)
        elif chance < 0.8:
            yield Fault(int(random.integers(100, LONG)), FAULTS[random.integers(3, 5)], agent)
        slot, pace = 0, int(random.choice([60, 300, LONG]))
        while (slot := slot + int(random.integers(1, pace))) < LONG:
            yield Fault(slot, GOALS[random.integers(len(GOALS))], agent)


def happen(fault: Fault, swarm: Swarm) -> None:
    """Let a fault happen to a swarm all of whose agents are here, before a slot begins."""
    k = fault.agent - 1
    if fault.kind == "die":
        swarm.present[k] = 0
    elif fault.kind == "join" and not swarm.present[k]:
        swarm.present[k] = 1
    elif fault.kind == "leave":
        swarm.leave(k)
    elif fault.kind in GOALS:
        swarm.goal[:, k] = swarm.position[:, k]
        swarm.goal[0, k] += FAR if fault.kind == "go" else 0.0
        swarm.final[k] = fault.kind == "rest"
    elif fault.kind == "restart" and swarm.present[k]:
        swarm.restart(k)


def fly_both(setting: CheckedFlight) -> Mapping[str, Any]:
    """Fly a setting on the compiled core and on the specification, side by side."""
    scenario = make_scenario(setting.swarm)
    pair = Swarm(setting.swarm, scenario, shared_table=setting.shared), ReferenceSwarm(setting.swarm, scenario)
    pair[1].shares = setting.shared
    channel = Channel(setting.channel)
    faults: dict[int, list[Fault]] = {}
    for fault in setting.faults:
        faults.setdefault(fault.slot, []).append(fault)
    figures = {"slots": setting.slots, "frames": 0, "heard": 0, "collisions": 0}
    reasons = np.zeros(len(REASONS), dtype=np.int64)
    for slot in range(setting.slots):
        for fault in faults.get(slot, ()):
            for swarm in () if fault.kind == "restart" and pair[0].shared else pair:
                happen(fault, swarm)
        pair = _fly_slot(pair, channel, slot, figures)
        _compare(pair, slot, estimates=not setting.shared)
        reasons += np.bincount(pair[0].reason, minlength=len(REASONS))
    return {**figures, "reasons": {name: int(n) for name, n in zip(REASONS, reasons, strict=True) if n}}


def _fly_slot(
    pair: tuple[Swarm, ReferenceSwarm], channel: Channel, slot: int, figures: dict[str, int]
) -> tuple[Swarm, ReferenceSwarm]:
    compiled, plain = pair
    for swarm in pair:
        scenario = swarm.scenario
        scenario.advance(slot, swarm)
    senders, others = compiled.begin(slot), plain.begin(slot)
    if senders != others:
        raise Differs(f"slot {slot}: senders {senders}, the specification has {others}")
    frames = [compiled.frame(place) for place in senders]
    for place, data in zip(senders, frames, strict=True):
        if plain.frame(place) != data:
            text = f"frame {data.hex()}, the specification has {plain.frame(place).hex()}"
            raise Differs(f"slot {slot}, agent {place + 1}: {text}")
    ids = [compiled.ids[place] for place in senders]
    verdict = channel.arbitrate(slot, ids, [len(data) for data in frames], compiled.position)
    for swarm in pair:
        swarm.fly(slot)
    lost = verdict.received is not None and not verdict.received.all()
    if compiled.shared and (lost or len(senders) > 1):
        pair = compiled, plain = compiled.with_own_tables(slot), plain
        plain.shares = False
    if verdict.received is not None or len(senders) == 1:
        for row, data in enumerate(frames):
            mask = None if verdict.received is None or compiled.shared else verdict.received[row]
            if compiled.hear(slot, data, mask) != plain.hear(slot, data, mask):
                raise Differs(f"slot {slot}: only one of both takes {data.hex()} for a frame")
            figures["heard"] += 1
    for swarm in pair:
        swarm.end(slot)
    figures["frames"] += len(senders)
    figures["collisions"] += len(senders) > 1
    return pair


def _compare(pair: tuple[Swarm, ReferenceSwarm], slot: int, estimates: bool) -> None:
    compiled, plain = pair
    for name in (*_OF_AGENTS, *_OF_TABLES, *(_ESTIMATES if estimates else ())):
        ours, theirs = getattr(compiled, name), getattr(plain, name)
        if compiled.shared and name in _OF_TABLES:
            theirs = theirs[:1]
        if name == "priority":  # of those on whom the choice depended
            theirs = np.where(np.isnan(ours), ours, theirs)
        if ours.tobytes() != theirs.tobytes():
            at = (
                tuple(int(i) for i in np.argwhere(ours != theirs)[0])
                if (ours != theirs).any()
                else "the sign of a zero"
            )
            raise Differs(f"slot {slot}: {name} at {at}: {ours[at]!r}, the specification has {theirs[at]!r}")
    for name in ("malformed", "foreign"):
        if getattr(compiled, name) != getattr(plain, name):
            raise Differs(f"slot {slot}: {name}: {getattr(compiled, name)} and {getattr(plain, name)}")
    if compiled.config.policy == "lease":
        for place in range(len(compiled.ids)):
            if compiled.lease_status(place) != plain.lease_status(place):
                text = f"{compiled.lease_status(place)}, the specification has {plain.lease_status(place)}"
                raise Differs(f"slot {slot}, agent {place + 1}: {text}")
