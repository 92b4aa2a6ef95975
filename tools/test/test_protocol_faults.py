"""Integration: no pattern of loss, death, restart, partition or jam makes two agents send in one slot."""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
from dtsa_dev.protocol.experiment import Experiment, FlightEvent, random_schedule
from frame_helpers import encode_extended

from dtsa_agent.core import Frame, SwarmConfig, encode_frame
from dtsa_agent.core.frame import ExtendedFrame
from dtsa_bench.log.rules import PLAIN, GrantLedger, RuleChecker
from dtsa_bench.log.verify.result import Mismatch, Result
from dtsa_channel_sim import ChannelConfig

CHUNKS, RUNS, SLOTS = 11, 10, 2800  # 308 000 slots
NEVER = 2**62  # slot
KINDS = ("go", "stop", "go", "stop", "die", "join", "join", "restart", "leave")


def _events(random: np.random.Generator, agents: int, slots: int) -> list[FlightEvent]:
    events = []
    for agent in range(1, agents + 1):
        slot, pace = 0, (30, 200, 800, 2000)[random.integers(0, 4)]
        while slot < slots:
            slot += int(random.integers(1, pace))
            events.append(FlightEvent(slot, KINDS[random.integers(0, len(KINDS))], agent))
    return events


def random_misfortune(seed: int, slots: int, **settings: Any) -> Experiment:
    """Everything that can go wrong, at random, in a run that lasts so many slots; settings: of the swarm."""
    random = np.random.default_rng(seed)
    agents = int(random.integers(2, 17))
    config = SwarmConfig(
        agents=agents, policy="lease", avoider="none", seed=seed, anchor_every=int(random.integers(1, 8)),
        depth_rate=float(random.choice([0.1, 1.0, 5.0])), lease_share=float(random.choice([0.75, 1.0])), **settings,
    )  # fmt: skip
    loss = float(random.choice([0.0, 0.05, 0.2, 0.5]))
    matrix: tuple[tuple[float, ...], ...] = ()
    if random.random() < 0.3:
        links = random.uniform(0.0, 0.6, (agents, agents))
        np.fill_diagonal(links, 0.0)
        matrix = tuple(tuple(float(x) for x in row) for row in links)
    channel = ChannelConfig(
        agents=agents, slot_ns=config.slot_ns, seed=seed, loss=loss, loss_matrix=matrix,
        burst_length=float(random.choice([0.0, 10.0, 20.0])) if loss else 0.0,
        range_m=float(random.choice([0.0, 0.0, 8.0])), schedule=tuple(random_schedule(random, agents, slots)),
    )  # fmt: skip
    movers = tuple(k for k in range(1, agents + 1) if random.random() < 0.5)
    events = _events(random, agents, slots)
    # Ages are not measured.
    return Experiment(config, channel, movers=movers, events=events, final=bool(random.random() < 0.5), warmup=NEVER)


@pytest.mark.parametrize("chunk", range(CHUNKS))
def test_without_open_turns_and_adoption_never_two_senders(chunk: int) -> None:
    leased = 0
    for seed in range(chunk * RUNS, (chunk + 1) * RUNS):
        out = random_misfortune(seed, SLOTS, open_every=0, adoption=False).run(SLOTS)
        assert out.ledger is not None
        assert (out.collisions, out.ledger.broken) == (0, []), seed
        leased += out.ledger.leased_slots
    assert leased > 100  # otherwise the runs would show nothing


@pytest.mark.parametrize("chunk", range(3))
def test_by_default_two_senders_only_in_turns_that_are_counted(chunk: int) -> None:
    for seed in range(chunk * RUNS, (chunk + 1) * RUNS):
        out = random_misfortune(seed + 5000, SLOTS).run(SLOTS)
        assert out.ledger is not None
        assert out.ledger.broken == [], seed
        book = out.ledger
        known = book.collisions.total() - book.collisions[PLAIN]
        assert out.collisions == known


def run(
    agents: int, movers: int, schedule: list[dict[str, object]], slots: int, loss: float, **settings: object
) -> Experiment:
    config = SwarmConfig(agents=agents, policy="lease", avoider="none", **settings)  # type: ignore[arg-type]
    channel = ChannelConfig(agents=agents, slot_ns=config.slot_ns, seed=3, loss=loss, schedule=tuple(schedule))  # type: ignore[arg-type]
    experiment = Experiment(config, channel, movers=range(1, movers + 1))
    experiment.run(slots)
    return experiment


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize(("agents", "movers"), [(12, 12), (12, 6), (24, 8)])
def test_a_jam_of_all_frames_causes_no_collision(agents: int, movers: int, loss: float) -> None:
    done = run(agents, movers, [{"slot": 1500, "until": 1800, "jam": True}], 4000, loss)
    assert done.outcome.collisions == 0


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize(("agents", "movers"), [(12, 12), (12, 6), (24, 8)])
def test_groups_that_meet_again(agents: int, movers: int, loss: float) -> None:
    """Each side thought the other dead and used its turns."""
    groups = [list(range(1, agents, 2)), list(range(2, agents + 1, 2))]
    merge = 1000 + 3000
    done = run(agents, movers, [{"slot": 1000, "until": merge, "partition": groups}], merge + 12 * 5 * agents, loss)
    apart = [slot for slot in done.outcome.collision_slots if slot < merge]
    after = [slot for slot in done.outcome.collision_slots if slot >= merge]
    assert len(apart) > 100  # two in the air, but nobody hears both
    assert len(after) <= 10
    assert all(slot < merge + 5 * agents for slot in after)
    assert not any(done.swarm.lease_status(k)["probation"] for k in range(agents))
    assert done.outcome.ledger is not None
    assert done.outcome.ledger.broken == []


def test_the_ledger_sees_broken_rules() -> None:
    """The referee itself: each rule broken once."""
    zero = (0.0, 0.0, 0.0)

    def frame(sender: int, slot: int, leases: bytes = b"") -> bytes:
        return encode_extended(ExtendedFrame(Frame(sender, slot, 1, zero, zero, zero), leases=leases))

    def judged(slots: dict[int, dict[int, bytes]]) -> GrantLedger:
        ledger = GrantLedger(4, 5)
        for slot, frames in slots.items():
            ledger.check_slot(slot, frames)
        return ledger

    assert judged({0: {1: frame(1, 0)}, 1: {2: frame(2, 1)}}).broken == []
    assert "agent 3 sends in a turn of 2" in judged({1: {3: frame(3, 1)}}).broken[0]
    assert "gives turns away in another agent's turn" in judged({1: {3: frame(3, 1, b"\1" + bytes(10))}}).broken[1]
    given = {4: {1: frame(1, 4, b"\3" + bytes(10))}}
    assert judged({**given, 8: {3: frame(3, 8)}}).broken == []
    assert "owner 1 sends in a turn that it gave" in judged({**given, 8: {1: frame(1, 8)}}).broken[0]
    both = judged({**given, 8: {1: frame(1, 8), 3: frame(3, 8)}})
    assert both.collisions[PLAIN] == 1
    again = {4: {1: frame(1, 4, b"\0\2" + bytes(9))}, 8: {1: frame(1, 8, b"\3" + bytes(10))}}
    assert "a second time" in judged(again).broken[0]
    opened = judged({4: {1: frame(1, 4, b"\xff" + bytes(10))}, 8: {2: frame(2, 8), 3: frame(3, 8)}})
    assert (opened.broken, opened.collisions["open"]) == ([], 1)
    ledger = GrantLedger(4, 5, 10)
    ledger.check_slot(20, {1: b"forged", 3: frame(3, 20)})  # an anchor, no main one
    assert any("agent 1 sent a frame that is none" in text for text in ledger.broken)
    book = GrantLedger(3, 3)
    own = Frame(1, 3, 1, (0.0,) * 3, (0.0,) * 3, (0.0,) * 3)
    book.note_frame(3, 1, encode_extended(ExtendedFrame(own, c_s=1, probation=True)))
    assert book.broken == ["slot 3: agent 1 claims others dead in probation, or as it leaves"]
    book = GrantLedger(3, 3)
    book.note_frame(0, 1, encode_extended(ExtendedFrame(dataclasses.replace(own, slot=0), leases=bytes([0, 2]))))
    [(turn, given)] = book.turns.items()
    [(_, lessee)] = given.given
    own = dataclasses.replace(own, sender=lessee, slot=turn - 2)
    book.note_frame(turn - 2, lessee, encode_extended(ExtendedFrame(own, relay=((2, 1),))))
    assert book.broken == [f"slot {turn - 2}: agent 2 hands turn {turn} on to 1"]


def test_waits_are_measured() -> None:
    config = SwarmConfig(agents=12, policy="lease", avoider="none")
    out = Experiment(config, movers=range(1, 13), absent=[5], events=[FlightEvent(1500, "join", 5)]).run(2000)
    (wait,) = out.waits
    assert (wait.agent, wait.kind, wait.since) == (5, "join", 1500)
    assert 0 <= wait.to_first <= wait.to_all <= 7 * 12


def test_frames_against_the_rules_are_found_and_turns_of_unrecorded_frames_not_judged() -> None:
    """By what verify, merge and sniff share; a policy without turns of its own is not judged."""
    config = SwarmConfig(agents=3, policy="tdma")
    state = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    for policy, raises in (("tdma", True), ("aloha", False)):
        judge = RuleChecker(dataclasses.replace(config, policy=policy))
        for slot, sender in enumerate((1, 2, 1)):
            judge.check_slot(slot, {sender: encode_frame(Frame(sender, slot, 1, *state))})
        result = Result("bag", "lockstep")
        with pytest.raises(Mismatch, match="slot 2: agent 1 sends in a turn of 3") if raises else nullcontext():
            result.note_rules(judge)
    # A frame that is made too late is not sent; its agent keeps to what it gave away in it all the same.
    config = SwarmConfig(agents=3, policy="lease", anchor_every=3, open_every=0, adoption=False)
    state = ((0.0,) * 3, (0.0,) * 3, (0.0,) * 3)
    reach = (config.main_every + 2) * config.agents
    for late, later, broken, unchecked in (((), 0, 1, 0), ((2,), 0, 0, 1), ((2,), reach, 1, 0)):
        judge = RuleChecker(config)
        judge.check_slot(0, {1: encode_extended(ExtendedFrame(Frame(1, 0, 1, *state)))})
        judge.check_slot(1, {}, unrecorded=late)
        wrong = 3 + later  # a turn of agent 1
        judge.check_slot(wrong, {2: encode_extended(ExtendedFrame(Frame(2, wrong, 1, *state)))})
        assert (len(judge.broken), judge.unchecked) == (broken, unchecked)
