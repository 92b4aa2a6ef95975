"""What happened in a mission: `mission.json`, as its ground station heard it, and a bag beside that of the flight.

The bag is recorded by a process of its own, which gives way to all others: status, diagnostics and events whole; of
commands, estimates and poses the latest one, 20 times a second. Times are the station's clock.
`python -m dtsa_bench.crazyflies.missions.mission_record --bag DIR --names cf1 cf2`
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from dtsa_msgs.msg import Status
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.crazyflie.node.interfaces import EVENTS, EVENTS_QOS, STATE, VelocityWorld
from dtsa_agent.priority import set_nice
from dtsa_agent.ros.common.node_process import follow_supervisor, init_ros
from dtsa_agent.stop import Stop
from dtsa_bench.log.bag.writer import BagWriter

MISSION_BAG = "mission_bag"  # the whole mission's bag, beside that of the exchange
MOST_EVENTS = 5000
QUIET = ["--ros-args", "--disable-rosout-logs"]
PERIOD_S = 0.05
NICE = 10
ALL = QoSProfile(depth=50)
LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
_LEVELS = {10: "debug", 20: "info", 30: "warn", 40: "error", 50: "fatal"}
_IN_FLIGHT = (Status.STATE_ARMED, Status.STATE_FLYING, Status.STATE_LANDING, Status.STATE_LOST)


@dataclass(slots=True)
class VehicleLog:
    """One vehicle's part."""

    battery_first_v: float | None = None
    battery_last_v: float | None = None
    battery_least_v: float | None = None
    link_quality_least: float = 1.0  # this and the next two from arming on
    log_age_most_s: float = 0.0
    latency_most_ms: float = 0.0  # of a command, 99th percentile
    states: list[dict[str, Any]] = field(default_factory=list)  # t_s, state, reason: each change


class MissionLog:
    """Collects, in memory that does not grow with the mission. For one thread, the executor's."""

    def __init__(self) -> None:
        self.began = time.time()
        self.vehicles: dict[str, VehicleLog] = {}
        self.events: list[dict[str, Any]] = []
        self.diagnostics: dict[str, dict[str, float | str]] = {}  # what the bridge said last about each
        self.dropped = 0

    def status(self, name: str, message: Status) -> None:
        """A vehicle's status."""
        log = self.vehicles.setdefault(name, VehicleLog())
        volts = round(float(message.battery_voltage), 3)
        if volts > 0.0:
            log.battery_first_v = log.battery_first_v or volts
            log.battery_least_v = min(volts, log.battery_least_v or volts)
            log.battery_last_v = volts
        if message.state in _IN_FLIGHT:
            log.link_quality_least = min(log.link_quality_least, round(float(message.link_quality), 3))
            log.log_age_most_s = max(log.log_age_most_s, round(float(message.log_age), 3))
            log.latency_most_ms = max(log.latency_most_ms, round(float(message.latency_ms), 2))
        if not log.states or log.states[-1]["state"] != message.state_name:
            when = round(time.time() - self.began, 3)
            log.states.append({"t_s": when, "state": message.state_name, "reason": message.reason})

    def diagnostic(self, message: DiagnosticArray) -> None:
        """Diagnostics; only the bridge's count."""
        for status in message.status:
            if status.name.startswith("crazyflie_bridge: "):
                self.diagnostics[status.hardware_id] = {v.key: _number(v.value) for v in status.values}

    def event(self, message: Log) -> None:
        """Something that the bridge did, or was ordered to do."""
        if len(self.events) < MOST_EVENTS:
            level = _LEVELS.get(int(message.level), str(message.level))
            when = message.stamp.sec + message.stamp.nanosec * 1e-9 - self.began
            self.events.append({"t_s": round(when, 3), "level": level, "text": message.msg})
        else:
            self.dropped += 1

    def write(self, directory: Path, reason: str) -> None:
        """Write `mission.json` in the flight's directory; `reason`: why the mission was cut short, or ""."""
        logs = sorted(self.vehicles.items(), key=lambda item: (len(item[0]), item[0]))  # cf9 before cf10
        content = {
            "began_unix_s": round(self.began, 3),
            "duration_s": round(time.time() - self.began, 3),
            "cut_short": reason,
            "vehicles": {name: asdict(log) | {"last": self.diagnostics.get(name, {})} for name, log in logs},
            "events": sorted(self.events, key=lambda event: event["t_s"]),
            "events_left_out": self.dropped,
        }
        path = directory / "mission.json.part"
        path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        path.replace(directory / "mission.json")


def _number(text: str) -> float | str:
    """A number where it is one that JSON knows."""
    try:
        value = float(text)
    except ValueError:
        return text
    return value if math.isfinite(value) else text


# -- the bag ----------------------------------------------------------------------------------------------------------
def record(node: Node, bag: BagWriter, names: list[str], stop: Stop) -> None:
    """Record all of these vehicles until a signal has come, and then what is left."""
    recorded: list[tuple[Any, str, QoSProfile]] = [(Log, EVENTS, EVENTS_QOS), (DiagnosticArray, "/diagnostics", ALL)]
    for name in names:
        recorded += [
            (Status, f"/{name}/{STATE}", ALL),
            (Odometry, f"/{name}/odom", LATEST),
            (VelocityWorld, f"/{name}/cmd_velocity_world", LATEST),
            (PoseStamped, f"/{name}/pose", LATEST),
        ]
    topics = []
    for kind, topic, qos in recorded:
        subscription = node.create_subscription(kind, topic, lambda message: None, qos)
        channel = bag.add_topic(topic, f"{kind.__module__.partition('.')[0]}/msg/{kind.__name__}")
        topics.append((subscription.handle, kind, channel, qos.depth))
    last = False
    while not last:
        time.sleep(PERIOD_S)
        last = bool(stop)
        for handle, kind, channel, most in topics:
            with handle:
                for _ in range(most):
                    received = handle.take_message(kind, True)
                    if received is None:
                        break
                    data, info = received
                    bag.write(channel, bytes(data), time.time_ns(), int(info["source_timestamp"]))


def main(argv: list[str] | None = None) -> int:
    """Record until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(prog="mission_record", description=__doc__, allow_abbrev=False)
    parser.add_argument("--bag", type=Path, required=True, help="directory that is made")
    parser.add_argument("--names", nargs="+", required=True, help="of the vehicles")
    args = parser.parse_args(argv)
    with Stop() as stop:
        follow_supervisor()
        set_nice(NICE)
        init_ros(QUIET)
        node = rclpy.create_node("mission_recorder", enable_rosout=False, start_parameter_services=False)
        try:
            with BagWriter(args.bag, None, custom_data={"mission": "the station's clock"}) as bag:
                record(node, bag, args.names, stop)
        except DtsaError as error:
            print(f"mission_recorder: {error}", file=sys.stderr)
            return 1
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
