"""Is a recorded run what the protocol gives? Slot by slot, agent by agent, byte by byte."""

from .check import verify_bag
from .result import Difference, Result

__all__ = ["Difference", "Result", "verify_bag"]
