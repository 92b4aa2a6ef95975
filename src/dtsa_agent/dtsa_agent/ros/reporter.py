"""What the agents of a process tell in real time beside their frames: in batches, so that it delays none of these."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from dtsa_msgs.msg import Report
from numpy.typing import NDArray

from dtsa_agent.core import AbstractSwarm

from .common import names
from .common.stamps import header_of

_PERIOD_NS = 100_000_000
_MOST_HEARD = 1000  # frames taken in that wait to be told: far more than a swarm sends in one period

# Fields of a report with one entry a slot and agent, and their types in it.
_FIELDS = {"chosen": "H", "reason": "B", "digest": "I", "score": "d",
           "track": "d", "velocity": "d", "command": "d", "goal": "d"}  # fmt: skip


class Reporter:
    """Collects what the agents of a process do in their slots, and what they take in, and publishes it.

    :param publisher: of dtsa_msgs/Report.
    :param swarm: the agents.
    """

    def __init__(self, publisher: Any, swarm: AbstractSwarm) -> None:
        self._publisher, self._swarm = publisher, swarm
        self._slot_ns = swarm.config.slot_ns
        self._every = max(1, _PERIOD_NS // self._slot_ns)
        # Processes report in different slots.
        self._phase = swarm.ids[0] % self._every
        self._slots: list[int] = []
        self._rows: dict[str, list[bytes]] = {name: [] for name in ("offset_ns", "length", *_FIELDS)}
        self._heard: list[tuple[int, int, int, int]] = []  # sender, slot, slot here, ns
        self._heard_by: list[bytes] = []
        self._message = Report(agent=array("H", swarm.ids), steps=swarm.config.steps)

    def add_slot(self, slot: int, offset_ns: NDArray[np.int64]) -> None:
        """Takes note of what all agents have decided for a slot, and of where they are; before they fly on.

        :param slot: the slot.
        :param offset_ns: (L,) ns, start of each agent's slot or transmission, from the channel's start of the slot.
        """
        swarm, rows = self._swarm, self._rows
        self._slots.append(slot)
        rows["offset_ns"].append(offset_ns.tobytes())
        rows["length"].append(swarm.frame_length.tobytes())
        for name in _FIELDS:
            rows[name].append(getattr(swarm, name).tobytes())

    def add_heard(self, sender: int, slot: int, here: int, at_ns: int, mask: NDArray[np.uint8]) -> None:
        """Takes note of a frame that some agents have taken in.

        :param sender: its sender's id.
        :param slot: the slot that the sender counted.
        :param here: the slot that is under way here.
        :param at_ns: ns on the channel's time line.
        :param mask: (L,) 1: who took it in.
        """
        if len(self._heard) < _MOST_HEARD:
            self._heard.append((sender, slot, max(0, here), at_ns))
            self._heard_by.append(np.packbits(mask, bitorder="little").tobytes())

    def due(self) -> bool:
        """Whether it is time for a report."""
        return len(self._slots) >= self._every or (bool(self._slots) and self._slots[-1] % self._every == self._phase)

    def publish(self, run_id: int) -> None:
        """Tells all that has been collected.

        :param run_id: the run's id.
        """
        message, rows = self._message, self._rows
        message.header = header_of(names.slot_time_ns(self._slots[-1] if self._slots else 0, self._slot_ns))
        message.run = run_id
        message.slot = array("I", self._slots)
        message.offset_ns = array("q", b"".join(rows["offset_ns"]))
        message.length = array("B", b"".join(rows["length"]))
        for name, kind in _FIELDS.items():
            setattr(message, name, array(kind, b"".join(rows[name])))
        sender, slot, here, at_ns = zip(*self._heard, strict=True) if self._heard else ((), (), (), ())
        message.heard_sender = array("H", sender)
        message.heard_slot = array("I", slot)
        message.heard_in = array("I", here)
        message.heard_ns = array("q", at_ns)
        message.heard_by = array("B", b"".join(self._heard_by))
        self._publisher.publish(message)
        self._slots = []
        for values in rows.values():
            values.clear()
        self._heard, self._heard_by = [], []
