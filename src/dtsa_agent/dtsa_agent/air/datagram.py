"""A frame in a datagram: who is on the same group by chance, or with other settings, is told apart at a glance.

| bytes | what |
|---|---|
| 0-1 | ``DT`` |
| 2 | version, 1 |
| 3 | 0 |
| 4-7 | of the settings that all agents share, and of the session: 32 bits of their hash, little-endian |
| 8-9 | how much later than its sender's slot the frame left, in 10 us, little-endian; the tag covers it |
| 10-25 | four of those that its sender hears (:mod:`.delay`): id, 0: nobody; how much later than expected, in 10 us |
| 26-.. | the frame, sealed or not |

Where bytes are dear a port has a shorter header (:class:`.port.PortProperties`): two to four bytes of the hash in place
of the first eight bytes, and fewer than four of those that its sender hears. Where there is no room at all, a sealed
frame is the datagram.

A computer that is busy sends late. Its clock is not late, and says by how much the frame is.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from dtsa_agent.core.agents.pacing import BETWEEN
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.frame import named_in
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig, agreed_settings, settings_hash

from .delay import Peer
from .port import Header, PortProperties

NETWORK = PortProperties("udp")  # with the longest header
HEADER = NETWORK.header(sealed=True).size  # bytes before the frame
NOT_OURS, LENGTH, OTHER_SETTINGS = "not ours", "length", "other settings"
NO_FRAME, UNKNOWN, REJECTED = "no frame", "unknown agent", "rejected"
OTHER_TIME, REPEATED, OWN_ID, EARLY = "other time", "repeated", "own id", "too early"
_MAGIC = b"DT\x01\x00"
_WITH_MAGIC = 8  # bytes of the header that are the same in all datagrams of a swarm; fewer: they have no magic
_TRUST_NS = 1_000_000
_UNIT_NS = 10_000  # of times in the header


def flight_ns(config: SwarmConfig, port: PortProperties) -> int:
    """From the order to send a frame to its arrival, as agents take it to be, ns.

    :param config: what all agents share.
    :param port: what carries the frames.
    """
    length = port.header(config.auth).size + config.frame_length
    return port.flight_time_ns + port.byte_time_ns * length + port.turn_ns * config.agents // 2  # half a round


def late_in(datagram: bytes, layout: Header) -> int:
    """How much later than its slot a datagram says to have left, ns; 0 where it does not say.

    :param datagram: the datagram.
    :param layout: what stands before its frame.
    """
    return int.from_bytes(datagram[layout.agreed : layout.agreed + layout.late], "little") * _UNIT_NS


def trust_ns(config: SwarmConfig, port: PortProperties) -> int:
    """By how much a frame may be off its slot and still say what time it is, ns.

    :param config: what all agents share.
    :param port: what carries the frames.
    """
    return config.slot_ns // 4 if port.varies else _TRUST_NS


def shortest_slot_ns(config: SwarmConfig, port: PortProperties) -> int:
    """The shortest slot that a port can carry, ns: a frame that waits for a whole round is there in time.

    :param config: what all agents share.
    :param port: what carries the frames.
    """
    longest = flight_ns(config, port) + port.turn_ns * config.agents // 2
    return max(port.shortest_slot_ns, round(longest / (1 - BETWEEN)) if port.slots_hold_flights else 0)


def frame_in(datagram: bytes, config: SwarmConfig) -> bytes:
    """The frame in a datagram of a swarm as the air carried it: sealed, if frames are; empty for no datagram.

    :param datagram: the datagram.
    :param config: what all agents share.
    """
    return datagram[-config.frame_length :]


def check_fits(config: SwarmConfig, port: PortProperties) -> None:
    """Refuses frames that are too long for a port, and slots that are too short.

    :param config: what all agents share.
    :param port: what is to carry them.
    :raises ConfigError: if they are.
    """
    shortest_ns = shortest_slot_ns(config, port)
    if config.slot_ns < shortest_ns:
        allowed = f"at least {-(-shortest_ns // 100_000) / 10:g} over {port.name}"
        if port.slots_hold_flights:
            allowed += f" with frames of {config.frame_length} bytes"
            if config.extended:
                row = config.policy_row
                policy = next(other.name for other in POLICIES.rows.values() if not other.extended)
                short = replace(config, frame="paper", policy=policy if row.extended else row.name)
                less_ns = shortest_slot_ns(short, port)
                allowed += (
                    f", {-(-less_ns // 100_000) / 10:g} with {short.frame_length} (policy {short.policy}, frame paper)"
                )
        raise ConfigError("slot_ms", config.slot_ms, allowed)
    room = port.longest - port.header(config.auth).size
    if config.frame_length > room:
        by = f"policy {config.policy}, frame {config.frame}{', sealed' if config.auth else ''}"
        raise ConfigError("frame", f"{config.frame_length} bytes ({by})", f"at most {room} bytes over {port.name}")


def header_of(config: SwarmConfig, port: PortProperties = NETWORK) -> bytes:
    """With which all datagrams of a swarm begin.

    :param config: what all agents share.
    :param port: what carries them.
    """
    agreed = settings_hash(agreed_settings(config, port.name)).to_bytes(8, "little")
    count = port.header(config.auth).agreed
    return _MAGIC + agreed[:4] if count == _WITH_MAGIC else agreed[:count]


class Said(NamedTuple):
    """What a datagram says; ``fault`` why it says nothing, or an empty text."""

    fault: str
    sender: int = 0
    slot: int = 0
    late_ns: int = 0
    peers: tuple[Peer, ...] = ()  # whom the sender hears how late
    frame: bytes = b""  # without its tag


class Wrapping:
    """Puts frames into datagrams and takes them out.

    :param config: what all agents share.
    :param authenticator: seals and opens frames; None: they are not sealed.
    :param port: what carries them.
    """

    def __init__(
        self,
        config: SwarmConfig,
        authenticator: Authenticator | None,
        port: PortProperties = NETWORK,
    ) -> None:
        self.header = header_of(config, port)
        self.layout = port.header(config.auth)
        self.peers = self.layout.peers // 4  # of those that it hears a datagram names so many
        self._before = self.layout.size
        self._times = struct.Struct("<" + self.peers * "Hh")
        self.length = self._before + config.frame_length  # bytes of a datagram
        self._agents, self._authenticator = config.agents, authenticator

    @property
    def sealed_with(self) -> tuple[bytes, int]:
        """Key and session; no key: frames are not sealed."""
        return (b"", 0) if self._authenticator is None else self._authenticator.key_and_session

    def wrap(self, frame: bytes, slot: int, late_ns: int = 0, peers: Sequence[Peer] = ()) -> bytes:
        """The datagram of a frame.

        :param frame: the frame, not sealed yet.
        :param slot: number of the slot in which it is sent.
        :param late_ns: ns, how much later than its slot it leaves.
        :param peers: whom its sender hears how late, as many at most as the port has room for.
        """
        told = [number for peer, late in peers for number in (peer, min(max(late // _UNIT_NS, -0x8000), 0x7FFF))]
        told += [0] * (2 * self.peers - len(told))
        late = min(max(late_ns, 0) // _UNIT_NS, 0xFFFF).to_bytes(2, "little")[: self.layout.late]
        times = late + self._times.pack(*told)
        sealed = frame if self._authenticator is None else self._authenticator.seal(frame, slot, times)
        return self.header + times + sealed

    def read(self, data: bytes) -> Said:
        """What a datagram says.

        :param data: the datagram.
        """
        agreed = len(self.header)
        if agreed == _WITH_MAGIC and data[:3] != _MAGIC[:3]:
            return Said(NOT_OURS)
        if data[:agreed] != self.header:
            return Said(OTHER_SETTINGS if len(data) >= agreed else LENGTH)
        if len(data) != self.length:
            return Said(LENGTH)
        times, frame = data[agreed : self._before], data[self._before :]
        named = named_in(frame)
        if named is None:
            return Said(NO_FRAME)
        sender, slot = named
        if not 1 <= sender <= self._agents:
            return Said(UNKNOWN)
        if self._authenticator is not None:
            opened = self._authenticator.open(frame, slot, beside=times)
            if opened is None:
                return Said(REJECTED)
            frame = opened
        late = int.from_bytes(times[: self.layout.late], "little")
        told = self._times.unpack(times[self.layout.late :])
        peers = tuple((peer, by * _UNIT_NS) for peer, by in zip(told[::2], told[1::2], strict=True) if peer)
        return Said("", sender, slot, late * _UNIT_NS, peers, frame)
