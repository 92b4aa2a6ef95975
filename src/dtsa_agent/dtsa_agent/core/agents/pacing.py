"""When an agent that begins its slots by itself decides, and after how long it begins anew."""

from __future__ import annotations

from dtsa_agent.core.settings.config import SwarmConfig

# Of a slot: an agent that has heard all it waits for decides this long before its slot starts, mostly as soon as it has
# heard: one wake-up of its process less, and its frame leaves on time.
LEAD = 0.7
LATEST_LEAD = 0.06  # while it misses the frame of the slot before, only this long
MOST_EARLY = 64  # frames of slots that are still to come, kept until they do
BETWEEN = 0.2  # on a network, between a frame that left late and the next slot: clocks differ, nobody waits any longer


def latest_send_ns(slot_ns: int, flight_ns: int) -> int:
    """How late a frame may still leave, ns after its slot has started: it is over before the next one starts.

    :param slot_ns: ns, length of a slot.
    :param flight_ns: ns, from the order to send a frame until its arrival.
    """
    return max(slot_ns - flight_ns - round(BETWEEN * slot_ns), slot_ns // 10)


def too_long_ns(config: SwarmConfig) -> int:
    """After how long a stand-still an agent begins anew, ns: others may think it dead, and it knows too little.

    :param config: what all agents share.
    """
    return max(500, 3 * config.anchor_every * config.agents) * config.slot_ns
