"""The messages of a bag in one pass: records, changes of the channel, odometry, and the digest of all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import RUN_MESSAGES
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.bag.cdr import OdometryPacker
from dtsa_bench.log.bag.errors import UnusableBag
from dtsa_bench.log.bag.metadata import RUN_ID
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.writer import BROKEN_OFF, KEY, BagDigest
from dtsa_bench.log.record import AGENT, SLOT_RECORD, SNIFFER

from .result import Difference, Mismatch, Result

EVENTS = "/parameter_events"
MERGED = "merged"


class BagContents:
    """The messages of a bag in one pass: records, changes of the channel, odometry, and the digest of all.

    Of a bag of which a part is lost, records count up to there: those that follow depend on what is lost.

    :raises Mismatch: if times, numbers or the run's id of a message are wrong, or one is missing.
    """

    def __init__(self, bag: Bag, slot_ns: int, agents: int, result: Result) -> None:
        self._slot_ns, self._agents, self._result = slot_ns, agents, result
        self._decode = bag.decode
        self.records: list[Any] = []
        self.changes: list[tuple[int, dict[str, Any]]] = []  # slot, values
        self._odometry: list[tuple[int, int, bytes]] = []  # slot, agent, message
        self._digest, self._recorded = BagDigest(), bag.custom_data.get(KEY)
        self._partial, self._whole = result.mode in (AGENT, SNIFFER), result.mode not in (AGENT, SNIFFER, MERGED)
        self._whole_ns = 1 << 63  # log time up to which nothing is lost
        if result.broken_off:
            self._whole_ns = _number(bag, BROKEN_OFF)
        sequences: dict[str, int] = {}
        topics = {name: (name.encode(), info.type in RUN_MESSAGES) for name, info in bag.topics.items()}
        run = _number(bag, RUN_ID, 16) if RUN_ID in bag.custom_data else 0
        for message in bag.messages():
            encoded, has_run = topics[message.topic]
            times = message.log_time_ns, message.publish_time_ns
            self._digest.add(encoded, *times, message.sequence, message.data, has_run)
            expected = sequences.get(message.topic, 0)
            sequences[message.topic] = message.sequence + 1
            slot = max(0, (message.log_time_ns - names.TIME_ZERO_NS) // slot_ns)
            if message.sequence != expected and not result.broken_off:
                why = "messages of a topic are numbered one after the other"
                what = f"{message.topic}, sequence number"
                raise Mismatch(Difference(what, str(expected), str(message.sequence), why, slot))
            if message.log_time_ns > self._whole_ns:
                continue
            if message.topic == SLOT_RECORD:
                self._add_record(message, run)
            elif message.topic == EVENTS:
                values = {p.name: parameter_value(p.value) for p in bag.decode(message).changed_parameters}
                if values:
                    self.changes.append((slot, values))
                    result.count("channel changes")
            elif message.topic.endswith("/odom"):
                agent = message.topic.split("/")[1][2:]
                self._odometry.append((slot, int(agent) if agent.isdigit() else 0, message.data))

    def _add_record(self, message: BagMessage, run: int) -> None:
        record = self._decode(message)
        slot, stamp = int(record.slot), record.header.stamp
        right = message.log_time_ns if self._partial else names.slot_time_ns(slot, self._slot_ns)
        for what, expected, recorded in (
            ("log time", right, message.log_time_ns),
            ("publish time", right, message.publish_time_ns),
            ("stamp", right, int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)),
            ("run", run, int(record.run)),
            ("frame_id", names.FRAME, record.header.frame_id),
        ):
            if expected != recorded and not (what == "run" and not run):
                why = "slots start one slot length after the other" if what != "run" else "the run's id"
                raise Mismatch(Difference(f"slot record, {what}", str(expected), str(recorded), why, slot))
        following = int(self.records[-1].slot) + 1 if self.records else 0
        if slot != following and (self._whole or (self.records and not self._partial)):
            if self._result.broken_off and slot > following:  # in real time records are written after other messages
                self._whole_ns = message.log_time_ns - 1
                return
            why = "each slot has one record"
            raise Mismatch(Difference("slot record", f"one of slot {following}", f"slot {slot}", why, following))
        self.records.append(record)

    def changes_by_slot(self) -> dict[int, dict[str, Any]]:
        """New values of the channel's settings, by the first slot in which they hold."""
        found: dict[int, dict[str, Any]] = {}
        for slot, values in self.changes:
            found.setdefault(slot, {}).update(values)
        return found

    def check_odometry(self, log: FlightArrays) -> None:
        """Whether odometry is where the records say that the agents were."""
        frames = [names.body_frame(names.agent_namespace(agent)) for agent in range(1, self._agents + 1)]
        packer = OdometryPacker(frames, names.FRAME)
        row = -1
        expected: list[bytes] = []
        for slot, agent, data in self._odometry:
            at = slot if log.merged is None else slot - log.first_slot
            if not (0 <= at < len(log) and 1 <= agent <= self._agents and log.known[at, agent - 1]):
                continue
            if at != row:
                row = at
                time_ns = names.slot_time_ns(slot, self._slot_ns)
                expected = packer.pack(time_ns, log.track[at, -1], log.velocity[at])
            if data != expected[agent - 1]:
                raise Mismatch(Difference("odometry", "the recorded position and velocity", "another message",
                                          "odometry is the true motion", slot, agent))  # fmt: skip
            self._result.count("odometry")

    def check_digest(self) -> None:
        """Compare the digest of all messages with the one that the recorder wrote when it closed the bag.

        :raises Mismatch: if they differ.
        """
        if self._recorded is None:
            self._result.skipped["digest of all messages"] = "the bag holds none: it was not closed by its recorder"
            return
        found = self._digest.hexdigest()
        if found != self._recorded:
            why = "a message was changed, left out, added or moved after the recording"
            raise Mismatch(Difference("digest of all messages", self._recorded, found, why))
        self._result.count("digest of all messages")


def _number(bag: Bag, key: str, base: int = 10) -> int:
    """A whole number in custom data."""
    try:
        return int(bag.custom_data[key][:20], base)
    except ValueError:
        raise UnusableBag(bag.given, f"{key} in its metadata is no number: {bag.custom_data[key][:20]!r}") from None


def parameter_value(value: Any) -> Any:
    """A rcl_interfaces/ParameterValue as a plain value."""
    fields = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value"}
    return getattr(value, fields[int(value.type)]) if int(value.type) in fields else None


def recorded_summary(log: FlightArrays, result: Result) -> dict[str, Any]:
    """The `summary.json` beside a bag; empty without one."""
    if result.broken_off:
        result.skipped["summary.json"] = "the recording breaks off before the end of the flight"
        return {}
    path = Path(str(log.file)).parent.parent / "summary.json"
    if not path.is_file():
        result.skipped["summary.json"] = "not beside the bag"
        return {}
    return dict(json.loads(path.read_text(encoding="utf-8")))
