"""Bags for the tests: a small swarm on a circle, recorded with the real writer and message definitions."""

from __future__ import annotations

import atexit
import os
import struct
import time
from contextlib import ExitStack
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.recordings.bag import schema
from dtsa_bench.recordings.bag.cdr import MarkerPacker, OdometryPacker
from dtsa_bench.recordings.bag.errors import BagError
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.bag.writer import BagWriter

MESSAGES = Path(__file__).parents[2] / "dtsa_msgs" / "msg"
RUN = 0x1234  # id of all synthetic runs
SECOND = 1_000_000_000


@cache
def typestore() -> Typestore:
    """Jazzy's messages and those of this project, from their sources."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted(MESSAGES.glob("*.msg")):
        store.register(get_types_from_msg(path.read_text(encoding="utf-8"), f"dtsa_msgs/msg/{path.stem}"))
    return store


def definition(name: str) -> schema.Definition:
    """Installed definition of a type; from the sources where the workspace is not built."""
    try:
        return schema.installed(name)
    except BagError:
        return schema.brought(name, MESSAGES)


def cdr(kind: str, **fields: Any) -> bytes:
    """A message as CDR by rosbags' own serialiser."""
    store = typestore()
    return bytes(store.serialize_cdr(store.types[kind](**fields), kind))


def stamp(time_ns: int) -> Any:
    """`builtin_interfaces/Time` for rosbags' serialiser."""
    return typestore().types["builtin_interfaces/msg/Time"](time_ns // SECOND, time_ns % SECOND)


def header(time_ns: int) -> Any:
    """`std_msgs/Header` in frame `map` for rosbags' serialiser."""
    return typestore().types["std_msgs/msg/Header"](stamp(time_ns), "map")


def positions(agents: int, time_s: float) -> tuple[np.ndarray, np.ndarray]:
    """(3, n) m and (3, n) m/s of agents that circle the origin."""
    angle = 2 * np.pi * np.arange(agents) / agents + 0.3 * time_s
    place = np.stack([2 * np.cos(angle), 2 * np.sin(angle), 0.1 * np.sin(3 * angle)])
    speed = 0.3 * np.stack([-2 * np.sin(angle), 2 * np.cos(angle), 0.3 * np.cos(3 * angle)])
    return place, speed


class SyntheticRun:
    """Writes a plausible run slot by slot: TDMA, every agent sends in its turn, all hear.

    :param directory: where the bag is made.
    :param agents: number of agents.
    :param slot_ms: ms, length of a slot.
    """

    def __init__(self, directory: Path, agents: int = 4, slot_ms: int = 10, **options: Any) -> None:
        self.agents, self.slot_ns = agents, slot_ms * 1_000_000
        config = {"agents": agents, "moving": agents, "policy": "tdma", "slot_ms": slot_ms, "seed": 7}
        self.writer = BagWriter(directory, config, **options)
        self.written: dict[str, list[tuple[int, int, bytes]]] = {}
        self._channels: dict[str, int] = {}
        for topic, kind, qos in [
            ("/swarm/slot", "dtsa_msgs/msg/Slot", "reliable"),
            ("/swarm/transmission", "dtsa_msgs/msg/Transmission", "reliable"),
            ("/swarm/reception", "dtsa_msgs/msg/Reception", "reliable"),
            ("/swarm/decision", "dtsa_msgs/msg/Decision", "reliable"),
            ("/swarm/markers", "visualization_msgs/msg/MarkerArray", "reliable"),
            *((f"/cf{i}/odom", "nav_msgs/msg/Odometry", "sensor_data") for i in range(1, agents + 1)),
        ]:
            self._channels[topic] = self.writer.add_topic(topic, kind, qos, definition(kind))
            self.written[topic] = []
        self._odometry = OdometryPacker([f"cf{i}/base_link" for i in range(1, agents + 1)])
        self._markers = MarkerPacker([str(i) for i in range(1, agents + 1)])

    def _write(self, topic: str, data: bytes, log_ns: int, publish_ns: int) -> None:
        self.writer.write(self._channels[topic], data, log_ns, publish_ns)
        self.written[topic].append((log_ns, publish_ns, data))

    def slot(self, slot: int) -> None:
        """Record everything of one slot."""
        n, start = self.agents, SECOND + slot * self.slot_ns
        end = start + self.slot_ns
        ids = np.arange(1, n + 1, dtype=np.uint16)
        sender = slot % n + 1
        frame = np.frombuffer(bytes([1, sender, slot & 255, slot >> 8]) + bytes(19), np.uint8)
        heard = np.packbits(np.ones(n, np.uint8), bitorder="little")
        place, speed = positions(n, (end - SECOND) / SECOND)
        u8, u16 = (lambda *v: np.array(v, np.uint8)), (lambda *v: np.array(v, np.uint16))
        self._write(
            "/swarm/slot",
            cdr(
                "dtsa_msgs/msg/Slot", header=header(start), run=RUN, slot=slot, phase=0, heard_slot=max(0, slot - 1),
                sender=u16((slot - 1) % n + 1) if slot else u16(), length=u8(23) if slot else u8(),
                data=frame if slot else u8(), received=heard if slot else u8(),
            ),
            start, start,
        )  # fmt: skip
        self._write(
            "/swarm/transmission",
            cdr(
                "dtsa_msgs/msg/Transmission", header=header(start), run=RUN, slot=slot, agent=ids,
                length=np.where(ids == sender, 23, 0).astype(np.uint8), data=frame,
                offset_ns=np.zeros(0, np.int64), chosen=np.full(n, sender, np.uint16), reason=np.zeros(n, np.uint8),
                digest=np.full(n, slot, np.uint32), score=np.zeros(n), steps=1,
                track=place.ravel(), velocity=speed.ravel(), command=speed.ravel(),
                goal=-place.ravel() if slot == 0 else np.zeros(0),
            ),
            start + 1000, start,
        )  # fmt: skip
        self._write(
            "/swarm/reception",
            cdr(
                "dtsa_msgs/msg/Reception", header=header(end), run=RUN, slot=slot, outcome=1, sender=u16(sender),
                received=heard, lost=u16(0), collided=u16(0),
            ),
            end, end,
        )  # fmt: skip
        self._write(
            "/swarm/decision",
            cdr(
                "dtsa_msgs/msg/Decision", header=header(start), run=RUN, slot=slot, agent=ids,
                chosen=np.full(n, sender, np.uint16), reason_name=["tdma"], reason_index=np.zeros(n, np.uint8),
                reason=np.zeros(n, np.uint8), digest=np.full(n, slot, np.uint32), score=np.zeros(n),
            ),
            end, start,
        )  # fmt: skip
        for number, data in enumerate(self._odometry.pack(end, place, speed), 1):
            self._write(f"/cf{number}/odom", data, end, end)
        if slot % 10 == 0:
            state = (ids == sender).astype(np.uint8) + 1
            self._write("/swarm/markers", self._markers.pack(end, place, state, -place), end, end)


def synthetic_bag(directory: Path, slots: int = 100, **options: Any) -> SyntheticRun:
    """A closed bag of a synthetic run."""
    run = SyntheticRun(directory, **options)
    with run.writer:
        for slot in range(slots):
            run.slot(slot)
    return run


_HELD = ExitStack()
atexit.register(_HELD.close)


@cache
def ros_environment() -> dict[str, str]:
    """Environment for nodes in a domain that is this process's as long as it runs."""
    domain = str(_HELD.enter_context(ros_domain()))
    here = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONUNBUFFERED": "1"}
    return {**os.environ, **here, "ROS_DOMAIN_ID": domain}


def listen(graph: Any, bag: Path) -> dict[str, list[tuple[int, str]]]:
    """What will arrive in a test's graph on each topic of a bag and on `/clock`: ns, monotonic, and hexadecimal."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    arrived: dict[str, list[tuple[int, str]]] = {}

    def subscribe(name: str, kind: str, reliability: str) -> None:
        package, _, short = kind.split("/")
        rows = arrived[name] = []
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy[reliability.upper()])
        message = getattr(import_module(f"{package}.msg"), short)
        receive = lambda data: rows.append((time.monotonic_ns(), data.hex()))  # noqa: E731
        graph.node.create_subscription(message, name, receive, qos, raw=True)

    with Bag(bag) as opened:
        for topic in opened.topics.values():
            subscribe(topic.name, topic.type, topic.profiles[0]["reliability"])
    subscribe("/clock", "rosgraph_msgs/msg/Clock", "best_effort")
    return arrived


def clock_ns(data: str) -> int:
    """The time of a message on `/clock`."""
    seconds, nanoseconds = struct.unpack_from("<iI", bytes.fromhex(data), 4)
    return seconds * SECOND + nanoseconds


def as_it_arrives(data: bytes) -> str:
    """A recorded message, hexadecimal: the middleware fills the last word up with zeros."""
    return (data + bytes(-len(data) % 4)).hex()
