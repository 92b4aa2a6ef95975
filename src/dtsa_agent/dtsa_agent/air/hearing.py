"""What an agent hears, compiled: one call a slot sleeps, reads the port, and says whose frames have come."""

from __future__ import annotations

import time

from dtsa_agent.core.frame import position_step
from dtsa_agent.core.settings.config import SwarmConfig

from ._hearing import Hearing
from .contacts import limits_of
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
    trust_ns,
)
from .port import DatagramPort
from .settings import AgentSettings

__all__ = ["OF_OWN_NAME", "REASONS", "STATES", "Hearing", "make_hearing"]

#: Why a datagram is not taken in, in the order of ``verdict`` in ``_hearing/hearing.h``; 0: it is.
REASONS = (
    "", NOT_OURS, LENGTH, OTHER_SETTINGS, NO_FRAME, UNKNOWN, REJECTED, REPEATED, OTHER_TIME, OWN_ID,
)  # fmt: skip
OF_OWN_NAME = REASONS.index(OWN_ID)
STATES = ("listening", "alone", "joined")  # of a time base, in the order of libdtsa's numbers


def make_hearing(config: SwarmConfig, own: AgentSettings, wrapping: Wrapping, port: DatagramPort) -> Hearing:
    """What one agent hears.

    :param config: the settings that all agents share.
    :param own: this agent.
    :param wrapping: whose header and key count.
    :param port: what is read; the caller keeps it open.
    """
    key, session = wrapping.sealed_with
    limits = limits_of(config, wrapping.peers)
    return Hearing(
        config.agents,
        own.id,
        config.anchor_every,
        config.slot_ns,
        config.seed,
        wrapping.header,
        wrapping.layout.late,
        wrapping.peers,
        key,
        session,
        flight_ns(config, port.properties),
        position_step(config.extent_m),
        wrapping.length,
        config.own_bytes,
        config.slot_ns // 4,
        trust_ns(config, port.properties),
        time.monotonic_ns(),
        own.clock_offset_ns,
        own.clock_drift_ppb,
        limits.moving,
        limits.resting,
        limits.named,
        port.compiled,
    )
