"""Integration: the extent of the field: what frames and gossip can say, and what is refused because they cannot."""

from __future__ import annotations

import numpy as np
import pytest
from frame_helpers import encode_extended
from hypothesis import given, settings
from hypothesis import strategies as st

from dtsa_agent.core import ConfigError, Frame, Scenario, Swarm, SwarmConfig, decode_frame, encode_frame, make_scenario
from dtsa_agent.core.frame import EXTENT_M, ExtendedFrame, Gossip, decode_extended, position_step
from dtsa_agent.core.settings.scenario import FIELD_MARGIN_M

extents = st.one_of(st.just(EXTENT_M), st.floats(1.0, 10_000.0))
share = st.floats(-1.0, 1.0)
shares = st.tuples(share, share, share)
slow = st.tuples(*[st.floats(-10.0, 10.0)] * 3)


def scaled(place: tuple[float, float, float], extent: float) -> tuple[float, float, float]:
    return place[0] * extent, place[1] * extent, place[2] * extent


@settings(max_examples=300, deadline=None)
@given(extents, shares, shares, slow)
def test_what_lies_within_the_extent_comes_back_to_half_a_step(
    extent: float, place: tuple[float, float, float], near: tuple[float, float, float], v: tuple[float, float, float]
) -> None:
    step = position_step(extent)
    half = step * (0.5 + 1e-6)
    own = Frame(3, 70, 1, scaled(place, extent), v)
    assert np.abs(np.subtract(decode_frame(encode_frame(own, extent), extent).position, own.position)).max() <= half
    # Gossip: within half the extent, a step and a half less so that nothing is near the codec's limit.
    item = Gossip(5, 2, True, scaled(near, extent / 2 - 4 * step), v)
    frame = ExtendedFrame(own, gossip=(item,))
    heard = decode_extended(encode_extended(frame, extent), extent)
    assert np.abs(np.subtract(heard.own.position, own.position)).max() <= half
    assert np.abs(np.subtract(heard.gossip[0].position, item.position)).max() <= 2 * half
    assert np.abs(np.subtract(heard.gossip[0].velocity, v)).max() <= 0.01 + 1e-9


def far_swarm(extent: float, **more: object) -> Swarm:
    given: dict[str, object] = {"agents": 6, "policy": "lease", "axis_x_m": 50.0, "seed": 3, "extent_m": extent, **more}
    return Swarm(SwarmConfig(**given))  # type: ignore[arg-type]


@pytest.mark.parametrize("extent", [EXTENT_M, 120.0])
@pytest.mark.parametrize("policy", ["lease", "tdma"])
def test_gossip_never_replaces_a_right_state_by_a_wrong_one(extent: float, policy: str) -> None:
    swarm = far_swarm(extent, policy=policy, frame="extended")
    random = np.random.default_rng(1)
    told = 0
    states: dict[tuple[int, int], np.ndarray] = {}
    for slot in range(1500):
        swarm.scenario.advance(slot, swarm)
        senders = swarm.begin(slot)
        for index in senders:
            states[index, slot] = swarm.position[:, index].copy()
            told += len(decode_extended(swarm.frame(index), extent).gossip)
        swarm.fly(slot)
        for index in senders:
            swarm.hear(slot, swarm.frame(index), (random.random(6) < 0.7).astype(np.uint8))
        swarm.end(slot)
        for table in range(6):
            for agent in range(6):
                sampled = int(swarm.sent_slot[table, agent])
                if sampled >= 0 and swarm.in_ap[table, agent]:
                    error = np.abs(swarm.sent_position[table, :, agent] - states[agent, sampled]).max()
                    assert error <= position_step(extent) * 1.501  # half a step of the frame, half of gossip
    assert told > 0


def test_gossip_at_the_codecs_limit_is_not_believed() -> None:
    own = Frame(2, 1, 1, (1.0, 2.0, 0.0), (0.0, 0.0, 0.0))
    for bad in ((40.0, 0.0, 0.0), (0.0, -33.0, 0.0)):
        told = (Gossip(3, 1, True, bad, (0.0, 0.0, 0.0)), Gossip(4, 1, True, (5.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        swarm = far_swarm(EXTENT_M)
        assert swarm.hear(1, encode_extended(ExtendedFrame(own, gossip=told)))
        assert swarm.sent_slot[0, 2] == -1
        assert swarm.sent_slot[0, 3] == 0
        assert swarm.sent_position[0, 0, 3] == pytest.approx(5.0, abs=0.002)


@pytest.mark.parametrize(("settings", "reach"), [
    ({"axis_x_m": 64.0, "jitter_m": 0.0}, 64.0),
    ({"axis_x_m": 10.0, "shape": "ellipsoid", "axis_z_m": 80.0, "jitter_m": 0.0}, 75.0),
    ({"agents": 600, "jitter_m": 0.0}, 0.9 * 600 / (2 * np.pi)),
    ({"agents": 4, "axis_x_m": 90.0, "scenario": "waypoints"}, 90.0),
    ({"agents": 1000, "moving": 100, "scenario": "streams"}, 900 / (2 * np.pi)),
    ({"agents": 1, "moving": 1, "axis_x_m": 63.0, "jitter_m": 0.0}, 63.9),
])  # fmt: skip
def test_what_does_not_fit_is_refused_with_the_extent_that_does(settings: dict[str, object], reach: float) -> None:
    config = SwarmConfig(**settings)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"extent_m: got 65\.534; allowed: .* m or more: starts and goals") as caught:
        make_scenario(config)
    enough = float(caught.value.allowed.split()[0])
    assert enough == pytest.approx(reach + FIELD_MARGIN_M, rel=0.1)
    roomy, tight = (SwarmConfig(**{**config.to_dict(), "extent_m": extent}) for extent in (enough, enough - 0.2))
    assert np.abs(make_scenario(roomy).start).max() <= enough - FIELD_MARGIN_M
    with pytest.raises(ConfigError, match="extent_m"):
        make_scenario(tight)


def test_a_scenario_of_ones_own_has_to_fit_as_well() -> None:
    places = np.array([[0.0, 70.0], [0.0, 0.0], [0.0, 0.0]])
    scenario = Scenario(places, places.copy(), np.zeros(2, dtype=np.bool_))
    with pytest.raises(ConfigError, match=r"72 m or more"):
        Swarm(SwarmConfig(agents=2), scenario)
    assert Swarm(SwarmConfig(agents=2, extent_m=72.0), scenario).position[0, 1] == 70.0
    for wrong in (np.nan, np.inf):
        nowhere = Scenario(places, np.full((3, 2), wrong), scenario.moving)
        with pytest.raises(ConfigError, match=r"scenario: got .*finite"):
            Swarm(SwarmConfig(agents=2), nowhere)
