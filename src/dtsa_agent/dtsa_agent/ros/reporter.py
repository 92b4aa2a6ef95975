"""What the agents of a process report in real time beside their frames: in batches, so that it delays none of these."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.messages import REPORT

_PERIOD_NS = 100_000_000
_MOST_RECEIVED = 1000  # frames that wait to be reported: far more than a swarm sends in one period

# Fields of a swarm, as they are, and before them the start of a slot or transmission and the length of the frame.
_FIELDS = {"chosen": "<u2", "reason": "u1", "digest": "<u4", "score": "<f8", "track": "<f8", "velocity": "<f8",
           "command": "<f8", "goal": "<f8"}  # fmt: skip
_KINDS = {"offset_ns": "<i8", "length": "u1", **_FIELDS}
_RECEIVED_KINDS = {"heard_sender": "H", "heard_slot": "I", "heard_in": "I", "heard_ns": "q"}


class Reporter:
    """Collects what the agents of a process do in their slots, and which frames they receive, and publishes it.

    Agents are named by their place among those here.

    :param publisher: of dtsa_msgs/Report.
    """

    def __init__(self, publisher: Any, config: SwarmConfig, ids: Sequence[int]) -> None:
        self._publisher, self._config, self._ids = publisher, config, ids
        self._every = max(1, _PERIOD_NS // config.slot_ns)
        self._phase = ids[0] % self._every  # processes report in different slots
        self._last = -1  # slot reported last
        self._rows: dict[int, dict[int, tuple[bytes, ...]]] = {}  # by slot and agent
        self._received: dict[tuple[int, int, int, int], int] = {}  # by sender, slot, slot here, ns: bits of the agents

    def add_slot(self, index: int, slot: int, offset_ns: int, length: int, swarm: Swarm) -> None:
        """Note what an agent, alone in its swarm, has decided for a slot, and where it is; before it flies on.

        :param slot: the slot; before slot 0 the number of a call.
        :param offset_ns: start of its slot or transmission, from the channel's start of the slot.
        :param length: bytes of the frame that was sent, as the air carries it; 0: none.
        """
        own = offset_ns.to_bytes(8, "little", signed=True), bytes((length,))
        self._rows.setdefault(slot, {})[index] = own + tuple(getattr(swarm, name).tobytes() for name in _FIELDS)

    def add_received(self, index: int, sender: int, slot: int, here: int, at_ns: int) -> None:
        """Note a frame that an agent has received: the slot that its sender counted, the slot here, channel time."""
        if len(self._received) < _MOST_RECEIVED:
            key = sender, slot, max(0, here), at_ns
            self._received[key] = self._received.get(key, 0) | 1 << index

    def is_due(self, slot: int) -> bool:
        """Whether it is time for a report, when all agents here have begun a slot."""
        return slot > self._last and (slot - self._last >= self._every or slot % self._every == self._phase)

    def publish(self, run_id: int, slot: int) -> None:
        """Publish all that has been collected up to a slot."""
        self._last = slot if slot < names.FIRST_CALL else -1
        all_agents = tuple(range(len(self._ids)))
        ready = sorted(row for row in self._rows if row <= slot)
        groups = [(agents, list(slots)) for agents, slots in groupby(ready, key=lambda s: tuple(sorted(self._rows[s])))]
        if self._received and all_agents not in [agents for agents, _ in groups]:
            groups.append((all_agents, []))
        for agents, slots in groups:
            rows = [self._rows[row][index] for row in slots for index in agents]
            columns = zip(*rows, strict=True) if rows else ((),) * len(_KINDS)
            shape = len(slots), len(agents), -1
            fields = {
                name: np.frombuffer(b"".join(column), kind).reshape(shape).transpose(0, 2, 1).tobytes() if rows else b""
                for (name, kind), column in zip(_KINDS.items(), columns, strict=True)
            } | self._pack_received(agents == all_agents)
            last = slots[-1] if slots and slots[-1] < names.FIRST_CALL else 0
            self._publisher.publish(
                REPORT.pack_fields(
                    names.slot_time_ns(last, self._config.slot_ns),
                    run=run_id,
                    steps=self._config.steps,
                    agent=array("H", [self._ids[index] for index in agents]).tobytes(),
                    slot=array("I", slots).tobytes(),
                    **fields,
                )
            )
        for row in ready:
            del self._rows[row]

    def _pack_received(self, of_all: bool) -> dict[str, bytes]:
        """Return the frames received since the last report; none in a report of some agents alone."""
        received, width = self._received if of_all else {}, -(-len(self._ids) // 8)
        if of_all:
            self._received = {}
        columns = list(zip(*received, strict=True)) or [()] * 4
        kinds = zip(_RECEIVED_KINDS.items(), columns, strict=True)
        fields = {name: array(kind, column).tobytes() for (name, kind), column in kinds}
        return {**fields, "heard_by": b"".join(bits.to_bytes(width, "little") for bits in received.values())}
