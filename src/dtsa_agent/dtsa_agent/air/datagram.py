"""A frame in a datagram: who is on the same group by chance, or with other settings, is told apart at a glance.

| bytes | what |
|---|---|
| 0-1 | ``DT`` |
| 2 | version, 1 |
| 3 | 0 |
| 4-7 | of the settings that all agents share, and of the session: 32 bits of their hash, little-endian |
| 8-9 | how much later than its sender's slot the frame left, in 10 us, little-endian; the tag covers it |
| 10-25 | four agents that its sender hears: id, 0: none; how much later than expected, in 10 us |
| 26-.. | the frame, sealed or not |

Where bytes are dear a port has a shorter header (:class:`.port.PortProperties`): two to four bytes of the hash in place
of the first eight bytes, and fewer than four of those that its sender hears. Where there is no room at all, a sealed
frame is the datagram.

A computer that is busy sends late. Its clock is not late, and says by how much the frame is.
"""

from __future__ import annotations

from dataclasses import replace

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.config import SwarmConfig, agreed_settings, settings_hash
from dtsa_agent.core.station import BETWEEN, Link

from .port import Header, PortProperties

NETWORK = PortProperties("udp")  # with the longest header
HEADER = NETWORK.header(sealed=True).size  # bytes before the frame
_MAGIC = b"DT\x01\x00"
_WITH_MAGIC = 8  # bytes of the header that are the same in all datagrams of a swarm; fewer: they have no magic
_TRUST_NS = 1_000_000
_UNIT_NS = 10_000  # of times in the header


def flight_ns(config: SwarmConfig, port: PortProperties) -> int:
    """From the order to send a frame to its arrival, as agents take it to be, ns."""
    length = port.header(config.auth).size + config.frame_length
    return port.flight_time_ns + port.byte_time_ns * length + port.turn_ns * config.agents // 2  # half a round


def late_in(datagram: bytes, layout: Header) -> int:
    """How much later than its slot a datagram says to have left, ns; 0 where it does not say."""
    return int.from_bytes(datagram[layout.agreed : layout.agreed + layout.late], "little") * _UNIT_NS


def trust_ns(config: SwarmConfig, port: PortProperties) -> int:
    """By how much a frame may be off its slot and still say what time it is, ns."""
    return config.slot_ns // 4 if port.varies else _TRUST_NS


def shortest_slot_ns(config: SwarmConfig, port: PortProperties) -> int:
    """The shortest slot that a port can carry, ns: a frame that waits for a whole round is there in time."""
    longest = flight_ns(config, port) + port.turn_ns * config.agents // 2
    return max(port.shortest_slot_ns, round(longest / (1 - BETWEEN)) if port.slots_hold_flights else 0)


def frame_in(datagram: bytes, config: SwarmConfig) -> bytes:
    """The frame in a datagram of a swarm as the air carried it: sealed, if frames are; empty for no datagram."""
    return datagram[-config.frame_length :]


def check_fits(config: SwarmConfig, port: PortProperties) -> None:
    """Refuses frames that are too long for a port, and slots that are too short.

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
    """With which all datagrams of a swarm begin."""
    agreed = settings_hash(agreed_settings(config, port.name)).to_bytes(8, "little")
    count = port.header(config.auth).agreed
    return _MAGIC + agreed[:4] if count == _WITH_MAGIC else agreed[:count]


def link_of(config: SwarmConfig, port: PortProperties = NETWORK) -> Link:
    """What carries the datagrams of a swarm, for its stations."""
    layout = port.header(config.auth)
    header, late = header_of(config, port), layout.late > 0
    return Link(header, late, layout.peers // 4, flight_ns(config, port), trust_ns(config, port))
