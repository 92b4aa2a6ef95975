"""What agents find out before a flight with the help of what they do not need in flight: random numbers, hashes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.scenario import Scenario, make_scenario, policy_key

from .datagram import NETWORK, header_of
from .port import PortProperties


@dataclass(frozen=True, slots=True)
class Prepared:
    """What follows from the settings that all agents share."""

    scenario: Scenario
    header: bytes  # with which all datagrams begin


def prepare(config: SwarmConfig, port: PortProperties = NETWORK) -> Prepared:
    """What follows from the settings that all agents share.

    :param config: these settings.
    :param port: what carries the datagrams.
    :raises ConfigError: for a scenario that cannot be.
    """
    scenario = dataclasses.replace(make_scenario(config), policy_key=policy_key(config.seed))
    return Prepared(scenario, header_of(config, port))
