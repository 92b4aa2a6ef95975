"""The settings that all agents of a swarm share, as the protocol sees them."""

from __future__ import annotations

import math
from dataclasses import dataclass

OFF, ON, LEAVES = 0, 1, 2  # of an agent: not there, there, about to be switched off
PAPER, PAPER_INTENT, EXTENDED = "paper", "paper-intent", "extended"  # profiles of frames


@dataclass(frozen=True, slots=True)
class Rules:
    """What all agents of one swarm must agree on."""

    agents: int  # N
    slot_s: float  # t_s, s
    steps: int = 1  # control instants in a slot
    policy: str = "dtsa"
    estimator: str = "linear"
    tau: float = 0.25  # s, time constant of the vehicles (estimator intent)
    # dtsa
    selection: str = "candidates"
    epsilon: float = 0.5  # eq:pfs
    age_cap: float = 1.5
    boot_round: bool = True
    return_every: int = 20
    # frames
    profile: str = PAPER
    position_step: float = 0.002  # m
    r_min: float = 0.3  # m, eq:remaining_t_slots
    c_r: int = 1  # C, eq:remaining_t_slots
    targets_known: bool = True  # who has arrived is taken to stand at its target
    gossip: bool = True
    key: int = 0  # of the draws
    # lease
    anchor_every: int = 3  # M
    main_every: int = 3  # K M
    open_every: int = 11  # S; 0: none
    adoption: bool = True
    depth_rate: float = 0.5  # c
    lease_share: float = 1.0

    @property
    def slot_cycle(self) -> int:
        """Slot numbers on the air count modulo this: a multiple of all that policies count in slots."""
        period = math.lcm(2 * self.agents * self.main_every, max(self.open_every, 1))
        return 2**32 // period * period

    def slot_on_air(self, slot: int) -> int:
        """The number of a slot as frames have it."""
        return slot % self.slot_cycle

    @property
    def dt(self) -> float:
        """Control period, s."""
        return self.slot_s / self.steps
