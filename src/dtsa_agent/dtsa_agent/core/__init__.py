"""The protocol and flight logic of DTSA: no ROS, no clock, no I/O."""

from .abstract_swarm import AbstractSwarm
from .agent import Agent, AgentGroup, Decision
from .config import SwarmConfig
from .errors import ConfigError, DtsaError, LocalProtocolError, PluginError, RemoteProtocolError
from .frame import Frame, decode_frame, encode_frame
from .outcome import SlotOutcome
from .priority import priority, select
from .registry import REASONS
from .scenario import Scenario, make_scenario
from .swarm import Swarm

__all__ = [
    "REASONS", "AbstractSwarm", "Agent", "AgentGroup", "ConfigError", "Decision", "DtsaError", "Frame",
    "LocalProtocolError", "PluginError", "RemoteProtocolError", "Scenario", "SlotOutcome", "Swarm", "SwarmConfig",
    "decode_frame", "encode_frame", "make_scenario", "priority", "select",
]  # fmt: skip
