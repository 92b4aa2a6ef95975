"""The bodies: all vehicles of a fleet in one set of arrays, in the air, falling and on the floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.settings.flight_models import VehicleParams

from .firmware import FLY, LEVEL, OFF

GRAVITY = 9.81
DRAG_S = 1.5  # s, time constant of a level quadcopter's drift
HARD_LANDING = 1.5  # m/s: faster than that onto the floor turns it over


class Vehicles:
    """True states of a fleet.

    :param start: (3, N), m, world; z = 0 is the floor.
    :param model: how they answer a velocity command.
    """

    def __init__(self, start: NDArray[np.float64], model: VehicleParams) -> None:
        self.model = model
        self.position = np.array(start, dtype=np.float64, order="C")
        self.velocity = np.zeros_like(self.position)
        self.acceleration = np.zeros_like(self.position)

    def step(self, dt: float, modes: list[str], command: NDArray[np.float64]) -> list[int]:
        """Move everybody for dt seconds.

        :param modes: OFF, FLY or LEVEL for each vehicle.
        :param command: (3, N), m/s.
        :return: indices of the vehicles that hit the floor hard.
        """
        p, v = self.position, self.velocity
        before = v.copy()
        off = np.array([mode == OFF for mode in modes])
        level = np.array([mode == LEVEL for mode in modes])
        # Level: a = -v / DRAG_S in the plane, written as the command that makes the vehicle model do so.
        command[:2, level] = v[:2, level] * (1.0 - self.model.tau / DRAG_S)
        fallen_p = p[:, off] + v[:, off] * dt
        fallen_v = v[:, off]
        fallen_p[2] -= 0.5 * GRAVITY * dt * dt
        fallen_v[2] -= GRAVITY * dt
        self.model.step(dt, p, v, command)
        p[:, off], v[:, off] = fallen_p, fallen_v
        hard = self._floor()
        self.acceleration = (v - before) / dt
        return hard

    def _floor(self) -> list[int]:
        p, v = self.position, self.velocity
        down = p[2] <= 0.0
        hard = np.flatnonzero(down & (v[2] < -HARD_LANDING)).tolist()
        p[2, down] = 0.0
        v[:2, down] = 0.0
        v[2, down] = np.maximum(v[2, down], 0.0)
        return hard


__all__ = ["FLY", "LEVEL", "OFF", "Vehicles"]
