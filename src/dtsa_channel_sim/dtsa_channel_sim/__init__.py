"""The radio channel that a swarm shares: slots, collisions, losses, ranges and clocks."""

from dtsa_channel_sim.model.air import Air, FrameVerdict
from dtsa_channel_sim.model.airtime import Airtime
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.config import CHANGEABLE, AgentClock, ChannelConfig, ClockConfig, make_clocks
from dtsa_channel_sim.model.measured import MeasuredLosses
from dtsa_channel_sim.model.medium import Medium, OnAir, Reception
from dtsa_channel_sim.model.schedule import Change
from dtsa_channel_sim.model.topology import LinkLoss
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, OUTCOMES, SUCCESS, Verdict

__all__ = [
    "CHANGEABLE", "COLLISION", "IDLE", "OUTCOMES", "SUCCESS", "AgentClock", "Air", "Airtime", "Change", "Channel",
    "ChannelConfig", "ClockConfig", "FrameVerdict", "LinkLoss", "MeasuredLosses", "Medium", "OnAir", "Reception",
    "Verdict", "make_clocks",
]  # fmt: skip
