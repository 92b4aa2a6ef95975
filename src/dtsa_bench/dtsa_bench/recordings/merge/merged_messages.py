"""The messages of a merged flight: those of a flight in real time, as far as agents know them."""

from __future__ import annotations

import heapq
import json
import zlib
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dtsa_agent.air.datagram import frame_in
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.core import REASONS
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.cdr import SECOND
from dtsa_agent.ros.common.wire.packing import pack_received
from dtsa_bench.recordings.bag import schema
from dtsa_bench.recordings.bag.cdr import COLLIDED, SENDING, WAITING, MarkerPacker, OdometryPacker
from dtsa_bench.recordings.bag.errors import BagError
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .merged_flight import run_of
from .merged_run import ZERO_NS, MergedRun
from .timeline import Life

_SLOTS = 16  # of an agent in one report
_MARKERS_NS = 100_000_000  # from one picture of the swarm to the next
_SECTIONS = ("swarm", "limits", "mode")  # of the configuration: there is no simulated channel, and no simulated clocks
_FLYING, _ENDED = 1, 2  # RunStatus
_BITS = 0xFFFFFFFF  # slots have 32 bits in messages

TOPICS = {
    f"{names.SWARM}/{topic}": f"dtsa_msgs/msg/{kind}"
    for topic, kind in (
        (names.CONFIGURATION, "Configuration"),
        (names.STATUS, "RunStatus"),
        (names.RECEPTION, "Reception"),
        (names.REPORT, "Report"),
        (names.AIR_FRAME, "Frame"),
        (names.TRANSMISSION, "Transmission"),
        (names.DECISION, "Decision"),
    )
} | {f"{names.SWARM}/{names.MARKERS}": "visualization_msgs/msg/MarkerArray"}
LATCHED = {f"{names.SWARM}/{topic}" for topic in (names.CONFIGURATION, names.STATUS)}


class Out(NamedTuple):
    """A message of the bag."""

    time_ns: int
    topic: str
    data: bytes


class MergedMessages:
    """Packs a merged flight.

    :param config: as recorded; None: as it is recorded now.
    :raises BagError: if most slots are missing.
    """

    def __init__(self, run: MergedRun, config: Mapping[str, Any] | None = None) -> None:
        self._run, self._config = run, run.config
        self._slot_ns, self._first = run.config.slot_ns, run.common_slot
        self.config = config or {name: run_of(run.config).to_dict()[name] for name in _SECTIONS}
        self.run_id = zlib.crc32(json.dumps(run.about, sort_keys=True).encode()) or 1
        self._here: dict[int, dict[int, SlotRecord]] = {}  # by slot and agent
        heard: dict[tuple[int, int], set[int]] = {}
        for (agent, _), bag in sorted(run.lives.items()):
            for record in bag.slots:
                if record.slot >= self._first:
                    self._here.setdefault(record.slot, {})[agent] = record
                for one in (*record.before, *record.heard):
                    heard.setdefault((one.slot, one.sender), set()).add(agent)
        self._heard = heard
        self._last = max(self._here)
        if self._last - self._first >= 2 * len(self._here) + 1000 or self._last > _BITS:
            raise BagError(f"no agent tells of most of the slots {self._first} to {self._last}: no flight to record")
        self._senders: dict[int, dict[int, tuple[int, bytes]]] = {}  # by slot and agent: when, and what
        for (slot, agent), stray in run.strays.items():
            self._senders.setdefault(slot, {})[agent] = stray.sent_ns, stray.data
        for (agent, _), bag in run.lives.items():
            for record in bag.slots:
                if record.datagram:
                    said = record.sent_ns, frame_in(record.datagram, bag.swarm)
                    self._senders.setdefault(record.slot, {})[agent] = said

    @cached_property
    def _store(self) -> Any:
        store = get_typestore(Stores.EMPTY)
        for kind in TOPICS.values():
            found = get_types_from_msg(schema.installed(kind).text, kind)
            store.register({name: fields for name, fields in found.items() if name not in store.fielddefs})
        return store

    def __iter__(self) -> Iterator[Out]:
        """All messages in order of time."""
        parts = (
            iter([self._configuration()]), self._statuses(), self._receptions(), self._reports(), self._frames(),
            self._transmissions(), self._decisions(), self._odometry(), self._markers(),
        )  # fmt: skip
        return heapq.merge(*parts, key=lambda out: out.time_ns)

    def _out(self, topic: str, time_ns: int, stamp_ns: int, **fields: Any) -> Out:
        """A message of dtsa_msgs, as CDR."""
        name = f"{names.SWARM}/{topic}"
        types, kind = self._store.types, TOPICS[name]
        stamp = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, SECOND))
        header = types["std_msgs/msg/Header"](stamp, names.FRAME)
        message = types[kind](header=header, run=self.run_id, **fields)
        return Out(max(ZERO_NS, time_ns), name, bytes(self._store.serialize_cdr(message, kind)))

    def _at(self, slot: int) -> int:
        return names.slot_time_ns(slot, self._slot_ns)

    def _slots(self) -> Iterator[tuple[int, dict[int, SlotRecord]]]:
        for slot in range(self._first, self._last + 1):
            yield slot, self._here.get(slot, {})

    def _configuration(self) -> Out:
        return self._out(names.CONFIGURATION, ZERO_NS, ZERO_NS, mode=self.config["mode"],
                         settings=json.dumps(self.config, sort_keys=True))  # fmt: skip

    def _statuses(self) -> Iterator[Out]:
        """Who is there, at the first slot and at each change."""
        everybody, before = set(range(1, self._config.agents + 1)), None
        for slot, here in self._slots():
            if here.keys() != before:
                back = sorted(here.keys() - before) if before is not None else []
                yield self._status(slot, _FLYING, sorted(everybody - here.keys()), back, "")
                before = here.keys()
        lost = sorted(everybody - self._here[self._last].keys())
        yield self._status(self._last, _ENDED, lost, [], f"merged from {len(self._run.lives)} agents' bags")

    def _status(self, slot: int, phase: int, lost: Sequence[int], back: Sequence[int], reason: str) -> Out:
        at = self._at(slot)
        return self._out(
            names.STATUS, at, at, phase=phase, slot=slot & _BITS, awaited=_array((), "u2"), lost=_array(lost, "u2"),
            returned=_array(back, "u2"), lag_ms=0.0, reason=reason,
        )  # fmt: skip

    def _receptions(self) -> Iterator[Out]:
        """What became of each slot. Receivers of which there is no record are neither reached nor lost."""
        for slot, here in self._slots():
            senders = sorted(self._senders.get(slot, {}))
            mask = np.zeros((len(senders), self._config.agents), dtype=np.bool_)
            lost = []
            for row, sender in enumerate(senders):
                receivers = self._heard.get((slot, sender), set()) - {sender}
                mask[row, [agent - 1 for agent in receivers]] = True
                lost.append(len(here.keys() - receivers - {sender}))
            outcome = COLLISION if len(senders) > 1 else SUCCESS if senders else IDLE
            end = self._at(slot + 1)
            yield self._out(
                names.RECEPTION, end, end, slot=slot, outcome=outcome, sender=_array(senders, "u2"),
                received=np.frombuffer(pack_received(mask) if senders else b"", np.uint8),
                lost=_array(lost, "u2"), collided=np.zeros(len(senders), np.uint16),
            )  # fmt: skip

    def _reports(self) -> Iterator[Out]:
        parts = (self._reports_of(life) for life in sorted(self._run.lives))
        return heapq.merge(*parts, key=lambda out: out.time_ns)

    def _reports_of(self, life: Life) -> Iterator[Out]:
        """All that an agent has recorded, before the first common slot, too: its decisions follow from it."""
        records = self._run.lives[life].slots
        begins = [k for k, record in enumerate(records) if record.anew or not k]
        for start, end in pairwise([*begins, len(records)]):
            for at in range(start, end, _SLOTS):
                yield self._report(life[0], records[at : min(at + _SLOTS, end)])

    def _report(self, agent: int, records: Sequence[SlotRecord]) -> Out:
        at = self._at(records[-1].slot)
        heard = [((r.slot - 1) & _BITS, one) for r in records for one in r.before]
        heard += [(r.slot, one) for r in records for one in r.heard]
        frames = [frame_in(record.datagram, self._run.config) for record in records]
        return self._out(
            names.REPORT, at, at, agent=_array([agent], "u2"), slot=_array([r.slot for r in records], "u4"),
            offset_ns=_array([self._offset(record) for record in records], "i8"),
            length=_array([len(frame) for frame in frames], "u1"), **_decided(records),
            steps=len(records[0].track), track=_joined([r.track for r in records]), **_vectors(records),
            heard_sender=_array([one.sender for _, one in heard], "u2"),
            heard_slot=_array([one.slot for _, one in heard], "u4"), heard_in=_array([slot for slot, _ in heard], "u4"),
            heard_ns=_array([one.arrival_ns for _, one in heard], "i8"), heard_by=np.ones(len(heard), np.uint8),
        )  # fmt: skip

    def _offset(self, record: SlotRecord) -> int:
        return (record.sent_ns if record.datagram else record.start_ns) - record.slot * self._slot_ns

    def _frames(self) -> Iterator[Out]:
        found = [(at, slot, agent, data) for slot, sent in self._senders.items() for agent, (at, data) in sent.items()]
        for at, slot, agent, data in sorted(found):
            yield self._out(names.AIR_FRAME, ZERO_NS + at, ZERO_NS + at, slot=slot, agent=agent,
                            data=np.frombuffer(data, np.uint8))  # fmt: skip

    def _transmissions(self) -> Iterator[Out]:
        for slot, here in self._slots():
            if not here:
                continue
            at, records = self._at(slot), list(here.values())
            frames = [frame_in(record.datagram, self._run.config) for record in records]
            planes = {name: values.reshape(-1, 3).T for name, values in _vectors(records).items()}
            yield self._out(
                names.TRANSMISSION, at, at, slot=slot, agent=_array(list(here), "u2"),
                length=_array([len(frame) for frame in frames], "u1"),
                data=np.frombuffer(b"".join(frames), np.uint8),
                offset_ns=_array([self._offset(record) for record in records], "i8"), **_decided(records),
                steps=len(records[0].track), track=np.stack([r.track for r in records], axis=2).ravel(),
                **{name: np.ascontiguousarray(values).ravel() for name, values in planes.items()},
            )  # fmt: skip

    def _decisions(self) -> Iterator[Out]:
        for slot, here in self._slots():
            records = list(here.values())
            used = sorted({record.reason for record in records})
            decided, at = _decided(records), self._at(slot)
            yield self._out(
                names.DECISION, at, at, slot=slot, agent=_array(list(here), "u2"),
                reason_name=[REASONS[code] if code < len(REASONS) else str(code) for code in used],
                reason_index=_array([used.index(record.reason) for record in records], "u1"), **decided,
            )  # fmt: skip

    def _odometry(self) -> Iterator[Out]:
        agents = self._config.agents
        topics = [f"{names.agent_namespace(agent)}/{names.ODOMETRY}" for agent in range(1, agents + 1)]
        frames = [names.body_frame(names.agent_namespace(agent)) for agent in range(1, agents + 1)]
        packer = OdometryPacker(frames, names.FRAME)
        position, velocity = np.full((3, agents), np.nan), np.full((3, agents), np.nan)
        for slot, here in self._slots():
            at = self._at(slot)
            for agent, record in here.items():
                position[:, agent - 1], velocity[:, agent - 1] = record.track[-1], record.velocity
            packed = packer.pack(at, position, velocity)
            for agent in here:
                yield Out(at, topics[agent - 1], packed[agent - 1])

    def _markers(self) -> Iterator[Out]:
        """Pictures of those of whom it is known where they are; the others vanish."""
        topic, every = f"{names.SWARM}/{names.MARKERS}", max(1, round(_MARKERS_NS / self._slot_ns))
        packer, shown = MarkerPacker([]), ()
        for slot, here in self._slots():
            if slot % every or (not (ids := tuple(here)) and not shown):
                continue
            at = self._at(slot)
            if ids != shown:
                packer, shown = MarkerPacker([f"cf{agent}" for agent in ids], ids=ids), ids
                yield Out(at, topic, MarkerPacker.nothing(names.FRAME))
            if ids:
                sent = self._senders.get(slot, {})
                speaks = COLLIDED if len(sent) > 1 else SENDING
                state = np.array([speaks if agent in sent else WAITING for agent in ids], np.uint8)
                place, goal = (np.stack(list(v), axis=1) for v in zip(*((r.track[-1], r.goal) for r in here.values()),
                                                                      strict=True))  # fmt: skip
                yield Out(at, topic, packer.pack(at, place, state, goal))


def _array(values: Sequence[Any], kind: str) -> Any:
    return np.array(values, dtype=kind)


def _joined(arrays: Sequence[Any]) -> Any:
    return np.concatenate([array.ravel() for array in arrays]) if arrays else np.zeros(0)


def _vectors(records: Sequence[SlotRecord]) -> dict[str, Any]:
    """Velocities, commands and goals, one record after the other."""
    return {name: _joined([getattr(r, name) for r in records]) for name in ("velocity", "command", "goal")}


def _decided(records: Sequence[SlotRecord]) -> dict[str, Any]:
    kinds = {"chosen": "u2", "reason": "u1", "digest": "u4", "score": "f8"}
    return {name: _array([getattr(record, name) for record in records], kind) for name, kind in kinds.items()}
