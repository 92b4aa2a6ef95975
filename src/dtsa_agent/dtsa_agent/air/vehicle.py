"""What an agent flies: the simulated vehicle of all other flights, or one that somebody else flies."""

from __future__ import annotations

from typing import Protocol

from dtsa_agent.core.swarm import Swarm


class Vehicle(Protocol):
    """The vehicle of one agent."""

    def ready(self) -> bool:
        """Whether it is known where the vehicle is: the agent listens and speaks only from then on."""

    def sense(self, swarm: Swarm) -> None:
        """Writes where the vehicle is, and how it moves, into its agent.

        :param swarm: the agent, between two slots.
        """

    def fly(self, swarm: Swarm, slot: int) -> None:
        """Flies through a slot.

        :param swarm: the agent, after it has decided.
        :param slot: the slot.
        """


class SimulatedVehicle:
    """The point mass of the simulator."""

    def ready(self) -> bool:
        """Always."""
        return True

    def sense(self, swarm: Swarm) -> None:
        """The agent's arrays are the vehicle.

        :param swarm: the agent.
        """

    def fly(self, swarm: Swarm, slot: int) -> None:
        """See :class:`Vehicle`.

        :param swarm: the agent.
        :param slot: the slot.
        """
        swarm.fly(slot)
