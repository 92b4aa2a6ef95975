"""What an agent with a clock of its own asks of a port. Times are integer ns, CLOCK_MONOTONIC."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from dtsa_agent.core.station import Station

_SECOND = 1_000_000_000


class ClockMap:
    """An agent's clock: CLOCK_MONOTONIC, in trials with an offset and a drift.

    :param offset_ns: by how much it is ahead when it is made.
    :param drift_ppb: parts per billion by which it runs fast.
    :param began_ns: when it is ahead by the offset, in place of now.
    """

    __slots__ = ("began_ns", "drift_ppb", "offset_ns")

    def __init__(self, offset_ns: int = 0, drift_ppb: int = 0, began_ns: int | None = None) -> None:
        self.began_ns = time.monotonic_ns() if began_ns is None else began_ns
        self.offset_ns, self.drift_ppb = offset_ns, drift_ppb

    def local_ns(self, monotonic_ns: int) -> int:
        """What the clock shows at a time of CLOCK_MONOTONIC."""
        return monotonic_ns + self.offset_ns + (monotonic_ns - self.began_ns) * self.drift_ppb // _SECOND

    def monotonic_ns(self, local_ns: int) -> int:
        """The first ns of CLOCK_MONOTONIC at which the clock shows a time, or is past it."""
        elapsed = local_ns - self.offset_ns - self.began_ns
        return self.began_ns + elapsed - elapsed * self.drift_ppb // (_SECOND + self.drift_ppb)


class Header(NamedTuple):
    """What stands before a frame in a datagram, bytes, in this order; see :mod:`.datagram`."""

    agreed: int
    late: int  # 2, or 0: it does not say how late it left
    peers: int  # four for each of them

    @property
    def size(self) -> int:
        """Bytes before the frame."""
        return sum(self)


@dataclass(frozen=True, slots=True)
class PortProperties:
    """What agents, listeners and bags must know of a port: all ports of a swarm have the same."""

    name: str  # of the kind of port: agents that use different kinds do not hear each other
    flight_time_ns: int = 0  # from the order to send a datagram until its arrival, without the time of its bytes
    byte_time_ns: int = 0  # what each byte adds to that
    agreed_bytes: int = 8  # of a datagram's header, by which a swarm knows its own: 8, or 2 to 4 of them
    peers: int = 4  # of those that an agent hears a datagram names so many
    longest: int = 512  # bytes of the longest datagram
    bare_sealed: bool = False  # a sealed frame is the whole datagram: its tag tells the swarm from others
    shortest_slot_ns: int = 0  # shorter slots are refused
    turn_ns: int = 0  # of radios that take turns by themselves, how long one of them has its turn
    slots_hold_flights: bool = False  # slots in which a frame may arrive too late for the next one are refused
    varies: bool = False  # frames arrive by milliseconds earlier or later than others: see `datagram.trust_ns`

    def header(self, sealed: bool) -> Header:
        """What stands before a frame.

        :param sealed: whether frames carry a tag.
        """
        if self.bare_sealed and sealed:
            return Header(0, 0, 0)
        return Header(self.agreed_bytes, 2, 4 * self.peers)


class ReceivedDatagram(NamedTuple):
    """What has arrived."""

    data: bytes
    arrival_ns: int  # CLOCK_MONOTONIC
    own: bool  # this very port has sent it


class Listener(Protocol):
    """What hears the datagrams of a swarm."""

    say: Callable[[str], None] | None  # prints a line when the port fails or is back; its user sets it

    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""

    def receive(self, most: int) -> list[ReceivedDatagram]:
        """Return what has arrived, so many datagrams at most, in this order; empty if nothing has."""

    def counts(self) -> dict[str, int]:
        """Return what it counts, by name, for the summary."""

    def __enter__(self) -> Listener: ...

    def __exit__(self, *unused: object) -> None: ...


class DatagramPort(Listener, Protocol):
    """What an agent with a clock of its own asks of the port that carries its datagrams."""

    properties: PortProperties

    def send(self, data: bytes) -> str:
        """Send a datagram at once; returns why the port has not taken it, or an empty text."""

    def deliver(self, station: Station, clock: ClockMap, most: int) -> int:
        """Hand what has arrived, but for its own, to a station; returns how many datagrams have, so many at most."""

    def __enter__(self) -> DatagramPort: ...


class PortSettings(Protocol):
    """The settings of a kind of port."""

    @property
    def properties(self) -> PortProperties:
        """What agents, listeners and bags must know of it."""

    @property
    def where(self) -> str:
        """Where the frames go, for people."""

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain values."""
