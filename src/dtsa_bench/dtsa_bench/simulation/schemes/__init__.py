"""Schemes of the literature, and bounds, as plug-ins beside the built-in policies.

docs/reference/schemes.md describes each.

Each is announced by entry point in the group ``dtsa.policies``, so ``--policy genie-age`` works in `simulate` and
`sweep`, and in nodes where its kind allows it.
"""

from .contention import Dominance, Sense, ThresholdAloha, ThresholdAoii
from .dtr import Dtr
from .genie import GenieAge, GenieError, GenieInnovation, Whittle
from .mixer import Mixer
from .tdma import EventTdma, Sotdma
from .unslotted import Beacons, Csma, PureAloha

__all__ = [
    "Beacons", "Csma", "Dominance", "Dtr", "EventTdma", "GenieAge", "GenieError", "GenieInnovation", "Mixer",
    "PureAloha", "Sense", "Sotdma", "ThresholdAloha", "ThresholdAoii", "Whittle",
]  # fmt: skip
