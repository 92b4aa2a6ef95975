"""The radio channel that a swarm shares: slots, collisions, losses, ranges and clocks."""

from .model.air import Air, FrameVerdict
from .model.airtime import Airtime
from .model.channel import Channel
from .model.clocks import AgentClock, ClockConfig, make_clocks
from .model.config import CHANGEABLE, Change, ChannelConfig
from .model.medium import Medium, OnAir, Reception
from .model.simulated_air import SimulatedAir, SimulatedPort
from .model.topology import LinkLoss
from .model.verdict import COLLISION, IDLE, OUTCOMES, SUCCESS, Verdict

__all__ = [
    "CHANGEABLE",
    "COLLISION",
    "IDLE",
    "OUTCOMES",
    "SUCCESS",
    "AgentClock",
    "Air",
    "Airtime",
    "Change",
    "Channel",
    "ChannelConfig",
    "ClockConfig",
    "FrameVerdict",
    "LinkLoss",
    "Medium",
    "OnAir",
    "Reception",
    "SimulatedAir",
    "SimulatedPort",
    "Verdict",
    "make_clocks",
]
