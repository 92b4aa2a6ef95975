"""Integration: swarms with keys, plug-ins and vehicles elsewhere: what these do not change is the same, bit for bit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from slot_helpers import one_slot

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.authentication import TAG_LENGTH, Authenticator
from dtsa_agent.core.plugins import PluginSwarm
from dtsa_agent.core.settings.flight_models import VehicleParams
from dtsa_agent.crazyflie.node.agents_node import steer, ways_apart
from dtsa_agent.ros.odometry_vehicle import HOLD_GAIN, HOLD_MPS

KEY = bytes(range(16))
DECIDED, FLOWN = ("chosen", "reason", "digest", "score"), ("position", "velocity", "command", "track")
ARRAYS = (*FLOWN, *DECIDED, "sent_position", "sent_slot")


def sealed(swarm: Swarm) -> Swarm:
    swarm.authenticator = Authenticator(KEY)
    return swarm


@pytest.mark.parametrize("policy", ["tdma", "dtsa", "lease"])
@pytest.mark.parametrize("make", [PluginSwarm, lambda c: sealed(Swarm(c)), lambda c: sealed(PluginSwarm(c))])
def test_other_swarms_fly_like_the_plain_one(policy: str, make: Callable[[SwarmConfig], Swarm]) -> None:
    config = SwarmConfig(agents=6, moving=4, policy=policy, estimator="intent", scenario="stop-and-go", seed=3)
    plain, wrapped = Swarm(config), make(config)
    for _ in range(2):
        random = np.random.default_rng(1)
        for slot in range(250):
            mask = (random.random(6) < 0.7).astype(np.uint8)
            frames = one_slot(wrapped, slot, mask)
            if wrapped.authenticator is not None:
                frames = {agent: data[:-TAG_LENGTH] for agent, data in frames.items()}
            assert frames == one_slot(plain, slot, mask)
            for name in ARRAYS:
                assert np.array_equal(getattr(plain, name), getattr(wrapped, name)), (slot, name)
        assert (wrapped.malformed, wrapped.foreign, wrapped.rejected) == (0, 0, 0)
        plain.reset()
        wrapped.reset()


def test_external_vehicles_get_the_commands_that_simulated_ones_would_and_nothing_moves() -> None:
    config = SwarmConfig(agents=4, moving=2, policy="tdma", seed=2)
    plain, outside = Swarm(config), Swarm(config)
    for swarm in (plain, outside):
        swarm.scenario.advance(0, swarm)
    still = plain.active == 0
    for slot in range(10):
        for swarm in (plain, outside):
            swarm.position[:, still] = plain.scenario.start[:, still] + 0.1
            swarm.begin(slot)
        outside.position[:] = outside.track[:] = plain.position
        outside.velocity[:] = plain.velocity
        before = outside.position.copy()
        plain.steer(slot, 0)
        steer(outside, slot)
        assert np.array_equal(outside.position, before)
        assert np.array_equal(outside.track[-1], before)
        assert np.array_equal(outside.command[:, ~still], plain.command[:, ~still])
        assert outside.command[:, still] == pytest.approx(max(-HOLD_GAIN * 0.1, -HOLD_MPS))
        for swarm in (plain, outside):
            for index in np.flatnonzero(swarm.sends):
                swarm.hear(slot, swarm.frame(index))
            swarm.end(slot)
        plain.move(0)


def test_no_command_leads_out_of_the_fence() -> None:
    """Making way for others led one of twelve out, and the bridge landed all."""
    config, commands = SwarmConfig(agents=2, moving=2, policy="tdma", seed=2), list[np.ndarray]()
    for fence in (None, np.array([(-0.5, -9.0, -9.0), (0.5, 9.0, 9.0)])[:, :, None]):
        swarm = Swarm(config)
        swarm.scenario.advance(0, swarm)
        swarm.position[:] = swarm.track[:] = [[0.45, -0.6], [0.0, 0.0], [0.0, 0.0]]
        swarm.goal[:] = [[3.0, -3.0], [0.0, 0.0], [0.0, 0.0]]
        swarm.begin(0)
        steer(swarm, 0, fence)
        commands.append(swarm.command.copy())
    free, fenced = commands
    assert free[0, 0] > 0.5 > 0.1 > fenced[0, 0] > 0.0  # slower, the nearer the fence
    assert free[0, 1] < -0.5 < 0.1 < fenced[0, 1]  # outside: back


def closest_once_told_to_stop(seed: int, slot: int, *, stop_here: bool) -> tuple[float, float, float]:
    """Smallest distance (m) of twelve after a slot, where they stop or commands break off for 0.4 s before they brake;

    4 s later the smallest horizontal distance (m) and the largest speed (m/s).
    """
    config = SwarmConfig(
        agents=12, moving=12, policy="tdma", estimator="linear", avoider="crazyflie", seed=seed, slot_ms=20.0,
        shape="ellipse", axis_x_m=1.2, axis_y_m=2.0, permute=False,
    )  # fmt: skip
    commands = np.zeros((3, 12))
    swarm = Swarm(config)
    swarm.scenario.advance(0, swarm)
    place, velocity, closest = swarm.scenario.start.copy(), np.zeros((3, 12)), np.inf
    for now in range(slot + 200):
        swarm.position[:] = swarm.track[:] = place
        swarm.velocity[:] = velocity
        swarm.begin(now)
        for index in np.flatnonzero(swarm.sends):
            swarm.hear(now, swarm.frame(index))
        if now < slot or stop_here:
            steer(swarm, now, way=ways_apart(swarm.position) if now >= slot else None)
            commands[:] = swarm.command
        elif now >= slot + 20:
            commands[:] = 0.0
        swarm.end(now)
        for _ in range(2):
            VehicleParams().step(0.01, place, velocity, commands)
        gaps = np.linalg.norm(place[:, :, None] - place[:, None, :], axis=0) + 10 * np.eye(12)
        closest = min(closest, gaps.min()) if now >= slot else closest
    assert np.array_equal(swarm.goal, swarm.scenario.target)  # the protocol's goals are what they were
    level = np.linalg.norm(place[:2, :, None] - place[:2, None, :], axis=0) + 10 * np.eye(12)
    return closest, float(level.min()), float(np.abs(velocity).max())


def test_vehicles_that_are_told_to_stop_in_the_midst_of_an_exchange_come_to_rest_apart() -> None:
    assert closest_once_told_to_stop(3, 36, stop_here=False)[0] < 0.2
    for seed, slot in ((3, 36), (1, 44), (1, 84)):
        closest, level, speed = closest_once_told_to_stop(seed, slot, stop_here=True)
        assert closest > 0.33
        assert level > 0.4  # nobody lands on another one
        assert speed < 0.05


@pytest.mark.parametrize(("late", "taken"), [(0, True), (1, True), (2, False)])
def test_a_frame_is_authentic_in_its_slot_and_the_one_after(late: int, taken: bool) -> None:
    """Where agents have clocks of their own a receiver may be a slot ahead of the sender."""
    config = SwarmConfig(agents=3, policy="tdma")
    sender, receiver = (sealed(Swarm(config, local=[agent])) for agent in (1, 2))
    (index,) = sender.begin(0)
    frame = sender.frame(index)
    for slot in range(late + 1):
        receiver.begin(slot)
    assert receiver.hear(late, frame) is taken
    assert receiver.rejected == (not taken)
