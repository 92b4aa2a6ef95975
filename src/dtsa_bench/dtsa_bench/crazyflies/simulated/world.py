"""The world of a fleet: bodies, firmware and estimates, moved on in ticks. It knows no clock and no link."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.settings.flight_models import flight_model

from .estimate import Estimate
from .firmware import OFF, Firmware
from .fleet_config import FleetConfig
from .position_filter import PositionFilter
from .vehicles import Vehicles

TICK_S = 0.01
POSITION_NOISE_M = 0.002
VELOCITY_NOISE_MPS = 0.01
IMU_NOISE_MPS2 = 0.2  # with vibrations


class World:
    """Vehicles that fly by what their firmware says.

    :param config: how many, where they stand, what they are.
    :param report: takes an index, the name of an event and details, for the record.
    """

    def __init__(self, config: FleetConfig, report: Callable[..., None]) -> None:
        self._config = config
        self._report = report
        vehicle = flight_model(config.model).vehicle
        self.vehicles = Vehicles(config.start, vehicle)
        self.firmware = [
            Firmware(partial(report, k), vehicle.tau, auto_arming=config.arms_itself(k)) for k in range(config.count)
        ]
        host = config.positions == "host"
        self.estimates = [Estimate(filter=PositionFilter() if host else None) for _ in range(config.count)]
        streams = np.random.SeedSequence(config.seed).spawn(3)  # the second one is the links'
        self._noise = np.random.default_rng(streams[0])
        self._imu = np.random.default_rng(streams[2])
        self._close_pairs: set[tuple[int, int]] = set()
        self._estimate()

    def step(self, t: float, moved: Callable[[], Any] = lambda: None) -> None:
        """Fly for one tick of 10 ms.

        :param t: s, when it begins.
        :param moved: called when the bodies have moved, before anything is reported of their new places.
        """
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
        acceleration = self.vehicles.acceleration.T.tolist()
        if self._config.positions == "host":
            noise = self._imu.standard_normal((3, self._config.count))
            measured = self.vehicles.acceleration + IMU_NOISE_MPS2 * noise
            for estimate, row in zip(self.estimates, measured.T.tolist(), strict=True):
                assert estimate.filter is not None
                estimate.filter.predict(TICK_S, (row[0], row[1], row[2]))
        for k, (row, a) in enumerate(zip(state.T.tolist(), acceleration, strict=True)):
            estimate = self.estimates[k]
            position, velocity = (row[0], row[1], row[2]), (row[3], row[4], row[5])
            if estimate.filter is not None:
                position, velocity = estimate.filter.position, estimate.filter.velocity
            estimate.tell(position, velocity, (a[0], a[1], a[2]))

    def _proximity(self, modes: list[str]) -> None:
        """Two flying vehicles that come too close, and what that does to them."""
        flying = [k for k, mode in enumerate(modes) if mode != OFF and self.vehicles.position[2, k] > 0.05]
        p = self.vehicles.position[:, flying]
        gap: NDArray[np.float64] = p[:, :, None] - p[:, None, :]
        distance = np.sqrt((gap * gap).sum(axis=0))
        near = set()
        for i, j in np.argwhere(np.triu(distance < self._config.collision_m, 1)):
            a, b, d = flying[i], flying[j], float(distance[i, j])
            near.add((a, b))
            if (a, b) not in self._close_pairs:
                self._report(a, "collision", other=b + 1, distance=round(d, 3))
            if d < self._config.crash_m:
                for k in (a, b):
                    self._report(k, "crash")
                    self.firmware[k].supervisor.tumbled = True
        self._close_pairs = near
