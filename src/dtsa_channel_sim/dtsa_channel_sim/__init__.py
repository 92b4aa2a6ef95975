"""The radio channel that a swarm shares: slots, collisions, losses, ranges and clocks."""

from .model.airtime import Airtime
from .model.channel import Channel
from .model.clocks import AgentClock, ClockConfig, make_clocks
from .model.config import CHANGEABLE, Change, ChannelConfig
from .model.medium import OnAir
from .model.realtime import FrameVerdict, RealtimeArbiter
from .model.topology import LinkLoss
from .model.verdict import COLLISION, IDLE, OUTCOMES, SUCCESS, Verdict

__all__ = [
    "CHANGEABLE",
    "COLLISION",
    "IDLE",
    "OUTCOMES",
    "SUCCESS",
    "AgentClock",
    "Airtime",
    "Change",
    "Channel",
    "ChannelConfig",
    "ClockConfig",
    "FrameVerdict",
    "LinkLoss",
    "OnAir",
    "RealtimeArbiter",
    "Verdict",
    "make_clocks",
]
