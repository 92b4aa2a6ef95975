"""The protocol and flight logic of DTSA: no ROS, no clock, no I/O."""

from dtsa_agent.core.agent import Agent, AgentGroup, Decision
from dtsa_agent.core.settings.config import SwarmConfig
from dtsa_agent.core.settings.scenario import Scenario, make_scenario, plug_in_random

from .errors import ConfigError, DtsaError, LocalProtocolError, PluginError, RemoteProtocolError
from .frame import Frame, decode_frame, encode_frame
from .registry import REASONS
from .swarm import SlotOutcome, Swarm

__all__ = [
    "REASONS", "Agent", "AgentGroup", "ConfigError", "Decision", "DtsaError", "Frame", "LocalProtocolError",
    "PluginError", "RemoteProtocolError", "Scenario", "SlotOutcome", "Swarm", "SwarmConfig", "decode_frame",
    "encode_frame", "make_scenario", "plug_in_random",
]  # fmt: skip
