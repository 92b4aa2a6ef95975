"""What a flight in real time says about the machine that it was flown on, and how well its clocks kept together."""

from __future__ import annotations

from collections import deque
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.delays import Delays
from dtsa_agent.ros.common.messages import Fields
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

_LAG = 0.25  # of a slot: who hears of a frame later than this decides without it now and then
_LATE = 0.005  # share of frames, or of entries of reports
_ON_TIME = 0.95


def channel_summary(channel: RealtimeChannel) -> dict[str, Any]:
    """How the channel kept up."""
    pace = channel.pace
    return {
        "late_frames": channel.air.late,
        "missed_reports": channel.accounts.missed,
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
    frames = max(1, channel.pace.lag.count() + channel.air.late)
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
            (f"{channel.air.late} frames came too late", channel.air.late > _LATE * frames),
            (f"{channel.accounts.missed} entries of reports came too late", channel.accounts.missed > _LATE * entries),
            (f"{on_time or 0.0:.1%} of the frames left on time", on_time is not None and on_time < _ON_TIME),
        )
        if wrong
    ]
    return f"figures describe the machine rather than the protocol: {'; '.join(found)}" if found else None


ON_TIME_NS = 1_000_000  # a frame this far from the swarm's common time is not on time any more
_END = 50  # slots
_OPEN = 1000  # slots that are not summed up yet
_KEPT = 4096  # frames of an agent for the median
Value = TypeVar("Value")


class EvenlySpread(Generic[Value]):
    """Values of a series in bounded memory: all until there are too many, then evenly spread ones."""

    def __init__(self, most: int) -> None:
        self.kept: list[Value] = []
        self.count, self._most, self._every = 0, most, 1

    def append(self, value: Value) -> None:
        """Add a value; when there is no more room, every second one is forgotten."""
        if self.count % self._every == 0:
            self.kept.append(value)
            if len(self.kept) > self._most:
                del self.kept[1::2]
                self._every *= 2
        self.count += 1


class _Sends(EvenlySpread[float]):
    """How far an agent's frames left from the swarm's common time, ns."""

    def __init__(self) -> None:
        super().__init__(_KEPT)
        self.on_time = 0
        self.largest = 0.0  # the one farthest away

    def append(self, value: float) -> None:
        super().append(value)
        self.on_time += abs(value) <= ON_TIME_NS
        self.largest = max(self.largest, value, key=abs)


class TimingStatistics(ChannelObserver):
    """Collects when slots start, frames leave, and receivers have them, as they say themselves, and sums it up."""

    def __init__(self, agents: int) -> None:
        self._agents = agents
        #: ns by slot, (2, N): starts of the slot of those that kept silent, then transmissions; nan: not known.
        self._open: dict[int, NDArray[np.float64]] = {}
        self._last_summed = -1
        self._spreads = 0  # slots that are summed up and of which two agents told their start
        self._spread_sum = self._spread_max = 0.0  # ns, over those
        self._last_spreads: deque[float] = deque(maxlen=_END)  # ns
        self._away: dict[int, _Sends] = {}  # by agent
        self._delays = Delays(agents)  # by receiver, from a frame's arrival by the channel's time line

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        for taken in (answers.receipts or {}).values():
            receivers = np.flatnonzero(taken.mask)
            self._delays.add_many(taken.at_ns[receivers] - taken.arrival_ns, receivers)

    def report(self, message: Fields) -> None:
        """Receive what one process says of some slots; nothing of slots that have been summed up."""
        slots, at = message.slot.tolist(), np.array(message.agent, dtype=np.intp) - 1
        sent, offsets_ns = (a.reshape(len(slots), len(at)) for a in (message.length > 0, message.offset_ns))
        for row, slot in enumerate(slots):
            if slot in self._open or slot > self._last_summed:
                known = self._open.setdefault(slot, np.full((2, self._agents), np.nan))
                known[sent[row].astype(np.intp), at] = offsets_ns[row]
        while len(self._open) > _OPEN:
            self._sum_up(next(iter(self._open)))

    def _sum_up(self, slot: int) -> None:
        """Nothing more will be told of a slot."""
        self._last_summed = max(self._last_summed, slot)
        starts, sends = self._open.pop(slot)
        usable = np.sort(starts[~np.isnan(starts)])
        count = len(usable)
        if count > 1:
            spread = float(usable[-1] - usable[0])
            self._spreads += 1
            self._spread_sum += spread
            self._spread_max = max(self._spread_max, spread)
            self._last_spreads.append(spread)
        for index in np.flatnonzero(~np.isnan(sends)).tolist() if count else ():
            median = (usable[(count - 1) // 2] + usable[count // 2]) / 2
            self._away.setdefault(index + 1, _Sends()).append(float(sends[index] - median))

    def summary(self) -> dict[str, Any]:
        """The results; None where nothing was reported.

        ``clock_spread_*_ms``: between the first and the last agent's start of the same slot, over all slots, and the
        largest of the last 50; ``send_offset_ms``: by agent, how far its frames left from the swarm's common time (the
        median of the slot's starts; beyond 4096 frames the median is that of evenly spread ones);
        ``sends_on_time_share``: frames within 1 ms of it; ``delivery_ms``: how long after its arrival by the channel's
        time line receivers took in a frame.
        """
        for slot in sorted(self._open):
            self._sum_up(slot)
        frames = sum(sends.count for sends in self._away.values())
        delays, receivers = self._delays, {"all": None, **{str(k + 1): k for k in range(self._agents)}}
        return {
            "delivery_ms": {
                name: {"p50": delays.quantile_ms(0.5, k), "p99": delays.quantile_ms(0.99, k),
                       "max": delays.largest_ms(k)}
                for name, k in receivers.items()
            },
            "clock_spread_max_ms": self._spread_max / 1e6 if self._spreads else None,
            "clock_spread_mean_ms": self._spread_sum / self._spreads / 1e6 if self._spreads else None,
            "clock_spread_end_ms": max(self._last_spreads) / 1e6 if self._spreads else None,
            "sends_on_time_share": sum(sends.on_time for sends in self._away.values()) / frames if frames else None,
            "send_offset_ms": {
                str(agent): {"median": float(np.median(sends.kept)) / 1e6, "max": sends.largest / 1e6}
                for agent, sends in sorted(self._away.items())
            },
        }  # fmt: skip
