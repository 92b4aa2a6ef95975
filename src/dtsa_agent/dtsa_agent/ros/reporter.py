"""What the agents of a process tell in real time beside their frames: in batches, so that it delays none of these."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.report_fields import pack_report

_PERIOD_NS = 100_000_000
_MOST_HEARD = 1000  # frames taken in that wait to be told: far more than a swarm sends in one period

# Fields of a swarm, as they are, and before them the start of a slot or transmission and the length of the frame.
_FIELDS = {"chosen": "<u2", "reason": "u1", "digest": "<u4", "score": "<f8", "track": "<f8", "velocity": "<f8",
           "command": "<f8", "goal": "<f8"}  # fmt: skip
_KINDS = {"offset_ns": "<i8", "length": "u1", **_FIELDS}


class Reporter:
    """Collects what the agents of a process do in their slots, and what they take in, and publishes it.

    :param publisher: of dtsa_msgs/Report.
    :param config: the settings that all agents share.
    :param ids: ids of the agents.
    """

    def __init__(self, publisher: Any, config: SwarmConfig, ids: Sequence[int]) -> None:
        self._publisher, self._config, self._ids = publisher, config, ids
        self._every = max(1, _PERIOD_NS // config.slot_ns)
        self._phase = ids[0] % self._every  # processes report in different slots
        self._last = -1  # slot reported last
        self._rows: dict[int, dict[int, tuple[bytes, ...]]] = {}  # by slot and place of the agent
        self._heard: dict[tuple[int, int, int, int], int] = {}  # by sender, slot, slot here, ns: bits of the agents

    def add_slot(self, index: int, slot: int, offset_ns: int, length: int, swarm: Swarm) -> None:
        """Takes note of what an agent has decided for a slot, and of where it is; before it flies on.

        :param index: place of the agent among those here.
        :param slot: the slot; before slot 0 the number of a call.
        :param offset_ns: start of its slot or transmission, from the channel's start of the slot.
        :param length: bytes of the frame that was sent, as the air carries it; 0: none.
        :param swarm: the agent alone.
        """
        own = offset_ns.to_bytes(8, "little", signed=True), bytes((length,))
        self._rows.setdefault(slot, {})[index] = own + tuple(getattr(swarm, name).tobytes() for name in _FIELDS)

    def add_heard(self, index: int, sender: int, slot: int, here: int, at_ns: int) -> None:
        """Takes note of a frame that an agent has taken in.

        :param index: place of the agent among those here.
        :param sender: its sender's id.
        :param slot: the slot that the sender counted.
        :param here: the slot that is under way here.
        :param at_ns: ns on the channel's time line.
        """
        if len(self._heard) < _MOST_HEARD:
            key = sender, slot, max(0, here), at_ns
            self._heard[key] = self._heard.get(key, 0) | 1 << index

    def due(self, slot: int) -> bool:
        """Whether it is time for a report, when all agents here have begun a slot."""
        return slot > self._last and (slot - self._last >= self._every or slot % self._every == self._phase)

    def publish(self, run_id: int, slot: int) -> None:
        """Tells all that has been collected up to a slot.

        :param run_id: the run's id.
        """
        self._last = slot if slot < names.FIRST_CALL else -1
        everybody = tuple(range(len(self._ids)))
        ready = sorted(there for there in self._rows if there <= slot)
        groups = [
            (who, list(slots)) for who, slots in groupby(ready, key=lambda there: tuple(sorted(self._rows[there])))
        ]
        if self._heard and everybody not in [who for who, _ in groups]:
            groups.append((everybody, []))
        for who, slots in groups:
            rows = [self._rows[there][index] for there in slots for index in who]
            columns = zip(*rows, strict=True) if rows else ((),) * len(_KINDS)
            shape = len(slots), len(who), -1
            fields = {
                name: np.frombuffer(b"".join(column), kind).reshape(shape).transpose(0, 2, 1).tobytes() if rows else b""
                for (name, kind), column in zip(_KINDS.items(), columns, strict=True)
            }
            fields |= self._heard_fields(who == everybody)
            fields["agent"] = array("H", [self._ids[index] for index in who]).tobytes()
            fields["slot"] = array("I", slots).tobytes()
            last = slots[-1] if slots and slots[-1] < names.FIRST_CALL else 0
            time_ns = names.slot_time_ns(last, self._config.slot_ns)
            self._publisher.publish(pack_report(time_ns, run_id, self._config.steps, fields))
        for there in ready:
            del self._rows[there]

    def _heard_fields(self, of_all: bool) -> dict[str, bytes]:
        """What has been taken in since it was told last; nothing in a report of some agents alone."""
        heard, width = self._heard if of_all else {}, -(-len(self._ids) // 8)
        sender, slot, here, at_ns = zip(*heard, strict=True) if heard else ((), (), (), ())
        fields = {
            "heard_sender": array("H", sender).tobytes(),
            "heard_slot": array("I", slot).tobytes(),
            "heard_in": array("I", here).tobytes(),
            "heard_ns": array("q", at_ns).tobytes(),
            "heard_by": b"".join(bits.to_bytes(width, "little") for bits in heard.values()),
        }
        if of_all:
            self._heard = {}
        return fields
