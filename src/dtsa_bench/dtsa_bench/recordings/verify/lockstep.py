"""Checks a lockstep bag: everything in it can be made again from the configuration, so everything must be equal."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dtsa_agent.ros.common.graph.names import slot_time_ns
from dtsa_bench.recordings.bag.metadata import RUN_ID
from dtsa_bench.recordings.bag.reader import Bag, Message
from dtsa_bench.recordings.rules.judge import Judge
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import FlightMetrics

from .explain import WHY, differing
from .layout import equal_but_padding
from .rebuild import DECISION, RECEPTION, SLOT, TRANSMISSION, Expected, Rebuild, first_agent
from .result import Difference, Mismatch, Result
from .stream import Streams

EVENTS = "/parameter_events"
_NOT_COMPARED = ("wall_time_s", "realtime_factor", "unusable_messages", "not_taken_in")


class LockstepCheck:
    """One pass over a lockstep bag."""

    def __init__(self, bag: Bag, result: Result, progress: Callable[[int], None] | None = None) -> None:
        self.bag, self.result, self._progress = bag, result, progress
        self.run = RunConfig.from_dict(bag.config)
        kept = {SLOT, TRANSMISSION, DECISION, RECEPTION, EVENTS}
        self.streams = Streams(bag, lambda topic: topic in kept or topic.endswith("/odom"))
        for topic in bag.topics:
            if topic not in kept and not topic.endswith("/odom"):
                result.skipped[topic] = "carries nothing that is not in other topics; covered by the digest"
        self.agreement = True  # all agents chose the same sender in every slot
        self.crowded = 0  # slots with more than one sender
        self.judge = Judge(self.run.swarm)

    def check(self) -> None:
        """Goes through all slots.

        :raises Mismatch: at the first difference.
        """
        begin = slot_time_ns(0, self.run.swarm.slot_ns)
        groups = [tuple(int(i) for i in self.bag.decode(m).agent) for m in self.streams.first(TRANSMISSION, begin)]
        self._check_groups(groups)
        run_id = int(self.bag.custom_data.get(RUN_ID, "0"), 16)
        self.rebuild = Rebuild(self.run, self.bag.typestore, sorted(groups), run_id)
        self.metrics = FlightMetrics(self.run, self.rebuild.swarm.scenario)
        try:
            while self._slot():
                if self._progress and self.rebuild.slot % 100 == 0:
                    self._progress(self.rebuild.slot)
        finally:  # those that are equal, wherever it ends
            self.result.slots = self.metrics.slots
            self.result.simulated_s = self.metrics.slots * self.run.swarm.slot_s
        self._check_rest()
        self.streams.check_digest(self.result)
        self._check_summary()
        self.result.unheard = self.rebuild.hearing.problem()
        self._safety()

    def _check_groups(self, groups: list[tuple[int, ...]]) -> None:
        answered = sorted(agent for group in groups for agent in group)
        everyone = list(range(1, self.run.swarm.agents + 1))
        if answered != everyone:
            raise Mismatch(
                Difference(
                    "agents that answered",
                    str(everyone),
                    str(answered),
                    "every agent answers every slot once",
                    0,
                )
            )

    def _slot(self) -> bool:
        """One slot; False when the bag ends with it."""
        rebuild, streams = self.rebuild, self.streams
        opening = streams.take(SLOT)
        if opening is None:
            return False
        slot = rebuild.slot + 1
        begin = rebuild.time_ns(slot)
        self._compare(opening, rebuild.slot_message(), slot, begin, slot)
        rebuild.open()
        if not self._transmissions(slot, begin):
            return False
        decision = self._next(DECISION, slot)
        if decision is None:
            return False
        self._compare(decision, rebuild.decision(), slot, begin, slot)
        for topic, expected in zip(rebuild.odometry_topics, rebuild.odometry(), strict=True):
            message = self._next(topic, slot)
            if message is None:
                return False
            self._compare(message, expected, slot, begin, slot)
        # The verdict comes last in a slot: once it has been read, so have all changes that hold in this slot.
        message = self._next(RECEPTION, slot)
        if message is None:
            return False
        self._apply_changes(streams.at_hand(EVENTS, begin))
        verdict = rebuild.close()
        self._compare(message, rebuild.reception(), slot, rebuild.time_ns(slot + 1), slot)
        self.crowded += len(verdict.senders) > 1
        swarm = rebuild.swarm
        self.agreement = self.agreement and bool((swarm.chosen == swarm.chosen[0]).all())
        self.metrics.compare_tables(slot, swarm.digest, swarm.chosen)
        frames = {int(index) + 1: frame for index in swarm.sends.nonzero()[0] if (frame := swarm.frame(int(index)))}
        self.judge.slot(slot, frames)
        lengths = [len(frame) for frame in frames.values()]
        self.metrics.update(slot, swarm.track, swarm, verdict.outcome, lengths)
        return True

    def _transmissions(self, slot: int, begin: int) -> bool:
        """The answers of all processes; False if the recording ends among them."""
        expected = self.rebuild.transmissions()
        sequence = slot * len(expected)
        for _ in range(len(expected)):
            message = self.streams.take(TRANSMISSION)
            if message is None:
                if self.streams.rest() is None:
                    return False
                missing = sorted(expected)[0]
                raise Mismatch(Difference("transmission", "a message", "none", WHY["agent"], slot, missing))
            right = expected.pop(first_agent(message.data), None)
            if right is None:
                agents = list(getattr(self.bag.decode(message), "agent", []))
                raise Mismatch(
                    Difference(
                        "transmission.agent",
                        f"answers of {sorted(expected)}",
                        str(agents),
                        WHY["agent"],
                        slot,
                    )
                )
            self._compare(message, right, slot, begin, sequence)
            sequence += 1
        return True

    def _next(self, topic: str, slot: int) -> Message | None:
        """The message of a topic for this slot; None where the recording ends before it."""
        message = self.streams.take(topic)
        if message is None and self.streams.rest() is not None:
            raise Mismatch(Difference(topic, "a message", "none", "each slot has one", slot))
        return message

    def _compare(self, message: Message, expected: Expected, slot: int, time_ns: int, sequence: int) -> None:
        if message.data != expected.data and not equal_but_padding(message.data, expected.data, expected.mask):
            raise Mismatch(differing(self.bag, message, expected.data, slot))
        for what, right, recorded in (
            ("log_time", time_ns, message.log_time_ns),
            ("publish_time", time_ns, message.publish_time_ns),
            ("sequence number", sequence, message.sequence),
        ):
            if right != recorded:
                raise Mismatch(Difference(f"{message.topic}, {what}", str(right), str(recorded), WHY["slot"], slot))
        self.result.count("odometry" if message.topic.endswith("/odom") else message.topic.rsplit("/", 1)[-1])

    def _apply_changes(self, events: list[Message]) -> None:
        """Changes of the channel that somebody made while it ran."""
        for message in events:
            event: Any = self.bag.decode(message)
            values = {p.name: parameter_value(p.value) for p in event.changed_parameters}
            if values:
                self.rebuild.channel.set(slot=self.rebuild.slot, **values)
                self.result.count("channel changes")

    def _check_rest(self) -> None:
        left = self.streams.rest()
        if left is not None and left.topic != EVENTS:
            raise Mismatch(
                Difference(
                    f"{left.topic} at {left.log_time_ns} ns",
                    "nothing",
                    "a message",
                    "the slot message or another of its slot is missing",
                    self.rebuild.slot,
                )
            )

    def _check_summary(self) -> None:
        if self.result.broken_off:
            self.result.skipped["summary.json"] = "the recording breaks off before the end of the flight"
            return
        path = Path(self.bag.path).parent.parent / "summary.json"
        if not path.is_file():
            self.result.skipped["summary.json"] = "not beside the bag"
            return
        recorded = json.loads(path.read_text(encoding="utf-8"))
        expected = self.metrics.summary()
        for key, value in json.loads(json.dumps(expected)).items():
            if key in _NOT_COMPARED or key not in recorded or (key == "end" and recorded[key] == "stopped"):
                continue
            if recorded[key] != value:
                raise Mismatch(
                    Difference(
                        f"summary.json: {key}",
                        str(value),
                        str(recorded[key]),
                        "computed from the recorded flight",
                    )
                )
            self.result.count("summary.json")

    def _safety(self) -> None:
        closest, pair = self.metrics.closest()
        self.result.safety = {
            "slots_with_two_senders": self.crowded,
            "all_agents_chose_alike": self.agreement,
            "closest_pair_m": closest,
            "closest_pair": list(pair),
            "crashed": self.metrics.crash_slot >= 0,
        }
        self.result.take_judgement(self.judge)
        from dtsa_bench.simulation.simulate import may_share

        lossless = may_share(self.run) and not self.result.checked.get("channel changes")
        if lossless and (self.crowded or not self.agreement):
            raise Mismatch(
                Difference(
                    "two senders in one slot",
                    "never",
                    f"{self.crowded} slots",
                    "without loss all agents hear the same and choose the same",
                )
            )


def parameter_value(value: Any) -> Any:
    """A rcl_interfaces/ParameterValue as a plain value."""
    fields = {1: "bool_value", 2: "integer_value", 3: "double_value", 4: "string_value"}
    return getattr(value, fields[int(value.type)]) if int(value.type) in fields else None
