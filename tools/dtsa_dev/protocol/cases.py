"""The runs behind the protocol's table. Each case is one row, and a pure function of its seed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_channel_sim import ChannelConfig

from .experiment import Event, Experiment, Outcome

# Columns: name -> settings of the swarm.
PROTOCOLS: dict[str, dict[str, Any]] = {
    "tdma": {"policy": "tdma"},
    "tdma+gossip": {"policy": "tdma", "frame": "extended"},
    "dtsa": {"policy": "dtsa"},
    "genie (age)": {"policy": "genie-age", "frame": "extended"},
    "genie (error)": {"policy": "genie-error", "frame": "extended"},
    "lease S=0": {"policy": "lease", "open_every": 0, "adoption": False},
    "lease": {"policy": "lease"},
}
LEASE = ("lease S=0", "lease")
GENIES = ("genie (age)", "genie (error)")
AGED = ("steady", "start", "stop-and-go")  # kinds of cases whose rows are ages
SEEDS, SLOTS = 8, 20_000
#: Columns that have fewer seeds and slots in rows of ages, because they take long.
FEWER: dict[str, tuple[int, int]] = {**dict.fromkeys(LEASE, (3, 6000)), **dict.fromkeys(GENIES, (2, SLOTS))}
# Plain DTSA computes N^2 priorities for every agent in every slot: with many agents and loss so much must do.
DTSA_SLOTS, DTSA_MANY = 2000, 20
GENIE_SLOTS = 4000  # the bounds are written in Python
MOVE = 1000  # slots, mean time of flight between two pauses


@dataclass(frozen=True, slots=True)
class Case:
    """One row: what the swarm does, what the channel does, and for how long."""

    name: str
    kind: str  # steady, stop-and-go, wake, join, death, jam, merge
    agents: int
    movers: int
    protocols: tuple[str, ...] = tuple(PROTOCOLS)
    loss: float = 0.0
    burst: float = 0.0  # slots, mean length
    warmup: int = 0  # slots
    pause: int = 0  # stop-and-go: slots of rest, on average
    wakers: int = 0
    target: str = ""  # what is asked of it, in words
    limits: dict[str, float] = field(
        default_factory=dict
    )  # column -> largest value allowed, as a multiple of TDMA's age

    def slots(self, protocol: str, slots: int) -> int:
        """Length of a run.

        :param protocol: its column.
        :param slots: what was asked for.
        """
        if protocol == "dtsa" and self.agents > DTSA_MANY and not self.shared(protocol):
            return min(slots, self.warmup + DTSA_SLOTS)
        return min(slots, self.warmup + GENIE_SLOTS) if protocol in GENIES else slots

    def effort(self, protocol: str) -> tuple[int, int]:
        """Number of seeds and slots of a column, unless others are asked for.

        :param protocol: the column.
        """
        return FEWER.get(protocol, (SEEDS, SLOTS)) if self.kind in AGED else (SEEDS, SLOTS)

    def shared(self, protocol: str) -> bool:
        """Whether one table may serve all agents: nothing is lost, and with plain DTSA all compute the same from it.

        :param protocol: its column.
        """
        return protocol == "dtsa" and not self.loss


LOSSES = (("no loss", 0.0), ("10 %", 0.1))


def cases() -> list[Case]:
    """All rows of the table."""
    return [*_steady_cases(), *_stop_and_go_cases(), *_start_cases(), *_newcomer_cases(), *_fault_cases()]


def _steady_cases() -> Iterator[Case]:
    channels = (*LOSSES[:1], ("5 %", 0.05), *LOSSES[1:], ("30 %", 0.3), ("10 % in bursts of 10", 0.1))
    sizes = ((12, 12, 1.0), (12, 6, 0.64), (12, 2, 0.2), (70, 70, 1.0), (70, 35, 0.64), (200, 10, 0.0805))
    for agents, movers, factor in sizes:
        for name, loss in channels:
            burst = 10.0 if "bursts" in name else 0.0
            too_long = ("genie (error)", *(("dtsa",) if loss else ()))
            protocols = tuple(p for p in PROTOCOLS if agents < 200 or p not in too_long)
            asked = 1.0 if burst else factor  # who hears nothing for ten slots knows old states whatever the protocol
            warmup = 10 * agents if agents > 12 else 600
            yield Case(
                f"{agents}/{movers} moving, {name}", "steady", agents, movers, protocols, loss, burst, warmup,
                target=f"lease at most {asked:g} x TDMA", limits=dict.fromkeys(LEASE, asked + 1e-09),
            )  # fmt: skip


def _stop_and_go_cases() -> Iterator[Case]:
    for pause, factor in ((300, 1.02), (1000, 1.02), (3000, 0.8)):
        for name, loss in LOSSES:
            yield Case(
                f"70 stop and go, pauses of {pause}, {name}", "stop-and-go", 70, 0, loss=loss, warmup=2000, pause=pause,
                target=f"lease at most {factor:g} x TDMA", limits={"lease": factor},
            )  # fmt: skip


def _start_cases() -> Iterator[Case]:
    for agents, movers in ((12, 6), (18, 8), (70, 34)):
        name = f"{agents}/{movers}, hoverers final, from the first slot on"
        yield Case(name, "start", agents, movers, target="lease below TDMA", limits={"lease": 1.0 - 1e-9})


def _newcomer_cases() -> Iterator[Case]:
    """Agents that wake, and agents that join."""
    for agents, movers, wakers in ((12, 2, 1), (70, 35, 1), (70, 35, 10)):
        yield Case(f"{wakers} of {agents} wake, {movers} moving", "wake", agents, movers, LEASE, wakers=wakers)
    for agents, movers in ((12, 12), (12, 6), (70, 70)):
        for name, loss in (*LOSSES, ("30 %", 0.3)):
            target = f"first frame within {7 * agents} slots"
            title = f"join of 1 of {agents}, {movers} moving, {name}"
            yield Case(title, "join", agents, movers, LEASE, loss, target=target)


def _fault_cases() -> Iterator[Case]:
    """Deaths, jams and merged partitions."""
    for agents, movers in ((12, 12), (12, 6), (70, 35)):
        target = f"turns used again within {max(1000, 30 * agents) + 10 * agents} slots"
        title = f"death of 1 of {agents}, {movers} moving, 10 %"
        yield Case(title, "death", agents, movers, ("lease",), 0.1, target=target)
    for agents, movers in ((12, 6), (70, 35)):
        title = f"jam of 300 slots, {agents}/{movers}, 5 %"
        yield Case(title, "jam", agents, movers, LEASE, 0.05, target="no collision afterwards")
    for agents, movers in ((12, 12), (12, 6), (70, 35)):
        title = f"merge of two halves, {agents}/{movers}, 10 %"
        yield Case(title, "merge", agents, movers, ("lease",), 0.1, target="at most 10 collisions afterwards")


@dataclass(frozen=True, slots=True)
class Result:
    """What one run of one case gave; plain numbers, ready for JSON."""

    case: str
    protocol: str
    seed: int
    slots: int
    age: float
    true_age: float
    collisions: int
    open_collisions: int
    adopted_collisions: int
    broken: int  # rules that the ledger saw broken
    first: tuple[int, ...] = ()  # slots to the first frame of those who woke or joined
    all: tuple[int, ...] = ()  # slots until all had heard them
    value: int = -1  # death: slots until the turns are used again; jam, merge: collisions afterwards


def run_case(case: Case, protocol: str, seed: int, slots: int) -> Result:
    """One run.

    :param case: the row.
    :param protocol: the column.
    :param seed: its seed.
    :param slots: slots that steady and stop-and-go runs last.
    """
    random = np.random.default_rng([seed, 4])
    ids = [int(k) + 1 for k in random.permutation(case.agents)]
    length = case.slots(protocol, slots)
    setup = _SETUPS[case.kind](case, ids, random, length)
    config = SwarmConfig(agents=case.agents, moving=0, avoider="none", seed=seed, **PROTOCOLS[protocol])
    channel = ChannelConfig(
        agents=case.agents,
        slot_ns=config.slot_ns,
        seed=seed,
        loss=case.loss,
        burst_length=case.burst,
        schedule=tuple(setup.pop("schedule", ())),
    )
    after, length = setup.pop("after", 0), setup.pop("slots", length)
    experiment = Experiment(config, channel, warmup=case.warmup, shared=case.shared(protocol), **setup)
    reused: list[int] = []

    def watch(run: Experiment, senders: tuple[int, ...]) -> None:
        slot = run.slot - 1
        if senders and slot >= after and slot % case.agents == ids[0] - 1 and ids[0] not in senders:
            reused.append(slot - after)

    out = experiment.run(length, watch if case.kind == "death" else None)
    return _result(case, protocol, seed, out, after, reused)


def _result(case: Case, protocol: str, seed: int, out: Outcome, after: int, reused: list[int]) -> Result:
    value = -1
    if case.kind in ("jam", "merge"):
        value = sum(slot >= after for slot in out.collision_slots)
    elif case.kind == "death":
        # Leases that the dead agent gave away itself end with its anchor; what counts is what comes after that.
        late = [slots for slots in reused if slots > 2 * 5 * case.agents]
        value = late[0] if late else -1
    ledger = out.ledger
    return Result(
        case.name, protocol, seed, out.slots, out.age, out.true_age, out.collisions,
        ledger.open_collisions if ledger else 0, ledger.adopted_collisions if ledger else 0,
        len(ledger.broken) if ledger else 0,
        tuple(wait.to_first for wait in out.waits), tuple(wait.to_all for wait in out.waits), value,
    )  # fmt: skip


def _steady(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    return {"movers": ids[: case.movers]}


def _start(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    return {"movers": ids[: case.movers], "slots": min(slots, 600)}


def _stop_and_go(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    movers: list[int] = []
    events: list[Event] = []
    for agent in ids:
        slot, flies = -int(random.integers(0, MOVE + case.pause)), True
        while slot < slots:
            length = int(random.uniform(0.6, 1.4) * (MOVE if flies else case.pause))
            if slot > 0:
                events.append(Event(slot, "go" if flies else "stop", agent))
            elif flies and slot + length > 0:
                movers.append(agent)
            slot, flies = slot + length, not flies
    return {"movers": movers, "events": events, "final": False}


def _wake(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    when = 3000 + int(random.integers(0, 5 * case.agents))
    woken: Iterable[int] = ids[case.movers : case.movers + case.wakers]
    return {
        "movers": ids[: case.movers],
        "events": [Event(when, "go", agent) for agent in woken],
        "final": False,
        "slots": when + 8 * case.agents,
    }


def _join(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    when = 2500 + int(random.integers(0, 5 * case.agents))
    return {
        "movers": ids[: case.movers],
        "absent": ids[:1],
        "events": [Event(when, "join", ids[0])],
        "slots": when + 40 * case.agents,
    }


def _death(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    when = 2000 + int(random.integers(0, 5 * case.agents))
    return {
        "movers": ids[: case.movers],
        "events": [Event(when, "die", ids[0])],
        "after": when,
        "slots": when + max(1000, 30 * case.agents) + 12 * case.agents,
    }


def _jam(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    return {
        "movers": ids[: case.movers],
        "schedule": [{"slot": 2000, "until": 2300, "jam": True}],
        "after": 2300,
        "slots": 5000,
    }


def _merge(case: Case, ids: list[int], random: np.random.Generator, slots: int) -> dict[str, Any]:
    half, after = case.agents // 2, 2000 + 3000
    groups = [ids[:half], ids[half:]]
    movers = [int(k) + 1 for k in random.permutation(case.agents)[: case.movers]]
    return {
        "movers": movers,
        "schedule": [{"slot": 2000, "until": after, "partition": groups}],
        "after": after,
        "slots": after + 40 * case.agents,
    }


_SETUPS = {
    "steady": _steady,
    "start": _start,
    "stop-and-go": _stop_and_go,
    "wake": _wake,
    "join": _join,
    "death": _death,
    "jam": _jam,
    "merge": _merge,
}
