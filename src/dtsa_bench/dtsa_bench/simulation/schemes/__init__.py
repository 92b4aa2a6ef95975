"""Schemes of the literature, and bounds, as plug-ins beside the built-in policies.

docs/reference/schemes.md describes each.

Each is announced by entry point in the group ``dtsa.policies``, so ``--policy genie-age`` works in `simulate` and
`sweep`, and in nodes where its kind allows it.
"""

from .contention import Dominance, ThresholdAloha
from .dtr import Dtr
from .event_tdma import EventTdma
from .genie import GenieAge, GenieError, GenieInnovation, Whittle
from .mixer import Mixer
from .sense import Sense
from .sotdma import Sotdma
from .threshold_aoii import ThresholdAoii
from .unslotted import Beacons, Csma, PureAloha

__all__ = [
    "Beacons", "Csma", "Dominance", "Dtr", "EventTdma", "GenieAge", "GenieError", "GenieInnovation", "Mixer",
    "PureAloha", "Sense", "Sotdma", "ThresholdAloha", "ThresholdAoii", "Whittle",
]  # fmt: skip
