"""The motion capture of a laboratory with simulated Crazyflies: publishes what the fleet's cameras see, at 100 Hz."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import sys
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped

from dtsa_agent.ros.common.process.node_process import follow_supervisor, init_ros
from dtsa_agent.ros.common.process.priority import take_priority
from dtsa_agent.ros.common.workarounds.dds import limit_to_machine

from .cameras import DATAGRAM, half_turn, read_picture

QUIET = ["--ros-args", "--disable-rosout-logs"]


def latest(sock: socket.socket) -> bytes:
    """Waits for a picture; the newest one if there are several."""
    datagram = sock.recv(DATAGRAM)
    with contextlib.suppress(BlockingIOError):
        while True:
            datagram = sock.recv(DATAGRAM, socket.MSG_DONTWAIT)
    return datagram


def main(argv: list[str] | None = None) -> int:
    """Publish until SIGTERM."""
    parser = argparse.ArgumentParser(prog="motion_capture", description=__doc__, allow_abbrev=False)
    parser.add_argument("--port", type=int, required=True, help="UDP port on which the fleet tells its positions")
    parser.add_argument("--topic", default="/cf{id}/pose", help="of each, {id} is its id [%(default)s]")
    parser.add_argument("--priority", type=int, default=30, help="real-time priority, where allowed [%(default)s]")
    args = parser.parse_args(argv)
    follow_supervisor()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: sys.exit(0))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", args.port))
        take_priority(args.priority)  # in a laboratory this is a machine of its own
        limit_to_machine(os.environ, shared_memory=False)
        init_ros(QUIET)
        node = rclpy.create_node("motion_capture", enable_rosout=False, start_parameter_services=False)
        publishers: dict[int, Any] = {}
        message = PoseStamped()
        message.header.frame_id = "world"
        try:
            while True:
                stamp, bodies = read_picture(latest(sock))
                message.header.stamp.sec, message.header.stamp.nanosec = int(stamp), int(stamp % 1.0 * 1e9)
                p, q = message.pose.position, message.pose.orientation
                for k, x, y, z, yaw in bodies:
                    if k not in publishers:
                        publishers[k] = node.create_publisher(PoseStamped, args.topic.replace("{id}", str(k)), 1)
                    p.x, p.y, p.z = x, y, z
                    q.z, q.w = half_turn(yaw)
                    publishers[k].publish(message)
        finally:
            node.destroy_node()
            rclpy.try_shutdown()


if __name__ == "__main__":
    sys.exit(main())
