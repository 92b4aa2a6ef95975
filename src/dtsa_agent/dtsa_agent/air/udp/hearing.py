"""What an agent hears, compiled: one call a slot sleeps, reads the socket, and says whose frames have come."""

from __future__ import annotations

import socket
import time

from dtsa_agent.core.frame import position_step
from dtsa_agent.core.reference.timebase import ALONE, JOINED, LISTENING
from dtsa_agent.core.settings.config import SwarmConfig

from ._hearing import Hearing
from .datagram import (
    LENGTH,
    NO_FRAME,
    NOT_OURS,
    OTHER_SETTINGS,
    OTHER_TIME,
    OWN_ID,
    REJECTED,
    REPEATED,
    UNKNOWN,
    Wrapping,
    flight_ns,
)
from .settings import AgentSettings, UdpSettings

__all__ = ["OF_OWN_NAME", "REASONS", "STATES", "Hearing", "make_hearing"]

#: Why a datagram is not taken in, in the order of ``verdict`` in ``_hearing/hearing.h``; 0: it is.
REASONS = (
    "", NOT_OURS, LENGTH, OTHER_SETTINGS, NO_FRAME, UNKNOWN, REJECTED, REPEATED, OTHER_TIME, OWN_ID,
)  # fmt: skip
OF_OWN_NAME = REASONS.index(OWN_ID)
STATES = (LISTENING, ALONE, JOINED)


def make_hearing(
    config: SwarmConfig, own: AgentSettings, udp: UdpSettings, wrapping: Wrapping, end: int, address: tuple[str, int]
) -> Hearing:
    """What one agent hears.

    :param config: the settings that all agents share.
    :param own: this agent.
    :param udp: the network.
    :param wrapping: whose header and key count.
    :param end: file descriptor of the socket that is read; the caller keeps it open.
    :param address: from which this agent sends.
    """
    key, session = wrapping.sealed_with
    host, port = address
    return Hearing(
        config.agents,
        own.id,
        config.anchor_every,
        config.slot_ns,
        config.seed,
        wrapping.header,
        key,
        session,
        flight_ns(config, udp.flight_time_ns, udp.byte_time_ns),
        position_step(config.extent_m),
        wrapping.length,
        config.own_bytes,
        config.slot_ns // 4,
        time.monotonic_ns(),
        own.clock_offset_ns,
        own.clock_drift_ppb,
        end,
        socket.inet_aton(host),
        port,
    )
