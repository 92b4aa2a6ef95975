"""Velocities of a person who steers: limits, walls and the floor. Without ROS and without links."""

from __future__ import annotations

import math

import pytest

from dtsa_agent.crazyflie.motion.limits import outside_fence, room_of
from dtsa_agent.crazyflie.motion.steering import BRAKING_MPS2, FLOOR_M, WALL_M, steered
from dtsa_agent.crazyflie.settings.config import StationSettings
from dtsa_agent.crazyflie.state.conversions import VehicleState


@pytest.mark.parametrize("yaw", [0.0, 2.0])
@pytest.mark.parametrize(
    "wanted", [(9.0, 0.0, 0.0), (0.0, -9.0, 0.3), (1.0, 1.0, -9.0), (0.0, 0.0, 9.0), (-9.0, 9.0, 0.0)]
)
def test_nobody_is_steered_faster_than_allowed_out_of_the_room_or_into_the_floor(
    wanted: tuple[float, float, float], yaw: float
) -> None:
    station = StationSettings()
    heading = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    place, velocity, dt = [0.2, -0.3, 0.95], [0.0, 0.0, 0.0], 0.02
    for step in range(500):
        state = VehicleState((place[0], place[1], place[2]), (velocity[0], velocity[1], velocity[2]), heading, 4.0, 0)
        command = steered(wanted, 9.0, state, station, 0.0).arguments
        assert math.hypot(*command[:3]) <= station.max_speed_mps + 1e-9  # type: ignore[arg-type]
        assert command[3] == pytest.approx(math.degrees(2.0))
        if step == 0:
            c, s = math.cos(yaw), math.sin(yaw)
            along = c * wanted[0] - s * wanted[1], s * wanted[0] + c * wanted[1], wanted[2]
            cosine = sum(a * b for a, b in zip(along, command[:3], strict=True))  # type: ignore[operator]
            assert cosine > 0.6 * math.hypot(*along) * math.hypot(*command[:3])  # type: ignore[arg-type]
        for i in range(3):  # lags behind by 0.15 s
            velocity[i] += (float(command[i]) - velocity[i]) * dt / 0.15  # type: ignore[arg-type]
            place[i] += velocity[i] * dt
        here = (place[0], place[1], place[2])
        assert not outside_fence(here, station)
        assert place[2] > FLOOR_M - 0.1


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_steering_keeps_the_margin_to_every_wall(axis: int, sign: float) -> None:
    """A vehicle comes to a halt at the margin, brakes in time before it, and is free to come back."""
    station = StationSettings(room_origin_in_world=(1.0, -2.0, 0.7))
    low, high = room_of(station)
    margin = high[axis] - WALL_M if sign > 0.0 else low[axis] + WALL_M
    if axis == 2 and sign < 0.0:
        margin = max(margin, FLOOR_M)

    def along(place: float, wanted: float) -> float:
        position, velocity = list(station.room_origin_in_world), [0.0, 0.0, 0.0]
        position[axis], velocity[axis] = place, wanted
        here = VehicleState((position[0], position[1], position[2]), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 4.0, 0)
        command = steered((velocity[0], velocity[1], velocity[2]), 0.0, here, station, 0.0).arguments
        assert [command[i] for i in range(3) if i != axis] == [0.0, 0.0]
        return float(command[axis])  # type: ignore[arg-type]

    fast = sign * station.max_speed_mps
    assert along(margin, fast) == pytest.approx(0.0, abs=1e-7)
    assert along(margin + sign * 0.5 * WALL_M, fast) == 0.0
    assert along(margin - sign * 0.01, fast) == pytest.approx(sign * math.sqrt(2.0 * BRAKING_MPS2 * 0.01))
    assert along(margin - sign * 0.01, sign * 0.01) == pytest.approx(sign * 0.01)
    assert along(margin, -fast) == pytest.approx(-fast)


def test_numbers_that_are_not_finite_steer_nobody() -> None:
    state = VehicleState((0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 4.0, 0)
    for wanted, rate in (((math.nan, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), math.inf)):
        with pytest.raises(ValueError, match="not finite"):
            steered(wanted, rate, state, StationSettings(), 0.0)
