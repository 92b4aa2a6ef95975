"""What a slot does to agents that are bound to slots: frames go over the channel, all fly, hear and close the slot."""

from __future__ import annotations

from collections.abc import Sequence

from dtsa_agent.core import AbstractSwarm
from dtsa_channel_sim import Channel, Verdict
from dtsa_channel_sim.model.verdict import SUCCESS


class SlottedTraffic:
    """The frames of one flight. Everything in :meth:`slot` runs once a slot: it is kept bare.

    :param swarm: all agents.
    :param channel: what carries their frames.
    """

    __slots__ = ("_arbitrate", "_end", "_fly", "_frame", "_hear", "_ids", "_position")

    def __init__(self, swarm: AbstractSwarm, channel: Channel) -> None:
        self._frame, self._fly, self._hear, self._end = swarm.frame, swarm.fly, swarm.hear, swarm.end
        self._ids, self._position, self._arbitrate = swarm.ids, swarm.position, channel.arbitrate

    def slot(self, slot: int, senders: Sequence[int]) -> tuple[Verdict, list[int]]:
        """Carries the frames of a slot, which are encoded already, and closes the slot.

        :param slot: its number.
        :param senders: positions in ``ids`` of those that send.
        :returns: the channel's verdict, and the bytes of each frame.
        """
        ids, frame, hear = self._ids, self._frame, self._hear
        sent = [frame(index) for index in senders]
        lengths = [len(data) for data in sent]
        verdict = self._arbitrate(slot, [ids[index] for index in senders], lengths, self._position)
        self._fly(slot)
        received = verdict.received
        if received is not None:
            for row, data in enumerate(sent):
                hear(slot, data, received[row])
        elif verdict.outcome == SUCCESS:
            for data in sent:
                hear(slot, data)
        self._end(slot)
        return verdict, lengths
