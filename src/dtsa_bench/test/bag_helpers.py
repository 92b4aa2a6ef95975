"""Bags for the tests: a small swarm on a circle, recorded with the real writer and message definitions."""

from __future__ import annotations

import atexit
import os
import struct
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import cache
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from dtsa_agent.core import REASONS, Swarm, SwarmConfig
from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.log.bag import schema
from dtsa_bench.log.bag.cdr import MarkerPacker, OdometryPacker
from dtsa_bench.log.bag.errors import BagError
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.writer import BagWriter
from dtsa_bench.log.record import FORMAT, FORMAT_KEY, SLOT_RECORD, TYPE, frame_fields, pack_record
from dtsa_bench.runs.config import RunConfig

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
    store = typestore()
    return bytes(store.serialize_cdr(store.types[kind](**fields), kind))


def stamp(time_ns: int) -> Any:
    return typestore().types["builtin_interfaces/msg/Time"](time_ns // SECOND, time_ns % SECOND)


def header(time_ns: int) -> Any:
    return typestore().types["std_msgs/msg/Header"](stamp(time_ns), "map")


class SyntheticRun:
    """A flight of the real core on a seeded channel that loses frames, recorded slot by slot.

    :param whole: record messages of the graph and markers, too, as another recorder might.
    :param options: of `BagWriter`.
    """

    def __init__(
        self, directory: Path, config: SwarmConfig, loss: float = 0.0, whole: bool = True, **options: Any
    ) -> None:
        self.config, self.loss, self._swarm = config, loss, Swarm(config)
        self._ids = np.arange(1, config.agents + 1, dtype=np.uint16)
        self._random, self._start = np.random.default_rng(config.seed), self._swarm.position.copy()
        self._next = 0
        self._delivery: dict[str, Any] = dict.fromkeys(("sender", "length", "data", "received"), np.zeros(0, np.uint8))
        options["custom_data"] = {FORMAT_KEY: FORMAT} | options.get("custom_data", {})
        self.writer = BagWriter(directory, RunConfig(config).to_dict(), **options)
        self.written: dict[str, list[tuple[int, int, bytes]]] = {}
        self._channels: dict[str, int] = {}
        swarm_topics = ("Slot", "Transmission", "Reception", "Decision") if whole else ()
        topics = [(SLOT_RECORD, TYPE, "reliable")]
        topics += [(f"/swarm/{name.lower()}", f"dtsa_msgs/msg/{name}", "reliable") for name in swarm_topics]
        topics += [("/swarm/markers", "visualization_msgs/msg/MarkerArray", "reliable")] * whole
        topics += [(f"/cf{i}/odom", "nav_msgs/msg/Odometry", "sensor_data") for i in self._ids]
        for topic, kind, qos in topics:
            self._channels[topic] = self.writer.add_topic(topic, kind, qos, definition(kind))
            self.written[topic] = []
        self._odometry = OdometryPacker([f"cf{i}/base_link" for i in self._ids])
        self._markers = MarkerPacker(self._ids.tolist())

    def _write(self, topic: str, log_ns: int, publish_ns: int, packed: bytes = b"", **fields: Any) -> None:
        if topic not in self._channels:
            return
        kind = f"dtsa_msgs/msg/{topic.rpartition('/')[2].capitalize()}"
        message = packed or cdr(kind, header=header(publish_ns), run=RUN, **fields)
        self.writer.write(self._channels[topic], message, log_ns, publish_ns)
        self.written[topic].append((log_ns, publish_ns, message))

    def answer(self, slot: int, data: np.ndarray) -> None:
        """Record what the agents say at the start of a slot."""
        swarm, start = self._swarm, SECOND + slot * self.config.slot_ns
        lengths = [len(swarm.frame(k)) if len(data) else 0 for k in range(self.config.agents)]
        track = swarm.track.copy() if slot else np.repeat(self._start[None], self.config.steps, 0)
        self._begin = {
            "agent": self._ids, "track": track, "velocity": swarm.velocity.copy(), "command": swarm.command.copy(),
            "goal": swarm.goal.copy(),
            **{name: getattr(swarm, name).copy() for name in ("chosen", "reason", "digest", "score")},
        }  # fmt: skip
        self._write(
            "/swarm/transmission", start, start, slot=slot, agent=self._ids, length=np.array(lengths, np.uint8),
            data=data, offset_ns=np.zeros(0, np.int64), chosen=swarm.chosen, reason=swarm.reason, digest=swarm.digest,
            score=swarm.score, steps=self.config.steps, track=track.ravel(), velocity=swarm.velocity.ravel(),
            command=swarm.command.ravel(), goal=swarm.goal.ravel() if slot == 0 else np.zeros(0),
        )  # fmt: skip

    def end(self, slot: int) -> None:
        """Record where all are at the end."""
        at = SECOND + slot * self.config.slot_ns
        record = pack_record(RUN, slot, at, self.config.steps, agent=self._ids, track=self._swarm.track)
        self._write(SLOT_RECORD, at, at, record)

    def slot(self, slot: int) -> None:
        """Fly the next slot, and record it as that of a number."""
        swarm, n, start = self._swarm, self.config.agents, SECOND + slot * self.config.slot_ns
        end, flown = start + self.config.slot_ns, self._next
        self._next += 1
        self._write("/swarm/slot", start, start, slot=slot, phase=0, heard_slot=max(0, slot - 1), **self._delivery)
        swarm.scenario.advance(flown, swarm)
        senders = swarm.begin(flown)
        frames = [swarm.frame(k) for k in senders]
        data = np.frombuffer(b"".join(frames), np.uint8)
        self.answer(slot, data)
        names = [REASONS[code] for code in sorted(set(swarm.reason.tolist()))]
        decision = {
            "slot": slot, "agent": self._ids, "chosen": swarm.chosen.copy(), "reason_name": names,
            "reason_index": np.array([names.index(REASONS[c]) for c in swarm.reason], np.uint8),
            "reason": swarm.reason.copy(), "digest": swarm.digest.copy(), "score": swarm.score.copy(),
        }  # fmt: skip
        swarm.fly(flown)
        alone, heard = len(senders) == 1, np.zeros((len(senders), n), np.uint8)
        if alone:
            heard[0] = self._random.random(n) >= self.loss
            heard[0, senders[0]] = 0
            swarm.hear(flown, frames[0], heard[0])
        swarm.end(flown)
        sender = np.array([k + 1 for k in senders], np.uint16)
        received = np.packbits(heard, axis=1, bitorder="little").ravel()
        self._delivery = {
            "sender": sender, "length": np.array([len(frame) for frame in frames], np.uint8), "data": data,
            "received": received,
        }  # fmt: skip
        lost = np.array([n - 1 - heard[0].sum()] if alone else [0] * len(senders), np.uint16)
        collided = np.array([0] if alone else [n - 1] * len(senders), np.uint16)
        record = pack_record(
            RUN, slot, start, self.config.steps, min(2, len(senders)), **self._begin,
            **frame_fields(dict(zip(sender.tolist(), frames, strict=True)), heard.astype(np.bool_)), lost=lost,
            collided=collided,
        )  # fmt: skip
        self._write(SLOT_RECORD, start, start, record)
        self._write(
            "/swarm/reception", end, end, slot=slot, outcome=min(2, len(senders)), sender=sender, received=received,
            lost=lost, collided=collided,
        )  # fmt: skip
        self._write("/swarm/decision", end, start, **decision)
        for number, packed in enumerate(self._odometry.pack(end, swarm.position, swarm.velocity), 1):
            self._write(f"/cf{number}/odom", end, end, packed)
        if slot % 10 == 0:
            state = np.isin(self._ids, sender).astype(np.uint8) + 1
            self._write("/swarm/markers", end, end, self._markers.pack(end, swarm.position, state, swarm.goal))


def synthetic_run(directory: Path, agents: int = 4, **options: Any) -> SyntheticRun:
    """TDMA without losses."""
    return SyntheticRun(directory, SwarmConfig(agents=agents, policy="tdma", seed=7), **options)


def synthetic_bag(directory: Path, slots: int = 100, **options: Any) -> SyntheticRun:
    run = synthetic_run(directory, **options)
    with run.writer:
        for slot in range(slots):
            run.slot(slot)
    return run


def flight_bag(directory: Path, slots: int = 400, loss: float = 0.0, **settings: Any) -> None:
    """Fly and record a number of slots with fields of `SwarmConfig`; a receiver loses a frame with a probability."""
    run = SyntheticRun(directory, SwarmConfig(**settings), loss, whole=False)
    with run.writer:
        for slot in range(slots):
            run.slot(slot)
        run.end(slots)


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
    seconds, nanoseconds = struct.unpack_from("<iI", bytes.fromhex(data), 4)
    return seconds * SECOND + nanoseconds


def as_it_arrives(data: bytes) -> str:
    """A recorded message, hexadecimal: the middleware fills the last word up with zeros."""
    return (data + bytes(-len(data) % 4)).hex()


def rewrite(
    source: Path,
    target: Path,
    edit: Callable[[list[BagMessage]], list[BagMessage]] = list,
    more: Callable[[Writer], None] = lambda _: None,
    records: bool = True,
    without: str | None = None,
    encodings: Mapping[str, str] = MappingProxyType({}),
    **options: Any,
) -> Path:
    """Write a bag's file again with other messages and options of another writer: what a careful forger would write.

    :param more: adds what stands before the messages.
    :param records: of metadata are kept, which `mcap filter` does not do.
    :param without: a word; lines of metadata with it are left out.
    :param encodings: of messages, by topic.
    """
    target.parent.mkdir(exist_ok=True)
    with Bag(source) as bag:
        path, messages = bag.path, edit(list(bag.messages()))
    with path.open("rb") as old, target.open("wb") as new:
        reader, writer = make_reader(old), Writer(new, **({"chunk_size": 20_000} | options))
        writer.start(profile="ros2")
        for record in reader.iter_metadata() if records else ():
            texts = {key: text.splitlines() for key, text in record.metadata.items()}
            kept = {key: [line for line in lines if not without or without not in line] for key, lines in texts.items()}
            writer.add_metadata(record.name, {key: "\n".join(lines) for key, lines in kept.items()})
        channels, summary = {}, reader.get_summary()
        for channel in summary.channels.values():
            schema, encoding = (
                summary.schemas[channel.schema_id],
                encodings.get(channel.topic, channel.message_encoding),
            )
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.topic] = writer.register_channel(channel.topic, encoding, number, channel.metadata)
        more(writer)
        for m in messages:
            writer.add_message(channels[m.topic], m.log_time_ns, m.data, m.publish_time_ns, m.sequence)
        writer.finish()
    return target
