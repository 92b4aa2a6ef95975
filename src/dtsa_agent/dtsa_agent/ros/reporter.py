"""What the agents of a process tell in real time beside their frames: in batches, so that it delays none of these."""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.report_fields import pack_report

_PERIOD_NS = 100_000_000
_MOST_HEARD = 1000  # frames taken in that wait to be told: far more than a swarm sends in one period

_FIELDS = ("chosen", "reason", "digest", "score", "track", "velocity", "command", "goal")  # of the swarm, as they are


class Reporter:
    """Collects what the agents of a process do in their slots, and what they take in, and publishes it.

    :param publisher: of dtsa_msgs/Report.
    :param swarm: the agents.
    """

    def __init__(self, publisher: Any, swarm: Swarm) -> None:
        self._publisher, self._swarm = publisher, swarm
        self._slot_ns = swarm.config.slot_ns
        self._every = max(1, _PERIOD_NS // self._slot_ns)
        # Processes report in different slots.
        self._phase = swarm.ids[0] % self._every
        self._slots: list[int] = []
        self._rows: dict[str, list[bytes]] = {name: [] for name in ("offset_ns", "length", *_FIELDS)}
        self._heard: list[tuple[int, int, int, int]] = []  # sender, slot, slot here, ns
        self._heard_by: list[bytes] = []
        self._ids = array("H", swarm.ids).tobytes()

    def add_slot(self, slot: int, offset_ns: NDArray[np.int64], length: NDArray[np.uint8]) -> None:
        """Takes note of what all agents have decided for a slot, and of where they are; before they fly on.

        :param slot: the slot; before slot 0 the number of a call.
        :param offset_ns: (L,) ns, start of each agent's slot or transmission, from the channel's start of the slot.
        :param length: (L,) bytes of each frame that was sent, as the air carries it; 0: none.
        """
        swarm, rows = self._swarm, self._rows
        self._slots.append(slot)
        rows["offset_ns"].append(offset_ns.tobytes())
        rows["length"].append(length.tobytes())
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
        rows = {name: b"".join(values) for name, values in self._rows.items()}
        sender, slot, here, at_ns = zip(*self._heard, strict=True) if self._heard else ((), (), (), ())
        rows |= {
            "agent": self._ids,
            "slot": array("I", self._slots).tobytes(),
            "heard_sender": array("H", sender).tobytes(),
            "heard_slot": array("I", slot).tobytes(),
            "heard_in": array("I", here).tobytes(),
            "heard_ns": array("q", at_ns).tobytes(),
            "heard_by": b"".join(self._heard_by),
        }
        last = self._slots[-1] if self._slots else 0
        time_ns = names.slot_time_ns(last if last < names.FIRST_CALL else 0, self._slot_ns)
        self._publisher.publish(pack_report(time_ns, run_id, self._swarm.config.steps, rows))
        self._slots = []
        for values in self._rows.values():
            values.clear()
        self._heard, self._heard_by = [], []
