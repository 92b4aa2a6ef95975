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
_OF_SWARM = ("chosen", "reason", "digest", "score", "track", "velocity", "command", "goal")
_OF_SLOT = ("offset_ns", "length", *_OF_SWARM)
_OF_RECEIVED = ("heard_sender", "heard_slot", "heard_in", "heard_ns")


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
        self.now_ns = 0  # on the channel's time line

    def add_slot(self, index: int, slot: int, offset_ns: int, length: int, swarm: Swarm) -> None:
        """Note what an agent, alone in its swarm, has decided for a slot, and where it is; before it flies on.

        :param slot: the slot; before slot 0 the number of a call.
        :param offset_ns: start of its slot or transmission, from the channel's start of the slot.
        :param length: bytes of the frame that was sent, as the air carries it; 0: none.
        """
        own = offset_ns.to_bytes(8, "little", signed=True), bytes((length,))
        self._rows.setdefault(slot, {})[index] = own + tuple(getattr(swarm, name).tobytes() for name in _OF_SWARM)

    def add_received(self, index: int, sender: int, slot: int, here: int) -> None:
        """Note a frame that an agent receives now: the slot that its sender counted, and the slot here."""
        if len(self._received) < _MOST_RECEIVED:
            key = sender, slot, max(0, here), self.now_ns
            self._received[key] = self._received.get(key, 0) | 1 << index

    def is_due(self, slot: int) -> bool:
        """Whether it is time for a report, when all agents here have begun a slot."""
        return slot > self._last and (slot - self._last >= self._every or slot % self._every == self._phase)

    def publish(self, run_id: int, slot: int) -> None:
        """Publish all that has been collected up to a slot: one message for slots that the same agents have begun.

        Frames that were received are in one of all agents.
        """
        self._last = slot if slot < names.FIRST_CALL else -1
        ready = {row: self._rows.pop(row) for row in sorted(self._rows) if row <= slot}
        groups = [(agents, list(slots)) for agents, slots in groupby(ready, lambda row: tuple(sorted(ready[row])))]
        all_agents = tuple(range(len(self._ids)))
        if self._received and all_agents not in [agents for agents, _ in groups]:
            groups.append((all_agents, []))
        for agents, slots in groups:
            fields = dict.fromkeys((*_OF_SLOT, *_OF_RECEIVED, "heard_by"), b"")
            columns = zip(*[ready[row][index] for row in slots for index in agents], strict=True)
            for name, column in zip(_OF_SLOT, columns, strict=False):
                values = np.frombuffer(b"".join(column), REPORT.kinds[name]).reshape(len(slots), len(agents), -1)
                fields[name] = values.transpose(0, 2, 1).tobytes()
            if agents == all_agents:
                received, self._received = self._received, {}
                for name, column in zip(_OF_RECEIVED, zip(*received, strict=True), strict=False):
                    fields[name] = np.array(column, REPORT.kinds[name]).tobytes()
                width = -(-len(agents) // 8)
                fields["heard_by"] = b"".join(bits.to_bytes(width, "little") for bits in received.values())
            last = slots[-1] if slots and slots[-1] < names.FIRST_CALL else 0
            agent = array("H", [self._ids[index] for index in agents]).tobytes()
            self._publisher.publish(
                REPORT.pack_fields(
                    names.slot_time_ns(last, self._config.slot_ns), run=run_id, steps=self._config.steps, agent=agent,
                    slot=array("I", slots).tobytes(), **fields,
                )
            )  # fmt: skip
