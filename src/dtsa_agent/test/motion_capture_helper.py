"""Simulated Crazyflies that know no positions but those of motion capture, and the motion capture that sees them.

Runs as `fake-crazyflie` does, and publishes /cfK/pose 100 times a second; one more fault: `unseen`.
"""

from __future__ import annotations

import math
import os
import sys
import time
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped

from dtsa_agent.ros.common.node_process import init_ros, limit_to_machine
from dtsa_bench.commands.cli import main
from dtsa_bench.crazyflies.simulated import cli, motion, process
from dtsa_bench.crazyflies.simulated.estimate import Estimate
from dtsa_bench.crazyflies.simulated.fleet import Fleet
from dtsa_bench.crazyflies.simulated.fleet_config import FleetConfig
from dtsa_bench.crazyflies.simulated.planner import Triple

NOISE_M = 0.0003  # of a calibrated system
IMU_NOISE_MPS2 = 0.2  # with vibrations


class PositionFilter:
    """The Crazyflie's Kalman filter when positions come from outside: nothing is known but what the host sends.

    One axis like the other: position and velocity, driven by the measured acceleration, corrected by positions. As in
    the firmware (kalman_core.c) variances grow to 100 m^2 and no further while nothing comes.
    """

    CAP = 100.0  # m^2, MAX_COVARIANCE, and the variance of the place after a reset
    ACCELERATION_NOISE = 0.5  # m/s^2, as the filter assumes it

    def __init__(self) -> None:
        self.reset((0.0, 0.0, 0.0))

    def reset(self, place: Triple) -> None:
        """Restart at a place (m, world), which is not known well."""
        self.position: Triple = place
        self.velocity: Triple = (0.0, 0.0, 0.0)
        self.variance = self.CAP
        self._cross, self._speed = 0.0, 1e-4

    def predict(self, dt: float, a: Triple) -> None:
        """One step (s) by the accelerometer (m/s^2, world, without gravity)."""
        p, v = self.position, self.velocity
        self.position = (p[0] + v[0] * dt, p[1] + v[1] * dt, p[2] + v[2] * dt)
        self.velocity = (v[0] + a[0] * dt, v[1] + a[1] * dt, v[2] + a[2] * dt)
        self.variance = min(self.CAP, self.variance + dt * (2 * self._cross + dt * self._speed))
        self._cross += dt * self._speed
        self._speed = min(self.CAP, self._speed + (self.ACCELERATION_NOISE * dt) ** 2)
        self._cross = min(self._cross, (self.variance * self._speed) ** 0.5)

    def correct(self, place: Triple, deviation: float) -> None:
        """A position from outside (m, world), with its standard deviation."""
        total = self.variance + deviation * deviation
        gain, speed_gain = self.variance / total, self._cross / total
        p, v = self.position, self.velocity
        e = (place[0] - p[0], place[1] - p[1], place[2] - p[2])
        self.position = (p[0] + gain * e[0], p[1] + gain * e[1], p[2] + gain * e[2])
        self.velocity = (v[0] + speed_gain * e[0], v[1] + speed_gain * e[1], v[2] + speed_gain * e[2])
        self._speed -= speed_gain * self._cross
        self._cross *= 1.0 - gain
        self.variance *= 1.0 - gain


class HostEstimate(Estimate):
    """An estimate by the host's positions, in place of decks."""

    def __init__(self) -> None:
        super().__init__()
        self.filter, self._noise = PositionFilter(), np.random.default_rng(7)

    def update(self, position: Triple, velocity: Triple, acceleration: Triple) -> None:
        x, y, z = (np.array(acceleration) + IMU_NOISE_MPS2 * self._noise.standard_normal(3)).tolist()
        self.filter.predict(motion.TICK_S, (x, y, z))
        super().update(self.filter.position, self.filter.velocity, acceleration)

    def correct(self, place: Triple, deviation: float) -> None:
        self.filter.correct(place, deviation)

    def reset(self, t: float, place: Triple) -> None:
        super().reset(t, place)
        self.filter.reset(place)

    def variance(self, t: float) -> float:
        return self.filter.variance


class TrackedFleet(Fleet):
    """A fleet, and the cameras that see it."""

    def __init__(self, config: FleetConfig) -> None:
        self._unseen: set[int] = set()
        self._noise = np.random.default_rng(config.count)
        limit_to_machine(os.environ)
        init_ros(["--ros-args", "--disable-rosout-logs"])
        node = rclpy.create_node("motion_capture", enable_rosout=False, start_parameter_services=False)
        self._poses = [node.create_publisher(PoseStamped, f"/cf{k + 1}/pose", 1) for k in range(config.count)]
        super().__init__(config)

    def step(self) -> None:
        super().step()
        now = time.time()
        places = self.vehicles.position + NOISE_M * self._noise.standard_normal(self.vehicles.position.shape)
        for k, (x, y, z) in enumerate(places.T.tolist()):
            if k in self._unseen:
                continue
            message = PoseStamped()
            message.header.frame_id = "world"
            message.header.stamp.sec, message.header.stamp.nanosec = int(now), int(now % 1.0 * 1e9)
            p, q, yaw = message.pose.position, message.pose.orientation, self.firmware[k].yaw
            p.x, p.y, p.z = x, y, z
            q.z, q.w = math.sin(yaw / 2), math.cos(yaw / 2)
            self._poses[k].publish(message)

    def _apply(self, name: str, index: int, request: dict[str, Any]) -> None:
        super()._apply(name, index, request)
        if name == "unseen":
            self._unseen.add(index)


def fly() -> int:
    motion.Estimate = HostEstimate  # type: ignore[misc]
    cli.Fleet = TrackedFleet  # type: ignore[misc]
    process.FAULTS["unseen"] = "motion capture does not see it"
    code = main(["fake-crazyflie", *sys.argv[1:]])
    rclpy.try_shutdown()
    return code


if __name__ == "__main__":
    sys.exit(fly())
