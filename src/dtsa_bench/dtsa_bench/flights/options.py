"""How a flight is carried out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import check, setting
from dtsa_channel_sim.model.config import AnswerLimits


@dataclass(frozen=True, slots=True)
class FlightOptions(AnswerLimits):
    """How a flight is carried out; none of it changes what happens in it.

    :raises ConfigError: for values that are not allowed.
    """

    processes: int | None = setting(
        None, "the agents live in so many processes; None: one an agent", minimum=1, maximum=1024
    )
    domain: int | None = setting(None, "ROS_DOMAIN_ID of the flight; None: a free one", minimum=0, maximum=232)
    respawn: float | None = setting(
        None,
        "real time: a process that died is started again after so long, and its agents come back; default: never",
        unit="s", minimum=0, maximum=3600,
    )  # fmt: skip
    late: Mapping[int, float] = setting(
        {}, "real time: agents that are started so long after slot 0, s by id", kind="structure", custom=True
    )
    wall_timeout_s: float | None = setting(
        None,
        "a flight that takes longer by the clock on the wall is ended; default: ten times timeout_s, at least 120",
        unit="s", minimum=1, maximum=864000,
    )  # fmt: skip
    priority: int = setting(
        10, "real time: real-time priority of the agents, one more for the channel, where allowed; 0: none",
        minimum=0, maximum=90,
    )  # fmt: skip
    pictures: bool = setting(True, "draw trajectories.png")

    def wall_limit_s(self, timeout_s: float) -> float:
        """How long a flight may take by the clock on the wall, s."""
        return max(120.0, 10.0 * timeout_s) if self.wall_timeout_s is None else self.wall_timeout_s

    def __post_init__(self) -> None:
        check(self)
        if not all(0.0 <= seconds <= 86400.0 for seconds in self.late.values()):
            raise ConfigError("late", self.late, "0 to 86400 s after slot 0")
