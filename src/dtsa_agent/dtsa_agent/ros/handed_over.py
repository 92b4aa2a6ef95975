"""Frames that wait in radios which listen before they send; such a radio says when it has begun."""

from __future__ import annotations

from dtsa_agent.core.plugins.entry_points import PluginSwarm


class HandedOver:
    """The last frame that each agent of a process has handed to its radio.

    :param swarm: the agents, with a policy whose radios listen.
    """

    def __init__(self, swarm: PluginSwarm) -> None:
        self._swarm = swarm
        self._index = {agent: index for index, agent in enumerate(swarm.ids)}
        self._at: dict[int, tuple[int, int]] = {}  # slot and ns, by index

    def note(self, index: int, slot: int, at_ns: int) -> None:
        """A frame is handed over.

        :param index: position of its agent.
        :param slot: its slot.
        :param at_ns: when its radio listens first, ns on the channel's time line.
        """
        self._at[index] = slot, at_ns

    def not_sent(self, index: int, slot: int) -> None:
        """A frame came too late to be handed over.

        :param index: position of its agent.
        :param slot: its slot.
        """
        self._swarm.radio_told(index, slot, None)

    def heard(self, agent: int, slot: int, began_ns: int) -> bool:
        """A frame has been on the air; False: it is not of an agent here.

        :param agent: id of its sender.
        :param slot: the slot that its sender counted.
        :param began_ns: when it began, ns on the channel's time line.
        """
        index = self._index.get(agent)
        if index is None:
            return False
        noted_slot, at_ns = self._at.get(index, (-1, 0))
        if noted_slot == slot:
            self._swarm.radio_told(index, slot, began_ns - at_ns)
        return True
