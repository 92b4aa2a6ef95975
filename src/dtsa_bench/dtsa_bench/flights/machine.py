"""What a flight in real time says about the machine that it was flown on."""

from __future__ import annotations

from typing import Any

import numpy as np

from dtsa_agent.core.agents.delays import Delays
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

_LAG = 0.25  # of a slot: who hears of a frame later than this decides without it now and then
_LATE = 0.005  # share of frames, or of entries of reports
_ON_TIME = 0.95


class DeliveryStatistics(ChannelObserver):
    """How long after its arrival by the channel's time line each receiver took in a frame, as it says itself."""

    def __init__(self, agents: int) -> None:
        self._agents, self._delays = agents, Delays(agents)

    def judged(self, slot: int, answers: Answers, frames: dict[int, bytes], verdict: Verdict) -> None:
        for taken in answers.taken_in or ():
            receivers = np.flatnonzero(taken.mask)
            self._delays.add_many(taken.at_ns[receivers] - taken.arrival_ns, receivers)

    def summary(self) -> dict[str, Any]:
        """The results, ms; None where nothing was heard."""

        def of(series: int | None) -> dict[str, float | None]:
            delays = self._delays
            return {
                "p50": delays.quantile_ms(0.5, series),
                "p99": delays.quantile_ms(0.99, series),
                "max": delays.largest_ms(series),
            }

        return {"delivery_ms": {"all": of(None), **{str(k + 1): of(k) for k in range(self._agents)}}}


def channel_summary(channel: RealtimeChannel) -> dict[str, Any]:
    """How the channel kept up."""
    pace = channel.pace
    return {
        "late_frames": channel.late_frames,
        "missed_reports": channel.missed,
        "round_ms": channel.round_ms,
        "channel_lag_p99_ms": pace.lag.quantile_ms(0.99),
        "channel_lag_max_ms": pace.lag.largest_ms(),
        "stalls": [[begin / 1e9, end / 1e9] for begin, end in pace.stalls],
        "stall_count": pace.stall_count,
    }


def tight(channel: RealtimeChannel) -> str:
    """What to say before slot 0 of a flight that the machine will hardly keep up with; empty if it should."""
    if not channel.tight:
        return ""
    return (
        f"a round of messages between channel and agents takes {channel.round_ms:.1f} ms here, a slot has "
        f"{channel.slot_ns / 1e6:g} ms: the machine may not keep up; longer slots or fewer processes would help"
    )


def warning(channel: RealtimeChannel, summary: dict[str, Any]) -> str | None:
    """Why figures of a flight describe the machine rather than the protocol; None if they do not."""
    frames = max(1, channel.pace.lag.count() + channel.late_frames)
    entries = max(1, summary["slots"]["total"] * channel.agents)
    lag, on_time = summary["channel_lag_p99_ms"], summary["sends_on_time_share"]
    longest = max((end - begin for begin, end in summary["stalls"]), default=0.0)
    found = [
        text
        for text, wrong in (
            (tight(channel), channel.tight),
            (channel.fell_behind, bool(channel.fell_behind)),
            (f"the channel stood still {summary['stall_count']} times, for up to {longest:.2f} s", longest > 0.0),
            (f"the channel's lag is {lag or 0.0:.1f} ms (p99)", lag is not None and lag * 1e6 > _LAG * channel.slot_ns),
            (f"{channel.late_frames} frames came too late", channel.late_frames > _LATE * frames),
            (f"{channel.missed} entries of reports came too late", channel.missed > _LATE * entries),
            (f"{on_time or 0.0:.1%} of the frames left on time", on_time is not None and on_time < _ON_TIME),
        )
        if wrong
    ]
    return f"figures describe the machine rather than the protocol: {'; '.join(found)}" if found else None
