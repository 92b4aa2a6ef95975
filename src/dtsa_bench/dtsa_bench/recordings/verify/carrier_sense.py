"""Whether radios that listen before they send did so, in a run in real time."""

from __future__ import annotations

from typing import Any

from dtsa_channel_sim import Air, Channel

from .frames import SentFrames
from .result import Difference, Mismatch


class CarrierSense:
    """Checks when frames began against what the agents handed over, and against the air.

    :param frames: all frames of the run.
    """

    def __init__(self, frames: SentFrames) -> None:
        self._frames = frames
        self._handed: set[tuple[int, int]] = set()

    def report(self, said: Any) -> None:
        """One report: no frame has begun before it was handed over, or later than its radio tries.

        :param said: a dtsa_msgs/Report.
        :raises Mismatch: at the first that has.
        """
        slot_ns, agents = self._frames.config.slot_ns, said.agent.tolist()
        lengths, offsets = said.length.tolist(), said.offset_ns.tolist()
        for row, slot in enumerate(said.slot.tolist()):
            for k, agent in enumerate(agents, row * len(agents)):
                if not lengths[k]:
                    continue
                self._handed.add((slot, agent))
                sent, handed_ns = self._frames.get(slot, agent), slot * slot_ns + offsets[k]
                if sent is not None and not handed_ns <= sent.on_air.start_ns <= handed_ns + slot_ns:
                    raise Mismatch(Difference("frame.stamp", f"{handed_ns} ns, or up to a slot later",
                                              f"{sent.on_air.start_ns} ns", "a radio sends what it was handed",
                                              slot, agent))  # fmt: skip

    @property
    def not_sent(self) -> int:
        """Frames that were handed over and have not begun."""
        return sum(self._frames.get(slot, agent) is None for slot, agent in self._handed)

    def check(self, changes: list[tuple[int, dict[str, Any]]]) -> int:
        """Listens again where each frame began.

        :param changes: first slot and values of each change of the channel's settings.
        :returns: how many frames began in free air.
        :raises Mismatch: at the first that did not.
        """
        channel = Channel(self._frames.config)
        for slot, values in changes:
            channel.set(slot=slot, **values)
        air: Air[tuple[int, int]] = Air(channel)
        by_start = sorted(self._frames.all(), key=lambda sent: sent.on_air.start_ns)
        for sent in by_start:
            start_ns = sent.on_air.start_ns
            air.settle(start_ns)
            if air.busy(sent.sender, start_ns):
                raise Mismatch(Difference("frame.stamp", "free air", f"air in use at {start_ns} ns",
                                          "its radio listens before it sends", sent.slot, sent.sender))  # fmt: skip
            air.begin((sent.slot, sent.sender), sent.sender, start_ns, len(sent.data))
        return len(by_start)
