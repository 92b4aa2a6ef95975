"""Records a whole mission beside the flight's own bag: a process of its own, which gives way to all others.

Status, diagnostics and events whole; of commands, estimates and poses the latest one, 20 times a second. Times are the
station's clock. `python -m dtsa_bench.crazyflies.missions.mission_recorder --bag DIR --names cf1 cf2`
"""

from __future__ import annotations

import argparse
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from dtsa_msgs.msg import Status, VelocityWorld
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.crazyflie.node.outputs import EVENTS, EVENTS_QOS
from dtsa_agent.ros.common.process.node_process import follow_supervisor, init_ros
from dtsa_agent.ros.common.process.priority import give_way_by
from dtsa_bench.recordings.bag.writer import BagWriter

QUIET = ["--ros-args", "--disable-rosout-logs"]
PERIOD_S = 0.05
NICE = 10
ALL = QoSProfile(depth=50)
LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)


@dataclass(frozen=True, slots=True)
class Source:
    """One topic that is recorded."""

    handle: Any  # subscription
    kind: type
    channel: int
    most: int  # messages taken at once


def sources(node: Any, bag: BagWriter, names: list[str]) -> list[Source]:
    """Subscribes to everything that is recorded.

    :param names: of the vehicles.
    """
    wanted: list[tuple[type, str, str, QoSProfile]] = [
        (Log, EVENTS, "rcl_interfaces/msg/Log", EVENTS_QOS),
        (DiagnosticArray, "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", ALL),
    ]
    for name in names:
        wanted += [
            (Status, f"/{name}/status", "dtsa_msgs/msg/Status", ALL),
            (Odometry, f"/{name}/odom", "nav_msgs/msg/Odometry", LATEST),
            (VelocityWorld, f"/{name}/cmd_velocity_world", "dtsa_msgs/msg/VelocityWorld", LATEST),
            (PoseStamped, f"/{name}/pose", "geometry_msgs/msg/PoseStamped", LATEST),
        ]
    found = []
    for kind, topic, text, qos in wanted:
        subscription = node.create_subscription(kind, topic, lambda message: None, qos)
        found.append(Source(subscription.handle, kind, bag.add_topic(topic, text), qos.depth))
    return found


def record(found: list[Source], bag: BagWriter, over: list[int]) -> None:
    """Until a signal has come, and then what is left.

    :param over: numbers of the signals that have come.
    """
    last = False
    while not last:
        time.sleep(PERIOD_S)
        last = bool(over)
        for source in found:
            with source.handle:
                for _ in range(source.most):
                    taken = source.handle.take_message(source.kind, True)
                    if taken is None:
                        break
                    data, info = taken
                    bag.write(source.channel, bytes(data), time.time_ns(), int(info["source_timestamp"]))


def main(argv: list[str] | None = None) -> int:
    """Record until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(prog="mission_recorder", description=__doc__, allow_abbrev=False)
    parser.add_argument("--bag", type=Path, required=True, help="directory that is made")
    parser.add_argument("--names", nargs="+", required=True, help="of the vehicles")
    args = parser.parse_args(argv)
    over: list[int] = []  # no `threading.Event`: two signals at once would make its `set` wait for itself
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: over.append(number))
    follow_supervisor()
    give_way_by(NICE)
    init_ros(QUIET)
    node = rclpy.create_node("mission_recorder", enable_rosout=False, start_parameter_services=False)
    try:
        with BagWriter(args.bag, None, custom_data={"mission": "the station's clock"}) as bag:
            record(sources(node, bag, args.names), bag, over)
    except DtsaError as error:
        print(f"mission_recorder: {error}", file=sys.stderr)
        return 1
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
