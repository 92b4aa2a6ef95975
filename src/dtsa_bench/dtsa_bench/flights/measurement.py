"""Measures a flight of nodes, knows when it is over, and how well machine and clocks kept up in real time."""

from __future__ import annotations

import time
from collections import deque
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario
from dtsa_agent.core.delays import Delays
from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_bench.runs.delivery import DeliveryCounts
from dtsa_bench.runs.metrics import FlightMetrics, metrics_tables
from dtsa_channel_sim.model.verdict import Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

_MAX_PATH_BYTES = 1 << 24
_REPORTS_S, _REPORT_SLOTS = 0.5, 3  # a slot in real time counts once it is reported: together so late at most
_LAG = 0.25  # of a slot: who hears of a frame later than this decides without it now and then
_LATE = 0.005  # share of frames, or of entries of reports
_ON_TIME = 0.95
ON_TIME_NS = 1_000_000  # a frame this far from the swarm's common time is not on time any more
_END = 50  # slots
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


class FlightPath(EvenlySpread[NDArray[np.float64]]):
    """Where all were at the starts of slots, each (3, N) m, frame map."""

    def __init__(self, agents: int) -> None:
        super().__init__(_MAX_PATH_BYTES // (3 * agents * 8))
        self._agents = agents

    def array(self) -> NDArray[np.float64]:
        """(T, 3, N) m, frame map."""
        return np.array(self.kept).reshape(-1, 3, self._agents)


class FlightMeasurement(ChannelObserver):
    """Follows a flight with the metrics, and knows when they say that it is over."""

    def __init__(self, run: RunConfig, scenario: Scenario) -> None:
        self.scenario = scenario
        self.metrics = FlightMetrics(run, scenario)
        self.hearing = DeliveryCounts(run.swarm.agents)
        self.positions = FlightPath(run.swarm.agents)
        self.begin_s = self.end_s = 0.0  # wall clock: slot 0 answered by all, flight over; 0: not yet
        self.tables = metrics_tables(run, scenario, everyone=True)  # what each agent knows by what it has received
        self._agents, self._slot_s = run.swarm.agents, run.swarm.slot_s
        self._reports_s = 0.0 if run.mode == LOCKSTEP else _REPORTS_S + _REPORT_SLOTS * self._slot_s
        self._oracle = run.swarm.estimator_row.needs_everybody
        self._outcome = 0
        self._lengths: list[int] = []  # of the frames of the slot that is being flown
        self._compared = self.tables.digest, self.tables.chosen  # of the slot that is being flown

    @property
    def wall_time_s(self) -> float:
        """Wall-clock time of the flight so far, s; without the wait for its last reports."""
        passed_s = max(0.0, (self.end_s or time.monotonic()) - self.begin_s) if self.begin_s else 0.0
        return max(min(passed_s, self.metrics.slots * self._slot_s), passed_s - self._reports_s)

    def start_known(self, at_s: float) -> None:
        self.begin_s = at_s

    def all_answered(self, slot: int, answers: Answers) -> None:
        self.positions.append(answers.position.copy())
        if not slot:
            self.begin_s = self.begin_s or time.monotonic()
            return
        self.metrics.compare_tables(slot - 1, *self._compared)
        if self._oracle:
            self.tables.estimate_position[:] = answers.position
        if self.metrics.update(slot - 1, answers.track, self.tables, self._outcome, self._lengths):
            self.end_s = time.monotonic()

    def over(self) -> str:
        """Why the flight is over; empty: it goes on."""
        return str(self.metrics.end or "")

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        self._outcome, frames = verdict.outcome, answers.frames
        self._compared = answers.digest.copy(), answers.chosen.copy()
        self._lengths = [len(frames[sender]) for sender in verdict.senders]
        self.scenario.advance(slot, self.tables)  # what all know about each other's goals
        mask = verdict.mask(self._agents)
        gone = [agent - 1 for agent in self.metrics.lost]  # no frame reaches them
        self.hearing.add_slot(len(verdict.senders), np.delete(mask, gone, axis=1) if gone else mask)
        heard = [(slot, frames[sender], mask[row]) for row, sender in enumerate(verdict.senders) if mask[row].any()]
        if answers.receipts is not None:  # in real time the receivers themselves know best
            heard = [(taken.slot, taken.data, taken.mask) for taken in answers.receipts.values()]
        for sent_slot, data, receivers in heard:
            if self.tables.hear(sent_slot, data, receivers):
                self.hearing.add_accepted(receivers)
        self.tables.end(slot)

    def agent_silent(self, agent: int) -> None:
        self.metrics.lose(agent)

    def agents_back(self, agents: list[int]) -> None:
        for agent in agents:
            self.metrics.regain(agent)

    def close(self) -> None:
        self.end_s = self.end_s or (time.monotonic() if self.begin_s else 0.0)

    def summary(self) -> dict[str, Any]:
        """The results so far, with the keys of ``summary.json``."""
        return self.metrics.summary(self.wall_time_s)


class _Sends(EvenlySpread[float]):
    """How far an agent's frames left from the swarm's common time, ns."""

    def __init__(self) -> None:
        super().__init__(_KEPT)
        self.on_time = self.as_due = 0
        self.largest = 0.0  # the one farthest away

    def add(self, value: float, wait_ns: int) -> None:
        """Receive one; ``wait_ns``: how long the agent may have waited for another frame by the rules."""
        self.append(value)
        self.on_time += abs(value) <= ON_TIME_NS
        self.as_due += -ON_TIME_NS <= value <= ON_TIME_NS + wait_ns
        self.largest = max(self.largest, value, key=abs)


class TimingStatistics(ChannelObserver):
    """Collects when slots start, frames leave, and receivers have them, as they say themselves, and sums it up.

    :param wait_ns: how long after the start of its slot an agent may wait for another frame by the rules.
    """

    def __init__(self, agents: int, wait_ns: int = 0) -> None:
        self._agents, self._wait_ns = agents, wait_ns
        self._unsent = 0  # frames that were made too late to be sent
        self._spreads = 0  # slots of which two agents told their start
        self._spread_sum = self._spread_max = 0.0  # ns, over those
        self._last_spreads: deque[float] = deque(maxlen=_END)  # ns
        self._away: dict[int, _Sends] = {}  # by agent
        self._delays = Delays(agents)  # by receiver, from a frame's arrival by the channel's time line

    def arbitrated(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        for taken in (answers.receipts or {}).values():
            receivers = np.flatnonzero(taken.mask)
            self._delays.add_many(taken.at_ns[receivers] - taken.arrival_ns, receivers)

    def add_slot(
        self, answered: NDArray[np.bool_], sent: NDArray[np.bool_], offset_ns: NDArray[np.int64],
        chosen: NDArray[np.uint16],
    ) -> None:  # fmt: skip
        """Receive what agents report of a slot, (N,): whether they do, whether they sent, when either began, whose turn
        each took it for."""
        self._unsent += int(np.count_nonzero(answered & ~sent & (chosen == np.arange(1, self._agents + 1))))
        starts = np.sort(offset_ns[answered & ~sent])
        count = len(starts)
        if count > 1:
            spread = float(starts[-1] - starts[0])
            self._spreads += 1
            self._spread_sum += spread
            self._spread_max = max(self._spread_max, spread)
            self._last_spreads.append(spread)
        for index in np.flatnonzero(sent).tolist() if count else ():
            median = (starts[(count - 1) // 2] + starts[count // 2]) / 2
            self._away.setdefault(index + 1, _Sends()).add(float(offset_ns[index] - median), self._wait_ns)

    @property
    def as_due_share(self) -> float:
        """Share of the frames, those that were not sent among them, that left on time or after a wait by the rules."""
        made = self._unsent + sum(sends.count for sends in self._away.values())
        return sum(sends.as_due for sends in self._away.values()) / made if made else 1.0

    def summary(self) -> dict[str, Any]:
        """The results; None where nothing was reported.

        ``clock_spread_*_ms``: between the first and the last agent's start of the same slot, over all slots, and the
        largest of the last 50; ``send_offset_ms``: by agent, how far its frames left from the swarm's common time (the
        median of the slot's starts; beyond 4096 frames the median is that of evenly spread ones);
        ``sends_on_time_share``: frames within 1 ms of it; ``delivery_ms``: how long after its arrival by the channel's
        time line receivers took in a frame.
        """
        frames = sum(sends.count for sends in self._away.values())
        receivers = {"all": None, **{str(k + 1): k for k in range(self._agents)}}
        return {
            "delivery_ms": {name: self._delays.quantiles_ms(k) for name, k in receivers.items()},
            "clock_spread_max_ms": self._spread_max / 1e6 if self._spreads else None,
            "clock_spread_mean_ms": self._spread_sum / self._spreads / 1e6 if self._spreads else None,
            "clock_spread_end_ms": max(self._last_spreads) / 1e6 if self._spreads else None,
            "sends_on_time_share": sum(sends.on_time for sends in self._away.values()) / frames if frames else None,
            "send_offset_ms": {
                str(agent): {"median": float(np.median(sends.kept)) / 1e6, "max": sends.largest / 1e6}
                for agent, sends in sorted(self._away.items())
            },
        }  # fmt: skip


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


def warning(channel: RealtimeChannel, as_due_share: float, summary: dict[str, Any]) -> str | None:
    """Why figures of a flight describe the machine rather than the protocol; None if they do not."""
    frames = max(1, channel.pace.lag.count() + channel.air.late)
    entries = max(1, summary["slots"]["total"] * channel.agents)
    lag = summary["channel_lag_p99_ms"]
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
            (f"{as_due_share:.1%} of the frames left on time", as_due_share < _ON_TIME),
        )
        if wrong
    ]
    return f"figures describe the machine rather than the protocol: {'; '.join(found)}" if found else None
