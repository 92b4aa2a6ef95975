"""The messages of a bag in one pass: records, changes of the channel, odometry, and the digest of all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.cdr import ns_of
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.bag.cdr import OdometryPacker
from dtsa_bench.log.bag.errors import BagError, UnusableBag
from dtsa_bench.log.bag.metadata import RUN_ID, load_json
from dtsa_bench.log.bag.reader import Bag, BagMessage
from dtsa_bench.log.bag.writer import BROKEN_OFF, KEY, BagDigest
from dtsa_bench.log.record import SLOT_RECORD, SNIFFER

from .result import Mismatch, Result

EVENTS = "/parameter_events"
MERGED = "merged"
_PARAMETER_VALUES = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value"}  # by type


class BagContents:
    """The messages of a bag in one pass: records, changes of the channel, odometry, and the digest of all.

    Of a bag of which a part is lost, records count up to there: those that follow depend on what is lost.

    :raises Mismatch: if times, numbers or the run's id of a message are wrong, or one is missing.
    """

    def __init__(self, bag: Bag, swarm: SwarmConfig, result: Result) -> None:
        self._bag, self._slot_ns, self._steps, self._result = bag, swarm.slot_ns, swarm.steps, result
        self.records: list[Any] = []
        self.changes: dict[int, dict[str, Any]] = {}  # of the channel's settings, by the first slot in which they hold
        self._odometry: list[tuple[int, int, bytes]] = []  # slot, agent, message
        self._run = _number(bag, RUN_ID, 16) if RUN_ID in bag.custom_data else None
        self._whole_ns = _number(bag, BROKEN_OFF) if result.broken_off else 1 << 63  # up to which nothing is lost
        self._digest, sequences = BagDigest(), dict.fromkeys(bag.topics, 0)
        ids = range(1, swarm.agents + 1)
        bodies = {f"{names.agent_namespace(agent)}/{names.ODOMETRY}": agent for agent in ids}
        for message in bag.messages():
            self._digest.add(*message)
            expected, slot = (
                sequences[message.topic],
                max(0, (message.log_time_ns - names.TIME_ZERO_NS) // swarm.slot_ns),
            )
            sequences[message.topic] = message.sequence + 1
            if message.sequence != expected and not result.broken_off:
                why = "messages of a topic are numbered one after the other"
                raise Mismatch(f"{message.topic}, sequence number", expected, message.sequence, why, slot)
            if message.log_time_ns > self._whole_ns:
                continue
            if message.topic == SLOT_RECORD:
                self._add_record(message)
            elif message.topic == EVENTS:
                if values := self._changed_values(message):
                    self.changes.setdefault(slot, {}).update(values)
                    result.count("channel changes")
            elif agent := bodies.get(message.topic):
                self._odometry.append((slot, agent, message.data))

    def _changed_values(self, message: BagMessage) -> dict[str, Any]:
        try:
            changed = {p.name: p.value for p in self._bag.decode(message).changed_parameters}
            return {n: getattr(v, _PARAMETER_VALUES.get(int(v.type), ""), None) for n, v in changed.items()}
        except (AttributeError, TypeError, ValueError) as error:  # of a type that has these names, but other fields
            raise BagError(f"{message.topic} at {message.log_time_ns} ns: no changed parameters ({error})") from None

    def _add_record(self, message: BagMessage) -> None:
        record, mode = self._bag.decode(message), self._result.mode
        slot = int(record.slot)
        right = message.log_time_ns if mode == SNIFFER else names.slot_time_ns(slot, self._slot_ns)
        on_time = "slots start one slot length after the other"
        for what, expected, recorded, why in (
            ("log time", right, message.log_time_ns, on_time),
            ("publish time", right, message.publish_time_ns, on_time),
            ("stamp", right, ns_of(record.header.stamp), on_time),
            ("run", record.run if self._run is None else self._run, record.run, "the run's id"),
            ("frame_id", names.FRAME, record.header.frame_id, "all positions are in one frame"),
            ("steps", self._steps, int(record.steps), "a slot has the control instants of the configuration"),
        ):
            if expected != recorded:
                raise Mismatch(f"slot record, {what}", expected, recorded, why, slot)
        following = int(self.records[-1].slot) + 1 if self.records else slot if mode == MERGED else 0
        if slot != following and mode != SNIFFER:
            if self._result.broken_off and slot > following:  # in real time records are written after other messages
                self._whole_ns = message.log_time_ns - 1
                return
            raise Mismatch(
                "slot record", f"one of slot {following}", f"slot {slot}", "each slot has one record", following
            )
        self.records.append(record)

    def check_odometry(self, log: FlightArrays) -> None:
        """Whether odometry is where the records say that the agents were."""
        bodies = [names.body_frame(names.agent_namespace(agent)) for agent in range(1, log.agents + 1)]
        packer, packed_row, expected = OdometryPacker(bodies), -1, list[bytes]()
        for slot, agent, data in self._odometry:
            row = slot if log.merged is None else slot - log.first_slot
            if not (0 <= row < len(log) and 1 <= agent <= log.agents and log.known[row, agent - 1]):
                continue
            if row != packed_row:
                time_ns, packed_row = names.slot_time_ns(slot, self._slot_ns), row
                expected = packer.pack(time_ns, log.track[row, -1], log.velocity[row])
            if data != expected[agent - 1]:
                values = "the recorded position and velocity", "another message"
                raise Mismatch("odometry", *values, "odometry is the true motion", slot, agent)
            self._result.count("odometry")

    def check_digest(self) -> None:
        """Compare the digest of all messages with the one that the recorder wrote when it closed the bag.

        :raises Mismatch: if they differ.
        """
        what, recorded, found = "digest of all messages", self._bag.custom_data.get(KEY), self._digest.hexdigest()
        if recorded is None:
            self._result.skipped[what] = "the bag holds none: it was not closed by its recorder"
        elif found != recorded:
            raise Mismatch(what, recorded, found, "a message was changed, left out, added or moved after the recording")
        else:
            self._result.count(what)


def _number(bag: Bag, key: str, base: int = 10) -> int:
    """A whole number in custom data."""
    try:
        return int(bag.custom_data[key][:20], base)
    except ValueError:
        raise UnusableBag(bag.given, f"{key} in its metadata is no number: {bag.custom_data[key][:20]!r}") from None


def recorded_summary(log: FlightArrays, result: Result) -> dict[str, Any]:
    """The `summary.json` beside a bag; empty without one."""
    path = Path(str(log.file)).parent.parent / "summary.json"
    if not result.broken_off and path.is_file():
        try:
            summary = load_json(path.read_text(encoding="utf-8"))
            parts = [summary.get(name) or {} for name in ("slots", "not_taken_in")]
            if not all(isinstance(part, dict) for part in parts):
                raise ValueError("slots, not_taken_in")
        except (ValueError, AttributeError, OSError) as error:
            raise Mismatch("summary.json", "results", f"others ({error})", "they are those of the flight") from None
        return dict(summary)
    why = "the recording breaks off before the end of the flight" if result.broken_off else "not beside the bag"
    result.skipped["summary.json"] = why
    return {}
