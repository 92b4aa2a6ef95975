"""What carries the datagrams of agents with clocks of their own: ports, their kinds by name, and a datagram's header.

The bytes of a datagram: docs/reference/network.md. Where bytes are dear a port has a shorter header
(:class:`PortProperties`): two to four bytes of the hash in place of the first eight, and fewer agents. Where there is
no room at all, a signed frame is the datagram. Times are integer ns, CLOCK_MONOTONIC unless said otherwise.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig, agreed_settings, settings_hash
from dtsa_agent.core.station import BETWEEN, ClockMap, Link, Station

_MAGIC = b"DT\x01\x00"
_WITH_MAGIC = 8  # bytes of the header that are the same in all datagrams of a swarm; fewer: they have no magic
_TRUST_NS = 1_000_000


class Header(NamedTuple):
    """Parts of a datagram before the frame, bytes, in this order."""

    agreed: int
    late: int  # 2, or 0: it does not say how late it left
    peers: int  # four for each heard agent

    @property
    def size(self) -> int:
        """Bytes before the frame."""
        return sum(self)

    def late_ns(self, datagram: bytes) -> int:
        """How much later than its slot a datagram says to have left; 0 where it does not say."""
        return int.from_bytes(datagram[self.agreed : self.agreed + self.late], "little") * 10_000


@dataclass(frozen=True, slots=True)
class PortProperties:
    """What agents, listeners and bags must know of a port: all ports of a swarm have the same."""

    name: str  # of the kind of port: agents that use different kinds do not hear each other
    flight_time_ns: int = 0  # from the order to send a datagram until its arrival, without the time of its bytes
    byte_time_ns: int = 0  # what each byte adds to that
    agreed_bytes: int = 8  # of a datagram's header, by which a swarm knows its own: 8, or 2 to 4 of them
    peers: int = 4  # heard agents that a datagram names
    longest: int = 512  # bytes of the longest datagram
    bare_sealed: bool = False  # a signed frame is the whole datagram: its tag tells the swarm from others
    shortest_slot_ns: int = 0  # shorter slots are refused
    turn_ns: int = 0  # of radios that take turns by themselves, how long one of them has its turn
    slots_hold_flights: bool = False  # slots in which a frame may arrive too late for the next one are refused
    varies: bool = False  # frames arrive by milliseconds earlier or later than others

    def header(self, signed: bool) -> Header:
        """What stands before a frame, which carries a tag if it is signed."""
        return Header(0, 0, 0) if self.bare_sealed and signed else Header(self.agreed_bytes, 2, 4 * self.peers)


class ReceivedDatagram(NamedTuple):
    """A datagram of another port that has arrived."""

    data: bytes
    arrival_ns: int


P = TypeVar("P", bound="Port")


class Port(ABC):
    """Carries the datagrams of an agent with a clock of its own, or brings them to a listener. A context manager."""

    properties: PortProperties
    log: Callable[[str], None] | None = None  # prints a line when the port fails or is back; its user sets it
    name: str  # begins these lines

    @abstractmethod
    def fileno(self) -> int:
        """For ``select``: readable when something has arrived."""

    @abstractmethod
    def send(self, data: bytes) -> str:
        """Send a datagram at once.

        :param data: the datagram, at most `properties.longest` bytes.
        :returns: why the port has refused it, or an empty text.
        """

    @abstractmethod
    def receive(self, most: int) -> list[ReceivedDatagram]:
        """Return what others have sent, in the order of arrival; empty if nothing has come.

        :param most: datagrams that are returned at most.
        :returns: each with its time of arrival, ns, CLOCK_MONOTONIC.
        """

    @abstractmethod
    def counts(self) -> dict[str, int]:
        """Return what it counts, by name, for the summary."""

    @abstractmethod
    def close(self) -> None:
        """Free it for others."""

    def deliver(self, station: Station, clock: ClockMap, most: int) -> int:
        """Hand what others have sent to a station.

        :param clock: the agent's own, on which the station lives.
        :param most: datagrams that are handed over at most.
        :returns: how many have arrived.
        """
        datagrams = self.receive(most)
        for datagram in datagrams:
            station.receive(datagram.data, clock.local_ns(datagram.arrival_ns))
        return len(datagrams)

    def print(self, text: str) -> None:
        """Print a line about the port."""
        if self.log is not None:
            self.log(f"{self.name} {text}")

    def __enter__(self: P) -> P:
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()


class PortSettings(Protocol):
    """The settings of a kind of port."""

    @property
    def properties(self) -> PortProperties: ...

    @property
    def destination(self) -> str:
        """Where frames go, for logs."""

    def to_dict(self) -> dict[str, Any]: ...


#: Kinds of port, which `--air NAME` and the parameter ``air`` of a node choose from; they name modules and classes.
AIRS = ("udp", "crazyradio", "serial")


def settings_class(air: str) -> Any:
    """Return the settings class of a kind of port; ConfigError: there is none of this name."""
    if air not in AIRS:
        raise ConfigError("air", air, ", ".join(AIRS))
    return getattr(import_module("dtsa_agent.air.settings"), f"{air.capitalize()}Settings")


def open_port(settings: PortSettings) -> Port:
    """Return the port of an agent, or of a listener; only its module is imported. ConfigError: it cannot be used."""
    air = settings.properties.name
    if simulated := getattr(settings, "simulated_radio", ""):
        import_module("dtsa_agent.air.crazyradio_simulated").replace_real_dongles(Path(simulated))
    port: Port = getattr(import_module(f"dtsa_agent.air.{air}_port"), f"{air.capitalize()}Port")(settings)
    return port


NETWORK = PortProperties("udp")  # with the longest header
HEADER = NETWORK.header(signed=True).size  # bytes before the frame


def flight_ns(config: SwarmConfig, port: PortProperties) -> int:
    """From the order to send a frame to its arrival, as agents take it to be, ns."""
    length = port.header(config.auth).size + config.frame_length
    return port.flight_time_ns + port.byte_time_ns * length + port.turn_ns * config.agents // 2  # half a round


def shortest_slot_ns(config: SwarmConfig, port: PortProperties) -> int:
    """The shortest slot that a port can carry: a frame that waits for a whole round is there in time."""
    longest = flight_ns(config, port) + port.turn_ns * config.agents // 2
    return max(port.shortest_slot_ns, round(longest / (1 - BETWEEN)) if port.slots_hold_flights else 0)


def frame_in(datagram: bytes, config: SwarmConfig) -> bytes:
    """The frame in a datagram of a swarm, with its tag if it is signed; empty for no datagram."""
    return datagram[-config.frame_length :]


def check_fits(config: SwarmConfig, port: PortProperties) -> None:
    """Refuse frames that are too long for a port, and slots that are too short.

    :raises ConfigError: if they are.
    """
    shortest_ns = shortest_slot_ns(config, port)
    if config.slot_ns < shortest_ns:
        allowed = f"at least {_tenths_ms(shortest_ns)} over {port.name}"
        if port.slots_hold_flights:
            allowed += f" with frames of {config.frame_length} bytes"
        if port.slots_hold_flights and config.extended:
            plain = next(row.name for row in POLICIES.rows.values() if not row.extended)
            short = replace(config, frame="paper", policy=plain if config.policy_row.extended else config.policy)
            less = _tenths_ms(shortest_slot_ns(short, port))
            allowed += f", {less} with {short.frame_length} (policy {short.policy}, frame paper)"
        raise ConfigError("slot_ms", config.slot_ms, allowed)
    room = port.longest - port.header(config.auth).size
    if config.frame_length > room:
        by = f"policy {config.policy}, frame {config.frame}{', sealed' if config.auth else ''}"
        raise ConfigError("frame", f"{config.frame_length} bytes ({by})", f"at most {room} bytes over {port.name}")


def _tenths_ms(ns: int) -> str:
    """A time as ms, rounded up to tenths."""
    return f"{-(-ns // 100_000) / 10:g}"


def header_of(config: SwarmConfig, port: PortProperties = NETWORK) -> bytes:
    """Bytes with which all datagrams of a swarm begin."""
    agreed = settings_hash(agreed_settings(config, port.name)).to_bytes(8, "little")
    count = port.header(config.auth).agreed
    return _MAGIC + agreed[:4] if count == _WITH_MAGIC else agreed[:count]


def link_of(config: SwarmConfig, port: PortProperties = NETWORK) -> Link:
    """What carries the datagrams of a swarm, for its stations."""
    header = port.header(config.auth)
    trust_ns = config.slot_ns // 4 if port.varies else _TRUST_NS  # frames that are off by more do not say the time
    return Link(header_of(config, port), header.late > 0, header.peers // 4, flight_ns(config, port), trust_ns)
