"""What the agents of a run in real time say to have taken in: what was delivered to them, and not before it was."""

from __future__ import annotations

from typing import Any

import numpy as np

from dtsa_agent.core.agents.delays import Delays
from dtsa_bench.runs.hearing import Hearing

from .frames import SentFrames
from .result import Difference, Mismatch


class Intake:
    """Checks the reports of a run against the channel's deliveries."""

    def __init__(self, frames: SentFrames, slots: int) -> None:
        self._frames, self._slots = frames, slots
        agents = frames.config.agents
        self._taken: dict[tuple[int, int], np.ndarray[Any, np.dtype[np.bool_]]] = {}
        self._delays = Delays(agents)
        self.checked = 0  # receivers and frames

    def report(self, said: Any) -> None:
        """One report.

        :raises Mismatch: an agent took in what was not delivered to it, or before it was, or twice.
        """
        count = len(said.agent)
        index = np.asarray(said.agent, dtype=np.intp) - 1
        rows = np.asarray(said.heard_by, dtype=np.uint8).reshape(-1, -(-count // 8))
        masks = np.unpackbits(rows, axis=1, count=count, bitorder="little").astype(bool) if len(rows) else ()
        heard = zip(said.heard_slot.tolist(), said.heard_sender.tolist(), said.heard_ns.tolist(), masks, strict=True)
        for slot, sender, at_ns, mask in heard:
            if slot >= self._slots:
                continue
            self._one(slot, sender, at_ns, index[mask])

    def _one(self, slot: int, sender: int, at_ns: int, receivers: Any) -> None:
        sent = self._frames.get(slot, sender)
        if sent is None or sent.received is None:
            raise Mismatch(Difference("report.heard_sender", "a frame that was delivered", f"cf{sender}",
                                      "nobody takes in what was not delivered", slot))  # fmt: skip
        taken = self._taken.setdefault((slot, sender), np.zeros(self._frames.config.agents, dtype=np.bool_))
        for index in receivers.tolist():
            if not sent.received[index] or taken[index]:
                why = "an agent takes in what was delivered to it, once"
                expected = "not yet taken in" if taken[index] else "not delivered"
                raise Mismatch(Difference("report.heard_by", expected, f"taken in: cf{sender}", why, slot, index + 1))
        taken[receivers] = True
        delay = at_ns - sent.arrival_ns
        if delay < 0:
            raise Mismatch(Difference("report.heard_ns", f"at least {at_ns - delay} ns", f"{at_ns} ns",
                                      "nobody hears a frame before it has arrived", slot, sender))  # fmt: skip
        self._delays.add_many(np.full(len(receivers), delay), receivers)
        self.checked += len(receivers)

    def hearing(self, slots: int) -> Hearing:
        """Whether the agents have heard each other."""
        found = Hearing(self._frames.config.agents)
        found.slots, found.sent = slots, len(self._frames.all())
        found.delivered, found.taken_in = self._frames.delivered, self.checked
        return found

    def summary(self) -> dict[str, Any]:
        """How long after its arrival a frame was taken in, ms, and how many deliveries nobody says to have taken in."""
        delivered = self._frames.delivered
        return {
            "delivery_p50_ms": self._delays.quantile_ms(0.5),
            "delivery_p99_ms": self._delays.quantile_ms(0.99),
            "delivery_max_ms": self._delays.largest_ms(),
            "deliveries_not_taken_in": delivered - self.checked,
        }
