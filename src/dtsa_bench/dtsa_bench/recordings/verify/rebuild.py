"""Flies a recorded lockstep run again and says, slot by slot, which messages its bag must hold."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import REASONS, make_scenario
from dtsa_agent.core.plugins.entry_points import make_swarm
from dtsa_agent.keys import with_key
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.packing import RUN_BYTES, pack_received
from dtsa_bench.recordings.bag.cdr import OdometryPacker
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.hearing import Hearing
from dtsa_channel_sim import Channel
from dtsa_channel_sim.model.verdict import Verdict

from .layout import Layout

SLOT = f"{names.SWARM}/{names.SLOT}"
TRANSMISSION = f"{names.SWARM}/{names.TRANSMISSION}"
RECEPTION = f"{names.SWARM}/{names.RECEPTION}"
DECISION = f"{names.SWARM}/{names.DECISION}"
RUN_PHASE = 0

_IDS = struct.Struct("<I")


_ALL_USED: NDArray[np.uint8] = np.zeros(0, dtype=np.uint8)  # for bytes that must be equal without exception


class Expected(NamedTuple):
    """What a recorded message must be."""

    data: bytes
    mask: NDArray[np.uint8]  # 0xFF where a byte is used, 0 where it is padding


def first_agent(data: bytes) -> int:
    """Id of the first agent of a Transmission message, 0 if it has none."""
    at = RUN_BYTES.stop + 4
    if len(data) < at + 6 or _IDS.unpack_from(data, at)[0] == 0:
        return 0
    return data[at + 4] | data[at + 5] << 8


class Rebuild:
    """All agents of a run and its channel, made from the recorded configuration.

    Every agent keeps a table of its own, fed only by what the channel let it hear.

    :param run_id: the run's id.
    """

    def __init__(self, run: RunConfig, typestore: Any, groups: Sequence[tuple[int, ...]], run_id: int) -> None:
        self.run, self.groups = run, list(groups)
        self.swarm = with_key(make_swarm(run.swarm, make_scenario(run.swarm)))
        self.channel = Channel(run.air)
        self.slot = -1
        self._run_id = run_id
        self._store = typestore
        self._goal = np.full_like(self.swarm.goal, np.nan)
        self._columns = [np.array(group, dtype=np.intp) - 1 for group in self.groups]
        spaces = [names.agent_namespace(agent) for agent in self.swarm.ids]
        self.odometry_topics = [f"{space}/{names.ODOMETRY}" for space in spaces]
        self._odometry = OdometryPacker([f"{space[1:]}/base_link" for space in spaces], names.FRAME)
        self.hearing = Hearing(run.swarm.agents)
        self._verdict = Verdict(0, (), None, None, None)
        self._frames: dict[int, bytes] = {}
        self._lengths = np.zeros(len(self.swarm.ids), dtype=np.uint8)
        self._layouts: dict[tuple[Any, ...], Layout] = {}
        self._velocity = self.swarm.velocity.copy()
        self._command = self.swarm.command.copy()
        self._track = self.swarm.track.copy()

    def time_ns(self, slot: int) -> int:
        """Simulated time at which a slot starts, ns."""
        return names.slot_time_ns(slot, self.run.swarm.slot_ns)

    def _cdr(self, kind: str, at: int, /, **fields: Any) -> Expected:
        """A message of dtsa_msgs with the stamp of slot ``at``."""
        shape = (
            kind,
            *(v.size if isinstance(v, np.ndarray) else tuple(v) for v in fields.values() if not isinstance(v, int)),
        )
        return self._packed(shape, kind, at, 1, fields)[0]

    def _packed(self, shape: Any, kind: str, at: int, rows: int, fields: dict[str, Any]) -> list[Expected]:
        """Messages of one shape, which share a template; arrays may have one row a message."""
        layout = self._layouts.get(shape)
        if layout is None:
            name, types = f"dtsa_msgs/msg/{kind}", self._store.types
            first = {key: v[0] if isinstance(v, np.ndarray) and v.ndim == 2 else v for key, v in fields.items()}
            time = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
            header = types["std_msgs/msg/Header"](stamp=time, frame_id=names.FRAME)
            example = types[name](header=header, run=self._run_id, **first)
            layout = self._layouts[shape] = Layout(self._store, name, example, rows)
        seconds, nanoseconds = divmod(self.time_ns(at), 1_000_000_000)
        layout.fill("header.stamp.sec", seconds)
        layout.fill("header.stamp.nanosec", nanoseconds)
        for name, value in fields.items():
            if not isinstance(value, list):
                layout.fill(name, value)
        return [Expected(data, layout.mask) for data in layout.data()]

    def slot_message(self, phase: int = RUN_PHASE) -> Expected:
        """The message that opens the next slot; with the last phase it carries nothing."""
        slot, verdict, agents = self.slot + 1, self._verdict, self.run.swarm.agents
        sender: list[int] = []
        received = b""
        if verdict.senders and phase == RUN_PHASE:
            mask = verdict.mask(agents)
            heard = np.flatnonzero(mask.any(axis=1))
            sender = [verdict.senders[row] for row in heard]
            received = pack_received(mask[heard])
        frames = [self._frames[agent] for agent in sender]
        return self._cdr(
            "Slot",
            slot,
            slot=slot,
            phase=phase,
            heard_slot=max(slot - 1, 0),
            sender=np.array(sender, dtype=np.uint16),
            length=np.array([len(f) for f in frames], dtype=np.uint8),
            data=np.frombuffer(b"".join(frames), dtype=np.uint8),
            received=np.frombuffer(received, dtype=np.uint8),
        )

    def open(self) -> None:
        """Every agent decides for the next slot."""
        self.slot += 1
        swarm = self.swarm
        self._track = swarm.track.copy()
        self._velocity, self._command = swarm.velocity.copy(), swarm.command.copy()
        swarm.scenario.advance(self.slot, swarm)
        self._frames = {swarm.ids[index]: swarm.frame(index) for index in swarm.begin(self.slot)}

    def transmissions(self) -> dict[int, Expected]:
        """The answers to the slot, by the first id of each process."""
        goal, size = self.swarm.goal, [len(self._frames.get(agent, b"")) for agent in self.swarm.ids]
        self._lengths = np.array(size, dtype=np.uint8)
        still = bool(np.array_equal(self._goal, goal))
        # Answers of one shape are made together: most processes have as many agents as the others and are silent.
        alike: dict[tuple[int, int, bool], list[int]] = {}
        for index, at in enumerate(self._columns):
            moved = not still and not np.array_equal(self._goal[:, at], goal[:, at])
            group = self.groups[index]
            alike.setdefault((len(group), sum([size[agent - 1] for agent in group]), moved), []).append(index)
        result: dict[int, Expected] = {}
        for (_, _, moved), members in alike.items():
            for index, message in zip(members, self._answers(members, moved), strict=True):
                result[self.groups[index][0]] = message
        if not still:
            self._goal[:] = goal
        return result

    def _answers(self, members: list[int], moved: bool) -> list[Expected]:
        """The answers of some processes, all of the same shape."""
        swarm, rows = self.swarm, len(members)
        at = np.array([self._columns[index] for index in members])  # (processes, agents of each)
        frames = [b"".join([self._frames[agent] for agent in self.groups[i] if agent in self._frames]) for i in members]
        data = np.frombuffer(b"".join(frames), dtype=np.uint8).reshape(rows, -1)
        planes = [
            np.moveaxis(values[:, at], 1, 0).reshape(rows, -1) for values in (self._velocity, self._command, swarm.goal)
        ]
        fields = {
            "slot": self.slot,
            "agent": (at + 1).astype(np.uint16),
            "length": self._lengths[at],
            "data": data,
            "offset_ns": np.zeros(0, dtype=np.int64),
            "chosen": swarm.chosen[at],
            "reason": swarm.reason[at],
            "digest": swarm.digest[at],
            "score": swarm.score[at],
            "steps": self.run.swarm.steps,
            "track": np.moveaxis(self._track[:, :, at], 2, 0).reshape(rows, -1),
            "velocity": planes[0],
            "command": planes[1],
            "goal": planes[2] if moved else np.zeros(0),
        }
        shape = ("Transmission", rows, at.shape[1], data.shape[1], moved)
        return self._packed(shape, "Transmission", self.slot, rows, fields)

    def decision(self) -> Expected:
        """The message with all decisions of the slot."""
        swarm = self.swarm
        used, index = np.unique(swarm.reason, return_inverse=True)
        labels = [REASONS[code] if code < len(REASONS) else str(code) for code in used]
        return self._cdr(
            "Decision",
            self.slot,
            slot=self.slot,
            agent=np.array(swarm.ids, dtype=np.uint16),
            chosen=swarm.chosen,
            reason_name=labels,
            reason_index=index.astype(np.uint8),
            reason=swarm.reason,
            digest=swarm.digest,
            score=swarm.score,
        )

    def odometry(self) -> list[Expected]:
        """Every agent's odometry at the slot's start, in the order of ids."""
        packed = self._odometry.pack(self.time_ns(self.slot), self._track[-1], self._velocity)
        return [Expected(data, _ALL_USED) for data in packed]

    def close(self) -> Verdict:
        """The channel judges the slot, the agents fly through it, hear, and close it."""
        swarm, slot = self.swarm, self.slot
        senders = sorted(self._frames)
        lengths = [len(self._frames[agent]) for agent in senders]
        verdict = self._verdict = self.channel.arbitrate(slot, senders, lengths, self._track[-1])
        swarm.fly(slot)
        mask = verdict.mask(self.run.swarm.agents)
        self.hearing.slot(len(verdict.senders), mask)
        for row, sender in enumerate(verdict.senders):
            if swarm.hear(slot, self._frames[sender], None if verdict.received is None else mask[row]):
                self.hearing.take_in(mask[row])
        swarm.end(slot)
        return verdict

    def reception(self) -> Expected:
        """The channel's verdict on the slot as a message."""
        verdict = self._verdict
        nothing = (0,) * len(verdict.senders)
        received = pack_received(verdict.mask(self.run.swarm.agents)) if verdict.senders else b""
        return self._cdr(
            "Reception",
            self.slot + 1,
            slot=self.slot,
            outcome=verdict.outcome,
            sender=np.array(verdict.senders, dtype=np.uint16),
            received=np.frombuffer(received, dtype=np.uint8),
            lost=np.array(verdict.lost or nothing, dtype=np.uint16),
            collided=np.array(verdict.collided or nothing, dtype=np.uint16),
        )
