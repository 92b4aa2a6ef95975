"""The radio channel that a swarm shares: slots, collisions, losses, ranges and clocks."""

from .airtime import Airtime
from .channel import Channel
from .clocks import AgentClock, ClockConfig, make_clocks
from .config import CHANGEABLE, Change, ChannelConfig
from .config_fields import FieldInfo, fields_of
from .medium import OnAir
from .realtime import FrameVerdict, RealtimeArbiter
from .topology import LinkLoss
from .verdict import COLLISION, IDLE, OUTCOMES, SUCCESS, Verdict

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
    "FieldInfo",
    "FrameVerdict",
    "LinkLoss",
    "OnAir",
    "RealtimeArbiter",
    "Verdict",
    "fields_of",
    "make_clocks",
]
