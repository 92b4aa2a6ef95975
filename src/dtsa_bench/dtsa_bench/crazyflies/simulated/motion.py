"""The world of a fleet: bodies, firmware and estimates, moved on in ticks. It knows no clock and no link."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.settings.flight_models import VehicleParams, flight_model

from .estimate import GRAVITY, Estimate
from .firmware import LEVEL, OFF, Firmware
from .fleet_config import FleetConfig

TICK_S = 0.01
POSITION_NOISE_M = 0.002
VELOCITY_NOISE_MPS = 0.01
COLLISION_M = 0.2  # the record notes two flying vehicles closer than this
CRASH_M = 0.12  # two flying vehicles closer than this fall
DRAG_S = 1.5  # s, time constant of a level quadcopter's drift
HARD_LANDING = 1.5  # m/s: faster than that onto the floor turns it over


class Vehicles:
    """The bodies: true states of a fleet, (3, N), world, in the air, falling and on the floor (z = 0)."""

    def __init__(self, start: NDArray[np.float64], model: VehicleParams) -> None:
        self.model = model
        self.position = np.array(start, dtype=np.float64, order="C")
        self.velocity = np.zeros_like(self.position)
        self.acceleration = np.zeros_like(self.position)

    def step(self, dt: float, modes: list[str], command: NDArray[np.float64]) -> list[int]:
        """Move all for dt seconds by modes and velocity commands, m/s; the indices of those that hit the floor hard."""
        p, v = self.position, self.velocity
        before = v.copy()
        off, level = (np.array([mode == kind for mode in modes], dtype=np.bool_) for kind in (OFF, LEVEL))
        # Level: a = -v / DRAG_S in the plane, written as the command that makes the vehicle model do so.
        command[:2, level] = v[:2, level] * (1.0 - self.model.tau / DRAG_S)
        fallen_p = p[:, off] + v[:, off] * dt
        fallen_v = v[:, off]
        fallen_p[2] -= 0.5 * GRAVITY * dt * dt
        fallen_v[2] -= GRAVITY * dt
        self.model.step(dt, p, v, command)
        p[:, off], v[:, off] = fallen_p, fallen_v
        down = p[2] <= 0.0
        hard: list[int] = np.flatnonzero(down & (v[2] < -HARD_LANDING)).tolist()
        p[2, down] = 0.0
        v[:2, down] = 0.0
        v[2, down] = np.maximum(v[2, down], 0.0)
        self.acceleration = (v - before) / dt
        return hard


class FleetMotion:
    """Vehicles that fly by their firmware; `report` gets an index, the name of an event and details."""

    def __init__(self, config: FleetConfig, report: Callable[..., None]) -> None:
        self._config = config
        self._report = report
        vehicle = flight_model(config.model).vehicle
        self.vehicles = Vehicles(config.start, vehicle)
        arms_itself = [
            config.arming == "auto" or (config.arming == "mixed" and k % 2 == 0) for k in range(config.count)
        ]
        self.firmware = [
            Firmware(partial(report, k), vehicle.tau, auto_arming=auto) for k, auto in enumerate(arms_itself)
        ]
        self.estimates = [Estimate() for _ in range(config.count)]
        self._noise = np.random.default_rng(np.random.SeedSequence(config.seed).spawn(1)[0])
        self._close_pairs: set[tuple[int, int]] = set()
        self._estimate()

    def step(self, t: float, moved: Callable[[], Any] = lambda: None) -> None:
        """Fly for one tick of 10 ms from t (s); `moved` is called between the motion and the report of new places."""
        modes, command = [], np.zeros_like(self.vehicles.position)
        for k, firmware in enumerate(self.firmware):
            mode, wanted = firmware.step(t, TICK_S, self.estimates[k].position, self.estimates[k].velocity)
            modes.append(mode)
            command[:, k] = wanted
        for k in self.vehicles.step(TICK_S, modes, command):
            self._report(k, "hard landing")
            self.firmware[k].supervisor.tumbled = True
        moved()
        self._estimate()
        self._proximity(modes)

    def _estimate(self) -> None:
        state = np.concatenate([self.vehicles.position, self.vehicles.velocity])
        if self._config.noise:
            noise = self._noise.standard_normal(state.shape)
            state[:3] += POSITION_NOISE_M * noise[:3]
            state[3:] += VELOCITY_NOISE_MPS * noise[3:]
        rows = zip(self.estimates, state.T.tolist(), self.vehicles.acceleration.T.tolist(), strict=True)
        for estimate, (x, y, z, vx, vy, vz), (ax, ay, az) in rows:
            estimate.update((x, y, z), (vx, vy, vz), (ax, ay, az))

    def _proximity(self, modes: list[str]) -> None:
        """Two flying vehicles that come too close, and what that does to them."""
        flying = [k for k, mode in enumerate(modes) if mode != OFF and self.vehicles.position[2, k] > 0.05]
        p = self.vehicles.position[:, flying]
        gap: NDArray[np.float64] = p[:, :, None] - p[:, None, :]
        distance = np.sqrt((gap * gap).sum(axis=0))
        near = set()
        for i, j in np.argwhere(np.triu(distance < COLLISION_M, 1)):
            a, b, d = flying[i], flying[j], float(distance[i, j])
            near.add((a, b))
            if (a, b) not in self._close_pairs:
                self._report(a, "collision", other=b + 1, distance=round(d, 3))
            if d < CRASH_M:
                for k in (a, b):
                    self._report(k, "crash")
                    self.firmware[k].supervisor.tumbled = True
        self._close_pairs = near
