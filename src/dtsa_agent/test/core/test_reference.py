"""The compiled core computes what the specification says, bit for bit."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frame_helpers import encode_extended
from hypothesis import example, given, settings
from hypothesis import strategies as st
from kernel_parts import priority, select

from dtsa_agent.core import REASONS, Frame, Swarm, SwarmConfig, decode_frame, encode_frame
from dtsa_agent.core.errors import LocalProtocolError, RemoteProtocolError
from dtsa_agent.core.frame import TAG_LENGTH, ExtendedFrame, Gossip, decode_extended, position_step
from dtsa_agent.core.kernel import ffi, lib
from dtsa_agent.core.reference import arithmetic, frame, policies
from dtsa_agent.core.reference.frame import tag
from dtsa_agent.core.reference.stepper import ReferenceSwarm

EXTENTS = (65.534, 20.0, 1.0, 9999.0)

numbers = st.floats(-80, 80) | st.floats() | st.sampled_from([0.0, -0.0, 0.001, 0.003, 1e300, -math.inf])
vectors = st.tuples(numbers, numbers, numbers)
odd_ids, odd_c_r = st.sampled_from([0, 255, 70000]), st.sampled_from([-1, 256])
ids, slots, c_r = st.integers(1, 254) | odd_ids, st.integers(0, 2**32 - 1), st.integers(0, 255) | odd_c_r
frames = st.builds(Frame, ids, slots, c_r, vectors, vectors, st.none() | vectors)
ages = st.integers(1, 127) | st.sampled_from([0, 128])
gossips = st.builds(Gossip, st.integers(1, 254) | st.just(255), ages, st.booleans(), vectors, vectors)
lessees = st.dictionaries(st.integers(1, 24) | st.just(25), st.integers(1, 255) | st.just(0), max_size=9)
extended = st.builds(
    ExtendedFrame, frames, st.integers(0, 253) | st.sampled_from([-1, 254]), st.booleans(), st.booleans(),
    st.lists(gossips, max_size=3).map(tuple), st.binary(max_size=34), lessees.map(lambda d: tuple(sorted(d.items()))),
)  # fmt: skip


def outcome(action: Callable[[], Any]) -> Any:
    """What comes of something: a value in words (NaN equals NaN), or its refusal."""
    try:
        return repr(action())
    except RemoteProtocolError as error:
        return str(error)
    except LocalProtocolError:
        return "not encodable"


@settings(max_examples=150)
@given(frames, st.sampled_from(EXTENTS))
def test_both_say_the_same(said: Frame, extent: float) -> None:
    step = position_step(extent)
    assert outcome(lambda: encode_frame(said, extent)) == outcome(lambda: frame.encode(said, step))


@settings(max_examples=150)
@given(extended, st.sampled_from(EXTENTS))
def test_both_say_the_same_about_others(said: ExtendedFrame, extent: float) -> None:
    step = position_step(extent)
    assert outcome(lambda: encode_extended(said, extent)) == outcome(lambda: frame.encode_extended(said, step))


bodies = st.binary(max_size=8) | st.binary(min_size=18, max_size=23) | st.binary(min_size=54, max_size=57)
heads = st.sampled_from([b"", b"\x10", b"\x11", b"\x12", b"\x13", b"\x22"])
# Heads that are right, so that sections decide.
sections = st.tuples(st.integers(0, 7), st.binary(min_size=52, max_size=52))
data_of = st.builds(bytes.__add__, heads, bodies)
data_of |= sections.map(lambda given: b"\x12\x05\x03" + bytes([given[0] << 2]) + given[1])


@settings(max_examples=600)
@given(data_of)
@example(b"\x12\1\2" + bytes(53))
def test_both_understand_the_same(data: bytes) -> None:
    step = position_step(EXTENTS[0])
    assert outcome(lambda: decode_frame(data)) == outcome(lambda: frame.decode(data, step))
    assert outcome(lambda: decode_extended(data)) == outcome(lambda: frame.decode_extended(data, step))


def test_the_arcsine_is_one() -> None:
    for x in np.linspace(-1, 1, 2001):
        assert arithmetic.arcsin(float(x)) == pytest.approx(math.asin(x), abs=3e-16)


@settings(max_examples=80)
@given(st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_priorities_have_the_same_bits(count: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    position, velocity = random.normal(size=(2, count, 3))
    velocity[random.random(count) < 0.2] = 0
    position[random.random(count) < 0.1] = 1.0
    compiled = priority(position, velocity, 0.01)
    plain = policies.priorities([tuple(p) for p in position.tolist()], [tuple(v) for v in velocity.tolist()], 0.01)
    assert compiled.tobytes() == np.array(plain).tobytes()


@settings(max_examples=200)
@given(st.integers(1, 20), st.integers(0, 2**32 - 1), st.sampled_from(["candidates", "pairwise"]))
def test_the_same_is_selected_for_the_same_reason(count: int, seed: int, reading: str) -> None:
    random = np.random.default_rng(seed)
    g = random.choice([0.0, 0.1, 0.3, 0.5, 1.0], count) * random.choice([0.0, 1.0, random.random()])
    h, in_ap, epsilon = random.integers(0, 5, count), random.random(count) < 0.7, float(random.choice([0, 0.5, 1]))
    index, close, reason = select(g, h, in_ap, epsilon, reading)
    plain = policies.select(g.tolist(), h.tolist(), in_ap.tolist(), epsilon, reading)
    assert (index, REASONS[reason]) == (plain.index, plain.reason)
    if reading == "candidates" and plain.reason in ("tie", "priority"):
        members = np.flatnonzero(in_ap).tolist()
        assert np.flatnonzero(close).tolist() == policies.candidates(g.tolist(), members, epsilon)


TABLES = ("tdma", "dtsa", "age", "aloha", "lease")


@settings(max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_random_tables_lead_to_the_same_decisions(seed: int) -> None:
    """Agents that heard anything, in any order: tables, digests, decisions, frames."""
    random = np.random.default_rng(seed)
    agents = int(random.integers(2, 25))
    config = SwarmConfig(
        agents=agents, policy=str(random.choice(TABLES)), estimator=str(random.choice(["linear", "intent"])),
        selection=str(random.choice(["candidates", "pairwise"])), seed=seed, epsilon=float(random.random()),
        age_cap=float(random.choice([0.0, 1.5, 4.0])), return_every=int(random.choice([0, 3, 20])), moving=0,
        boot_round=False, frame=str(random.choice(["auto", "extended"])), targets_known=bool(random.random() < 0.5),
    )  # fmt: skip
    me = int(random.integers(1, agents + 1))
    pair = Swarm(config, local=[me]), ReferenceSwarm(config, local=[me])
    slot = int(random.integers(0, 3))
    for _ in range(int(random.integers(1, 12))):
        heard, place = random_frame(random, agents, slot, config.extended), random.uniform(-3, 3, 3)
        for swarm in pair:
            swarm.position[:, 0] = place
            swarm.begin(slot)
            swarm.hear(slot, heard)
            swarm.end(slot)
        slot += int(random.integers(1, 20))
    for swarm in pair:
        swarm.begin(slot)
    compiled, plain = pair
    for name in ("chosen", "reason", "score", "digest", "counter", "sent_slot", "in_ap", "sent_position"):
        assert getattr(compiled, name).tobytes() == getattr(plain, name).tobytes(), name
    known = ~np.isnan(compiled.priority)  # the others did not matter
    assert compiled.priority[known].tobytes() == plain.priority[known].tobytes()
    assert compiled.frame(0) == plain.frame(0)
    assert (compiled.malformed, compiled.foreign) == (plain.malformed, plain.foreign)


@settings(max_examples=300)
@given(st.integers(2, 24), st.integers(0, 2**32 - 1))
def test_who_is_most_urgent_is_found_without_all_priorities(count: int, seed: int) -> None:
    """Bounds say who matters: in crowds, symmetry, equal places, with epsilon at the edge of somebody's g."""
    random = np.random.default_rng(seed)
    position, velocity = random.normal(size=(2, 3, count)) * random.choice([1e-3, 1.0, 30.0])
    if random.random() < 0.3:  # mirrored: all g twice
        position, velocity = ((x - x[:, ::-1]) / 2 for x in (position, velocity))
    if random.random() < 0.3:  # head on to the middle, where the arccosine is steep
        velocity = -0.5 * position
    velocity[:, random.random(count) < random.choice([0, 0, 0.4])] = 0
    position[:, random.random(count) < random.choice([0, 0, 0.2])] = 1.0
    g = policies.priorities(
        [tuple(p) for p in position.T.tolist()], [tuple(v) for v in velocity.T.tolist()], 0.01
    )  # fmt: skip
    edge = 1 - random.choice(g) / max(g) if max(g) > 0 else 0.5
    epsilon = float(random.choice([0, 0.5, 1, np.clip(edge + random.choice([-1e-7, 0, 1e-7]), 0, 1)]))
    swarm = Swarm(SwarmConfig(agents=count, policy="dtsa", moving=0, boot_round=False, age_cap=0, epsilon=epsilon))
    in_ap, last = random.random(count) < 0.8, random.integers(0, 5, count)
    swarm.sent_position[:], swarm.sent_velocity[:], swarm.in_ap[:], swarm.last_turn[:] = position, velocity, in_ap, last
    swarm.decide(8)  # nobody was heard: states are as they are
    plain = policies.select(g, (7 - last).tolist(), in_ap.tolist(), epsilon)
    assert (int(swarm.chosen[0]) - 1, REASONS[swarm.reason[0]], swarm.score[0]) == (plain.index, plain.reason, plain.g)
    known = ~np.isnan(swarm.priority[0]) & in_ap.any()
    assert swarm.priority[0][known].tobytes() == np.array(g)[known].tobytes()


def random_frame(random: np.random.Generator, agents: int, slot: int, whole: bool) -> bytes:
    """A frame of somebody for a slot or the one before; now and then one of nobody, of another time, or none."""
    sender = int(random.integers(1, agents + 2)) if random.random() < 0.7 else slot % agents + 1
    sent = max(0, slot - int(random.choice([0, 0, 0, 1, 2])))
    if random.random() < 0.05:
        return random.bytes(int(random.integers(0, 60)))
    p, v, c = (tuple(random.uniform(-5, 5, 3).tolist()) for _ in range(3))
    own = Frame(sender, sent, int(random.integers(0, 2)), p, v, c if whole or random.random() < 0.5 else None)
    if not whole:
        return encode_frame(own)
    leases = bytes(random.integers(0, agents + 1, 11).tolist()) if sent % agents == sender - 1 else b""
    others = tuple(
        Gossip(int(random.integers(1, agents + 1)), int(random.integers(1, 20)), bool(random.random() < 0.5), v, c)
        for _ in range(int(random.integers(0, 3)))
    )
    c_s, probation = int(random.choice([0, 0, 1, agents - 1])), bool(random.random() < 0.2)
    return encode_extended(ExtendedFrame(own, c_s, bool(random.random() < 0.05), probation, others[:2], leases))


@given(st.binary(min_size=16, max_size=32), st.integers(0, 2**64 - 1), st.integers(0, 2**40), st.binary(max_size=300))
def test_frames_get_the_same_tags(key: bytes, session: int, slot: int, data: bytes) -> None:
    said = ffi.new("uint8_t[]", TAG_LENGTH)
    lib.dtsa_tag(key, len(key), session, slot, data, len(data), said)
    assert bytes(said) == tag(key, session, slot, data)
    sealed = data + bytes(said)
    assert lib.dtsa_open(key, len(key), session, slot, 0, sealed, len(sealed)) == len(data)


@pytest.mark.parametrize("estimator", ["hold", "linear", "intent"])
def test_a_state_from_the_next_slot_is_estimated_within_its_memory(estimator: str) -> None:
    """A clock that is ahead: its frame is heard before the receiver's slot is over. Found by fuzzing."""
    config = SwarmConfig(agents=3, estimator=estimator, policy="tdma")
    swarms = Swarm(config), ReferenceSwarm(config)
    for swarm in swarms:
        swarm.velocity[:] = 0.5
        swarm.begin(0)
        swarm.command[:] = 1.0
        swarm.sends[:] = 1
        swarm.emit(7)
        for place in range(3):
            assert swarm.hear(7, swarm.frame(place))
        for slot in (7, 6, 3):
            swarm.estimate(slot)
    compiled, plain = swarms
    assert np.array_equal(compiled.estimate_position, plain.estimate_position)
    assert np.array_equal(compiled.estimate_velocity, plain.estimate_velocity)
    assert np.abs(compiled.estimate_velocity[0, :, 1]).max() <= 0.51  # nothing has decayed yet


CASES = json.loads((Path(__file__).parents[1] / "golden" / "priority.json").read_text())["cases"]


@pytest.mark.parametrize("case", CASES, ids=lambda c: f"n{c['n']}")
def test_golden_values(case: dict) -> None:
    g = priority(case["position_m"], case["velocity_mps"], case["slot_s"])
    np.testing.assert_allclose(g, case["priority"], rtol=1e-12, atol=1e-12)
    index, candidates, reason = select(g, case["counter"], case["in_ap"], case["epsilon"])
    assert index == case["selected_index"]
    assert np.flatnonzero(candidates).tolist() == case["candidates"]
    assert REASONS[reason] == ("tie" if len(case["candidates"]) > 1 else "priority")


@pytest.mark.parametrize("angle", np.linspace(0, np.pi, 33))
def test_the_angle_counts_over_its_whole_range(angle: float) -> None:
    """Agent 1 at rest in the origin, agent 2 at 2 m flies at 1 m/s at an angle to the line of sight."""
    g = priority([[0, 0, 0], [2, 0, 0]], [[0, 0, 0], [-math.cos(angle), math.sin(angle), 0]], 0.1)
    assert g[0] == 0.0
    assert g[1] == pytest.approx(0.1 / 2 * (math.pi - angle) / math.pi, abs=1e-9)


def test_equal_velocities_and_equal_places_add_nothing() -> None:
    assert priority([[0, 0, 0], [1, 0, 0]], [[1, 2, 3], [1, 2, 3]], 0.01).tolist() == [0, 0]
    assert priority([[0, 0, 0], [0, 0, 0]], [[1, 0, 0], [-1, 0, 0]], 0.01).tolist() == [0, 0]
    assert priority([[5, 5, 5]], [[1, 0, 0]], 0.01).tolist() == [0]


def test_order_of_ids_does_not_matter_to_the_default_reading() -> None:
    random = np.random.default_rng(3)
    for _ in range(200):
        g, h = random.random(9), random.permutation(9)
        order = random.permutation(9)
        a, _, _ = select(g, h, np.ones(9))
        b, _, _ = select(g[order], h[order], np.ones(9))
        assert order[b] == a


def test_the_literal_reading_depends_on_the_order_of_ids() -> None:
    """Why it is not the default: three values, each within epsilon of the next, are not transitive."""
    g, h = np.array([1.0, 0.6, 0.31]), np.array([0, 1, 2])
    winners = set()
    for order in ([0, 1, 2], [2, 1, 0]):
        index, _, _ = select(g[order], h[order], np.ones(3), 0.5, "pairwise")
        winners.add(order[index])
    assert len(winners) == 2


def test_special_cases_of_the_selection() -> None:
    everyone = np.ones(3)
    assert select([0, 0, 0], [1, 5, 5], everyone)[0::2] == (1, REASONS.index("oldest"))
    assert select([3, 2, 1], [0, 0, 0], np.zeros(3))[0::2] == (-1, REASONS.index("nobody"))
    assert select([9, 1, 1], [0, 9, 9], everyone)[0::2] == (0, REASONS.index("priority"))
    assert select([9, 8, 1], [0, 9, 9], everyone)[0::2] == (1, REASONS.index("tie"))
    assert select([9, 8, 1], [0, 9, 9], np.array([0, 0, 1]))[0] == 2
    assert select([9, 8, 1], [5, 5, 5], everyone)[0] == 0
