"""How long a channel waits for its agents."""

from __future__ import annotations

from dataclasses import dataclass

from dtsa_agent.core.settings.declaration import Settings, setting


@dataclass(frozen=True, slots=True)
class AnswerLimits(Settings):
    """Wall time that agents have to answer.

    :raises ConfigError: for values that are not allowed.
    """

    startup_s: float = setting(
        60.0, "wall time that all agents have to answer slot 0", unit="s", minimum=0.1, maximum=86400
    )
    answer_s: float = setting(
        10.0, "wall time that all agents have to answer any later slot", unit="s", minimum=0.1, maximum=86400
    )
