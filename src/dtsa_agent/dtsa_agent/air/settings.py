"""The agent of one process: what its swarm need not agree on."""

from __future__ import annotations

from dataclasses import dataclass

from dtsa_agent.core.settings.config import MAX_AGENTS
from dtsa_agent.core.settings.declaration import REQUIRED, Settings, check, setting
from dtsa_agent.core.station import ALL_BUT_ONE, QUORUMS, parse_quorum


@dataclass(frozen=True, slots=True)
class AgentSettings(Settings):
    """One agent of a swarm, and its clock.

    :raises ConfigError: at creation, naming the field, the value and what is allowed.
    """

    id: int = setting(REQUIRED, "id of this agent, 1 to agents", minimum=1, maximum=MAX_AGENTS)
    duration_s: float = setting(
        0.0, "it ends by itself after this time; 0: with a signal only", unit="s", minimum=0, maximum=1e6
    )
    quorum: str = setting(
        ALL_BUT_ONE, f"it hovers unless it hears, and is heard by, so many of the others: {QUORUMS}", custom=True
    )
    priority: int = setting(20, "real-time priority, where allowed; 0: none", minimum=0, maximum=90)
    clock_offset_ns: int = setting(
        0, "for trials: its clock shows this much more at the start", unit="ns", minimum=-(10**15), maximum=10**15
    )
    clock_drift_ppb: int = setting(
        0, "for trials: its clock runs fast by this many parts per billion", minimum=-(10**6), maximum=10**6
    )

    def __post_init__(self) -> None:
        check(self)
        parse_quorum(self.quorum)
