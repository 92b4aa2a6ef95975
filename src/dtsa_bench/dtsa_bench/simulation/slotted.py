"""What a slot does to agents that are bound to slots: frames go over the channel, all fly, hear and close the slot."""

from __future__ import annotations

from collections.abc import Sequence

from dtsa_agent.core import Swarm
from dtsa_channel_sim import Channel, Verdict
from dtsa_channel_sim.model.verdict import SUCCESS


class SlottedTraffic:
    """The frames of one flight. Everything in :meth:`slot` runs once a slot: it is kept bare.

    :param swarm: all agents.
    :param channel: what carries their frames.
    """

    __slots__ = ("_arbitrate", "_complete", "_ids", "_length", "_position")

    def __init__(self, swarm: Swarm, channel: Channel) -> None:
        self._arbitrate, self._complete = channel.arbitrate, swarm.complete
        self._ids, self._position, self._length = swarm.ids, swarm.position, swarm.config.frame_length

    def slot(self, slot: int, senders: Sequence[int]) -> tuple[Verdict, list[int]]:
        """Carries the frames of a slot, which are encoded already, and closes the slot.

        :param slot: its number.
        :param senders: positions in ``ids`` of those that send.
        :returns: the channel's verdict, and the bytes of each frame.
        """
        ids, lengths = self._ids, [self._length] * len(senders)
        verdict = self._arbitrate(slot, [ids[index] for index in senders], lengths, self._position)
        self._complete(slot, senders, verdict.received, verdict.outcome == SUCCESS)
        return verdict, lengths
