"""Checks the bag of a run in real time: on agents' own clocks, or with vehicles that are not simulated.

Such a run cannot be flown again bit for bit, because it depends on when things happened. What the frames, the times and
the verdicts in its bag must have in common can be checked all the same.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from dtsa_agent.core import REASONS
from dtsa_agent.keys import VARIABLE
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.packing import split_frames, unpack_received
from dtsa_bench.recordings.bag.reader import Bag, Message
from dtsa_bench.recordings.rules.judge import Judge
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .decisions import Decisions
from .frames import SentFrames
from .intake import Intake
from .lockstep import parameter_value
from .odometry import Report, odometry_fault
from .own_states import OwnStates
from .rebuild import DECISION, RECEPTION, SLOT, TRANSMISSION
from .result import Difference, Mismatch, Result
from .stream import Streams

EVENTS = "/parameter_events"
FRAME, REPORT = (f"{names.SWARM}/{topic}" for topic in (names.AIR_FRAME, names.REPORT))
REALTIME = "realtime"
_RUN = 0  # Slot.RUN
_SECOND = 1_000_000_000


def stamp_ns(stamp: Any) -> int:
    """A builtin_interfaces/Time as ns."""
    return int(stamp.sec) * _SECOND + int(stamp.nanosec)


class RealtimeCheck:
    """One pass over the bag of a run in real time."""

    def __init__(self, bag: Bag, result: Result) -> None:
        self.bag, self.result = bag, result
        self.own_clocks = result.mode == REALTIME
        # Missions say what they fly with instead of a mode of runs.
        self.run = RunConfig.from_dict({**bag.config, "mode": REALTIME})
        self.agents, self.slot_ns = self.run.swarm.agents, self.run.swarm.slot_ns
        kept = {SLOT, TRANSMISSION, DECISION, RECEPTION, EVENTS}
        self.streams = Streams(bag, kept.__contains__)
        self._own_states = OwnStates(self.run.swarm, result)
        self.frames = SentFrames(self.run.air, self.own_clocks)
        self.position = np.full((3, self.agents), np.nan)  # m, true, as last reported
        self._slots = np.full(self.agents, -1, dtype=np.int64)  # last slot that each has answered
        self._places: list[list[Report]] = [[] for _ in range(self.agents)]
        self._decided: dict[int, dict[int, tuple[int, int, int, float]]] = {}
        self._digests = np.zeros(self.agents, dtype=np.uint32)  # in the decisions of the slot before
        self._carried: set[tuple[int, int]] = set()  # slot and agent whose report missed the slot's account
        self._events: list[tuple[int, dict[str, Any]]] = []
        self._starts: dict[int, dict[int, int]] = {}  # ns, by slot and agent
        self._last_stamp = 0
        self._apart = FRAME in bag.topics  # frames have messages of their own
        self._unsent: dict[int, list[int]] = {}  # agents whose frame was too late to be sent, by slot
        self._told: dict[int, set[int]] = {}  # who is in the transmissions, by slot

    def check(self) -> None:
        """Goes through the bag.

        :raises Mismatch: at the first difference.
        """
        try:
            if self._apart:
                self._load_frames()
                if self.run.air.airtime.line.serial:
                    self._lay()
            self._messages()
        finally:  # those that were looked at, wherever it ends
            self.result.slots = int(self._slots.max()) + 1
            self.result.simulated_s = self.result.slots * self.run.swarm.slot_s
        self._finish()

    def _messages(self) -> None:
        rest = (DECISION, SLOT, RECEPTION, EVENTS)
        handlers = dict(zip(rest, (self._decision, self._slot, self._reception, self._event), strict=True))
        while (message := self.streams.take(TRANSMISSION)) is not None:
            self._transmission(message)
            # What was heard or judged until now was sent before; the slot's own transmissions come first.
            for topic in rest:
                for other in self.streams.at_hand(topic, message.log_time_ns - 1):
                    handlers[topic](other)
        for topic in rest:
            while (left := self.streams.take(topic)) is not None:
                handlers[topic](left)

    def _finish(self) -> None:
        result, frames = self.result, self.frames
        summary = self._summary()
        # Apart from all else, frames that came too late are not in the bag.
        late = 0 if self._apart else summary.get("late_frames", frames.dropped if result.broken_off else 0)
        for what, times in frames.check_overlaps(late).items():
            result.count(what, times)
        missed = summary.get("missed_reports", len(self._carried))
        if len(self._carried) > missed:
            why = "only who reported too late is missing from its slot's account"
            self._fail("decision", f"{missed} late reports", len(self._carried), why, None)
        if self._carried:
            result.skipped["decisions of agents that reported too late"] = f"{len(self._carried)} in all"
        if late and frames.dropped != late:
            result.skipped["verdicts on frames that met another"] = (
                f"{late} frames came too late to be on the air, {frames.dropped} are known"
            )
        if self.own_clocks and (self.run.air.range_m or self.run.air.capture_db):
            result.skipped["the channel's verdicts"] = "they depend on where all were when each frame was settled"
        else:
            result.count("verdicts made again", frames.check_verdicts(self._events, late))
        if REPORT in self.bag.topics:
            self._reports(summary)
        self._odometry()
        self._judge()
        self.streams.check_digest(result)
        if REPORT in self.bag.topics:
            result.skipped["motion"] = "it depends on when in a slot each message reached each process"
        else:
            result.skipped["decisions and motion"] = (
                "they depend on when each message reached each process, which the bag does not hold"
            )
        for topic in self.bag.topics:
            if topic not in (SLOT, TRANSMISSION, FRAME, REPORT, DECISION, RECEPTION, EVENTS) and not topic.endswith(
                "/odom"
            ):
                result.skipped[topic] = "carries nothing that is not in other topics; covered by the digest"
        result.safety |= frames.safety()
        if self.own_clocks:
            spread = [max(s.values()) - min(s.values()) for s in self._starts.values() if len(s) > 1]
            result.safety["clock_spread_max_ms"] = max(spread, default=0) / 1e6
            result.safety["clock_spread_mean_ms"] = float(np.mean(spread)) / 1e6 if spread else 0.0

    def _judge(self) -> None:
        """Whether the frames keep to the rules; those that came too late to be sent were made all the same."""
        judge = Judge(self.run.swarm)
        slots: dict[int, dict[int, bytes]] = {}
        for sent in self.frames.all():
            slots.setdefault(sent.slot, {})[sent.sender] = sent.data
        for slot in sorted({*slots, *self._unsent}):
            judge.slot(slot, slots.get(slot, {}), unrecorded=self._unsent.get(slot, ()))
        self.result.take_judgement(judge)

    def _fail(
        self, what: str, expected: Any, recorded: Any, why: str, slot: int | None, agent: int | None = None
    ) -> NoReturn:
        raise Mismatch(Difference(what, str(expected), str(recorded), why, slot, agent))

    # What the agents said.

    def _transmission(self, message: Message) -> None:
        said = self.bag.decode(message)
        slot, ids, count = int(said.slot), [int(i) for i in said.agent], len(said.agent)
        if not ids or ids != sorted(set(ids)) or not 1 <= ids[0] <= ids[-1] <= self.agents:
            self._fail("transmission.agent", f"ascending ids from 1 to {self.agents}", ids, "the swarm's", slot)
        offsets = said.offset_ns.tolist() if self.own_clocks else [0] * count
        try:
            frames = split_frames(said.data.tobytes(), said.length.tolist())
            track = said.track.reshape(said.steps, 3, count)
            velocity, command = said.velocity.reshape(3, count), said.command.reshape(3, count)
            if not len(offsets) == len(frames) == count:
                raise ValueError(f"{len(offsets)} offsets, {len(frames)} lengths, {count} agents")
        except ValueError as error:
            self._fail("transmission", "fields that fit together", str(error), "one entry an agent", slot, ids[0])
        self._equal_time(
            "transmission.stamp", names.slot_time_ns(slot, self.slot_ns), stamp_ns(said.header.stamp), slot
        )
        decided = self._decided.setdefault(slot, {})
        starts = self._starts.setdefault(slot, {})
        for k, agent in enumerate(ids):
            last = int(self._slots[agent - 1])
            if slot <= last:
                why = "slots come one after the other"
                self._fail("transmission.slot", f"more than {last}", slot, why, slot, agent)
            self._slots[agent - 1] = slot
            if not frames[k]:  # a frame may leave late; the slot starts when it starts
                starts[agent] = int(offsets[k])
            decided[agent] = int(said.chosen[k]), int(said.reason[k]), int(said.digest[k]), float(said.score[k])
            self.position[:, agent - 1] = track[-1, :, k]
            self._places[agent - 1].append((slot, track[-1, :, k].copy(), float(np.linalg.norm(velocity[:, k]))))
            if frames[k]:
                self._own_states.check(slot, agent, frames[k], track[-1, :, k], velocity[:, k], command[:, k])
                self._sent(slot, agent, slot * self.slot_ns + int(offsets[k]), frames[k])
        if not self.own_clocks:
            self.frames.place(slot, self.position)
        self._told[slot] = self._told.get(slot, set()) | set(ids)
        self.result.count("transmission")

    def _load_frames(self) -> None:
        """All frames, as they were handed to the channel."""
        for _, said in self.bag.typed([FRAME]):
            slot, agent = int(said.slot), int(said.agent)
            if not 1 <= agent <= self.agents or self.frames.get(slot, agent) is not None:
                self._fail("frame.agent", "one frame an agent and slot", f"cf{agent}", "the swarm's", slot)
            self.frames.send(slot, agent, stamp_ns(said.header.stamp) - names.TIME_ZERO_NS, said.data.tobytes())

    def _lay(self) -> None:
        """When frames began and arrived: that depends on what each radio had received before."""
        received = {}
        for _, said in self.bag.typed([SLOT]):
            slot, count = int(said.heard_slot), len(said.sender)
            if int(said.phase) == _RUN and len(said.received) == count * -(-self.agents // 8):
                masks = unpack_received(said.received.tobytes(), count, self.agents).astype(bool)
                received |= {(slot, sender): mask for sender, mask in zip(said.sender.tolist(), masks, strict=True)}
        self.frames.lay(received)

    def _sent(self, slot: int, agent: int, start_ns: int, data: bytes) -> None:
        """A frame in a transmission: it goes out now, or is the one that has been handed over by itself."""
        if not self._apart:
            self.frames.send(slot, agent, start_ns, data)
            return
        sent = self.frames.get(slot, agent)
        if sent is None or sent.data != data:
            recorded = "none" if sent is None else sent.data.hex()
            self._fail("transmission.data", recorded, data.hex(), "the frame that was handed over", slot, agent)
        self._equal_time("transmission.offset_ns", sent.asked_ns, start_ns, slot, agent)

    def _note_unsent(self, said: Any) -> None:
        """Takes note of the agents that took themselves for the sender and did not send: what they made is unknown."""
        ids = np.tile(said.agent, len(said.slot))
        for at in np.flatnonzero((np.asarray(said.chosen) == ids) & (np.asarray(said.length) == 0)):
            self._unsent.setdefault(int(said.slot[at // len(said.agent)]), []).append(int(ids[at]))

    def _reports(self, summary: dict[str, Any]) -> None:
        """What the agents took in had been delivered to them, and what they reported is in the transmissions."""
        intake, untold = Intake(self.frames, self.result.slots), 0
        replayable = self._own_states.has_key or not self.run.swarm.auth
        decisions = Decisions(self.run, self.frames) if replayable else None
        for _, said in self.bag.typed([REPORT]):
            intake.report(said)
            if decisions is not None:
                decisions.report(said)
            self._note_unsent(said)
            ids = set(said.agent.tolist())
            untold += sum(len(ids - self._told.get(s, set())) for s in said.slot.tolist() if s < self.result.slots)
        missed = summary.get("missed_reports", untold)
        if untold > missed:
            self._fail("transmission", f"all but {missed} entries of reports", f"all but {untold}",
                       "only who reported too late is missing", None)  # fmt: skip
        self.result.count("frames taken in as they were delivered", intake.checked)
        self.result.unheard = intake.hearing(self.result.slots).problem(summary.get("not_taken_in"))
        if decisions is None:
            self.result.skipped["decisions"] = f"no key in {VARIABLE}"
        else:
            self.result.count("decisions made again", decisions.check(self.result.slots))
        self.result.safety |= intake.summary() | {"stalls": summary.get("stalls", [])}

    def _equal_time(self, what: str, expected: int, recorded: int, slot: int, agent: int | None = None) -> None:
        if expected != recorded:
            self._fail(what, f"{expected} ns", f"{recorded} ns", "the time line of the channel", slot, agent)

    # What the channel said.

    def _slot(self, message: Message) -> None:
        """A slot message: what it delivers has been sent, and its sender is not among the receivers."""
        said = self.bag.decode(message)
        slot, count = int(said.heard_slot), len(said.sender)
        stamp = stamp_ns(said.header.stamp)
        if self.own_clocks and message.log_time_ns < self._last_stamp:
            later = f"at {self._last_stamp} ns or later"
            self._fail("slot messages", later, message.log_time_ns, "in order of time", slot)
        self._last_stamp = message.log_time_ns
        if int(said.phase) != _RUN:
            return
        if not self.own_clocks:
            self._equal_time("slot.stamp", names.slot_time_ns(int(said.slot), self.slot_ns), stamp, int(said.slot))
        try:
            masks = unpack_received(said.received.tobytes(), count, self.agents).astype(bool)
            frames = split_frames(said.data.tobytes(), said.length.tolist())
            if len(frames) != count:
                raise ValueError(f"{len(frames)} frames of {count} senders")
        except ValueError as error:
            self._fail("slot", "fields that fit together", str(error), "one entry a frame", slot)
        for sender, frame, mask in zip(said.sender.tolist(), frames, masks, strict=True):
            if self.own_clocks:
                self._catch_up(slot, sender)
            sent = self.frames.deliver(slot, sender, frame, mask)
            if self.own_clocks:
                arrival = names.TIME_ZERO_NS + max(0, sent.arrival_ns)
                self._equal_time("slot.stamp", arrival, stamp, slot, sender)
            self.result.count("frames heard as they were sent")
        self.result.count("slot")

    def _catch_up(self, slot: int, sender: int) -> None:
        """Goes on to the report in which a frame was sent.

        Reports lie in the bag where the channel's slots start. Whoever has a fast clock is heard before that.
        """
        while self.frames.get(slot, sender) is None and (message := self.streams.take(TRANSMISSION)) is not None:
            self._transmission(message)

    def _reception(self, message: Message) -> None:
        """The channel's verdict: the same receivers as in the slot messages, and numbers that add up."""
        said = self.bag.decode(message)
        slot, count = int(said.slot), len(said.sender)
        self._equal_time(
            "reception.stamp", names.slot_time_ns(slot + 1, self.slot_ns), stamp_ns(said.header.stamp), slot
        )
        outcome = IDLE if not count else COLLISION if said.collided.any() else SUCCESS
        if outcome != int(said.outcome):
            self._fail("reception.outcome", outcome, int(said.outcome), "who sent and what collided decide", slot)
        masks = unpack_received(said.received.tobytes(), count, self.agents).astype(bool)
        for k, sender in enumerate(said.sender.tolist()):
            verdict = masks[k], int(said.lost[k]), int(said.collided[k])
            if int(masks[k].sum()) + verdict[1] + verdict[2] > self.agents - 1:
                limit = f"at most {self.agents - 1} receivers"
                self._fail("reception", limit, "more", "each counts once", slot, sender)
            self.frames.judged(slot, sender, *verdict)
        self.result.count("reception")

    def _decision(self, message: Message) -> None:
        """The decisions of a slot are those that the agents reported; who was late is taken to be as before."""
        said = self.bag.decode(message)
        slot = int(said.slot)
        decided = self._decided.pop(slot, {})
        if self._apart:
            unsaid = [int(agent) for agent, chosen in zip(said.agent, said.chosen, strict=True)
                      if chosen and int(agent) not in decided]  # fmt: skip
            if unsaid:
                why = "who did not report in time is taken to have chosen nobody"
                self._fail("decision.chosen", "nobody, or a transmission", "a choice", why, slot, unsaid[0])
        for agent, reported in decided.items():
            k = agent - 1
            recorded = int(said.chosen[k]), int(said.reason[k]), int(said.digest[k]), float(said.score[k])
            if recorded != reported and recorded == (0, 0, int(self._digests[k]), 0.0):
                self._carried.add((slot, agent))
                continue
            if recorded != reported:
                self._fail("decision", reported, recorded, "as the agent reported", slot, agent)
            name = said.reason_name[int(said.reason_index[k])]
            if reported[1] < len(REASONS) and name != REASONS[reported[1]]:
                self._fail("decision.reason_name", REASONS[reported[1]], name, "the reason's code", slot, agent)
        self._digests = said.digest
        self.result.count("decision")

    def _event(self, message: Message) -> None:
        """A change of the channel's settings, made while it ran."""
        values = {p.name: parameter_value(p.value) for p in self.bag.decode(message).changed_parameters}
        slot = (message.log_time_ns - names.TIME_ZERO_NS) // self.slot_ns
        self._events.append((slot, values))

    # What was recorded beside it.

    def _odometry(self) -> None:
        """Odometry is where the agents reported to be; between reports no faster than a vehicle can be."""
        topics = [f"{names.agent_namespace(agent)}/{names.ODOMETRY}" for agent in range(1, self.agents + 1)]
        fields = [f"pose.pose.position.{axis}" for axis in "xyz"]
        tables = self.bag.tables([topic for topic in topics if topic in self.bag.topics], fields)
        for agent, topic in enumerate(topics, 1):
            reports = self._places[agent - 1]
            if topic not in tables or not reports or not len(tables[topic]["log_time_ns"]):
                self.result.skipped[topic] = "not recorded"
                continue
            table = tables[topic]
            times = table["log_time_ns"]
            found = np.column_stack([table[name] for name in fields])
            seen = (times - names.TIME_ZERO_NS) // self.slot_ns
            carried = np.array([(int(slot), agent) in self._carried for slot in seen])
            fault = odometry_fault(times, found, carried, reports, self.slot_ns)
            if fault is not None:
                row, away, allowed = fault
                self._fail(topic, f"within {allowed:.6f} m of the reported place", f"{away:.6f} m away",
                           "odometry is the true motion", int(seen[row]), agent)  # fmt: skip
            self.result.count("odometry", len(times))

    def _summary(self) -> dict[str, Any]:
        if self.result.broken_off:
            self.result.skipped["summary.json"] = "the recording breaks off before the end of the flight"
            return {}
        path = Path(self.bag.path).parent.parent / "summary.json"
        if not path.is_file():
            self.result.skipped["summary.json"] = "not beside the bag"
            return {}
        found = json.loads(path.read_text(encoding="utf-8"))
        recorded, judged = found.get("slots", {}).get("total"), self.result.checked.get("reception", 0)
        if recorded is not None and abs(recorded - judged) > 1:
            self._fail("summary.json: slots", judged, recorded, "each slot has one verdict", None)
        self.result.count("summary.json")
        return dict(found)
