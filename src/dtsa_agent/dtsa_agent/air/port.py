"""What an agent asks of an air, what an air tells an agent, and what a receiver can tell about a slot.

All times are integer ns on the agent's own clock. A scheme need not be slotted: it may send at any instant. One that is
derives the outcome of a slot from what its own receiver has heard.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from dtsa_agent.core.swarms.outcome import SlotOutcome


class AirPort(Protocol):
    """What an agent may ask of an air."""

    def send(self, frame: bytes, at_ns: int) -> None:
        """Sends a frame; the listener is told what became of the order.

        :param frame: the frame.
        :param at_ns: ns, when the transmission starts: now or later.
        """

    def busy(self, when_ns: int) -> bool | None:
        """Whether the air is in use where the agent is; None where its radio cannot tell.

        A radio that sends finds its air in use. One that has been told to send and is still turning to it is not sensed
        by the others yet.

        :param when_ns: ns, now.
        """


class AirListener(Protocol):
    """What an air tells an agent."""

    def sent(self, frame: bytes, at_ns: int | None) -> None:
        """An own frame has been dealt with.

        :param frame: the frame.
        :param at_ns: ns, when its transmission started; None: it was dropped.
        """

    def received(self, frame: bytes, when_ns: int, rssi_dbm: float | None) -> None:
        """A frame of another agent has arrived.

        :param frame: the frame.
        :param when_ns: ns, when the receiver had it whole.
        :param rssi_dbm: dBm, how strong it was; None where the air cannot tell.
        """


class DatagramPort(Protocol):
    """What an agent with a clock of its own asks of the port that carries its datagrams."""

    flight_time_ns: int  # from the order to send a datagram until its arrival, without the time of its bytes
    byte_time_ns: int  # what each byte adds to that
    compiled: Any  # a capsule: what the compiled hearing reads (_hearing/port.h)
    say: Callable[[str], None] | None  # set by the agent: is told a line in flight when the port fails or is back

    def send(self, data: bytes) -> str:
        """Sends a datagram at once; why the port has not taken it, or an empty text.

        :param data: the datagram.
        """

    def counts(self) -> dict[str, int]:
        """What it counts, by name, for the agent's summary."""


@dataclass(slots=True)
class SlotHearing:
    """What one receiver has heard in a slot, and the outcome that it derives from that."""

    frames: int = 0  # frames sent or received in the slot
    energy: bool = False  # the air was found in use

    def frame(self) -> None:
        """A frame of the slot has been sent or received."""
        self.frames += 1

    def sense(self, port: AirPort, now_ns: int) -> None:
        """Looks whether the air is in use, best while frames of the slot would be on it.

        :param port: the air.
        :param now_ns: ns, now.
        """
        self.energy |= bool(port.busy(now_ns))

    def close(self) -> SlotOutcome:
        """The outcome of the slot; the next one begins.

        A frame is a frame. Energy without a frame is a collision: one that the receiver could not decode, or several.
        Everything else is silence, and so are collisions to a radio that cannot sense energy.
        """
        heard, energy = self.frames > 0, self.energy
        self.frames, self.energy = 0, False
        if heard:
            return SlotOutcome.FRAME
        return SlotOutcome.COLLISION if energy else SlotOutcome.SILENCE
