"""Poses from motion capture come in over the graph, in a thread of their own."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.positions.motion_capture import NAMED_POSES, PositionSettings
from dtsa_agent.crazyflie.vehicle.vehicle import Vehicle

from .command_thread import CommandThread

# Whoever publishes, reliably or not; a pose that is late is worth nothing.
SENSOR = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)


def named_pose_array() -> Any:
    """The type of the named poses.

    :raises ConfigError: its package is not in the workspace.
    """
    try:
        from motion_capture_tracking_interfaces.msg import NamedPoseArray
    except ImportError:
        raise ConfigError(
            "station.positions.source", NAMED_POSES,
            "pose, or named_poses with the package motion_capture_tracking_interfaces in the workspace (it is not)",
        ) from None  # fmt: skip
    return NamedPoseArray


def subscribe_positions(commands: CommandThread, settings: PositionSettings, vehicles: dict[str, Vehicle]) -> None:
    """Listen to motion capture, if there is one.

    :param commands: takes the poses; not started yet.
    :raises ConfigError: the type of the named poses is not there.
    """
    if settings.source == NAMED_POSES:
        topics = {settings.topic_of(name) for name in vehicles}
        for topic in sorted(topics):
            commands.subscribe(named_pose_array(), topic, partial(_named, vehicles), SENSOR)
    elif settings.on:
        for name, vehicle in vehicles.items():
            commands.subscribe(PoseStamped, settings.topic_of(name), _one(vehicle), SENSOR)


def _one(vehicle: Vehicle) -> Callable[[PoseStamped, Any], None]:
    return lambda message, info: _pass_on(vehicle, message.header, message.pose)


def _named(vehicles: dict[str, Vehicle], message: Any, info: Any) -> None:
    for named in message.poses:
        if (vehicle := vehicles.get(named.name)) is not None:
            _pass_on(vehicle, message.header, named.pose)


def _pass_on(vehicle: Vehicle, header: Any, pose: Any) -> None:
    p, q = pose.position, pose.orientation
    stamp = header.stamp.sec + header.stamp.nanosec * 1e-9
    vehicle.see((p.x, p.y, p.z), (q.x, q.y, q.z, q.w), header.frame_id, stamp)
