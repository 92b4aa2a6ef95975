"""Figures of merit of a flight: the one definition of all results, for `simulate`, `fly`, `sweep` and `verify`.

Times are those of slot ends, counted from the start of slot 0. Distances and paths are true ones, at every control
instant. Ages and estimate errors are taken at every slot's end from that of slot N - 1 on, with which a boot round is
over: over all pairs of an observer and a mover that the observer still has in A_p. An agent heard in the slot that just
ended has age 0.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, Swarm
from dtsa_agent.core.kernel import ffi, lib, memory
from dtsa_agent.core.plugins import make_swarm
from dtsa_agent.keys import with_key
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .config import RunConfig

Array = NDArray[np.float64]

# Why a flight ended; an empty text while it goes on. STOPPED: the user, or an error, ended it early.
COMPLETED, CRASHED, TIMED_OUT, STOPPED = "completed", "crashed", "timed out", "stopped"
ENDS = ("", COMPLETED, CRASHED, TIMED_OUT)  # in the order of libdtsa_sim/metrics.h

_LOSSES = (  # settings of the channel
    "loss", "burst_length", "p_good", "jam", "partition", "range_m", "capture_db", "loss_matrix", "link_loss", "losses",
    "schedule",
)  # fmt: skip
_update, _compare = lib.metrics_update, lib.metrics_compare  # once a slot


def metrics_tables(run: RunConfig, scenario: Scenario, everyone: bool) -> Swarm:
    """Tables that follow a flight from what the air carried, for callers that do not host all agents.

    :param everyone: one table an agent, which any loss needs; otherwise one that stands for all.
    """
    observers = list(range(1, run.swarm.agents + 1)) if everyone else [0]
    return with_key(make_swarm(run.swarm, scenario, local=[], observers=observers))


def may_share(run: RunConfig) -> bool:
    """Whether one table may stand for all agents: nothing is ever lost, and all would decide the same.

    In slots that a frame may outlast the channel names each frame's receivers, for which one table has no room.
    """
    air, longest_ns = run.air, run.air.airtime.total_ns(run.air.airtime.longest)
    is_lossless = not any(getattr(air, name) for name in _LOSSES) and longest_ns <= air.slot_ns
    return is_lossless and run.swarm.may_share_table


class FlightMetrics:
    """Follows one flight slot by slot, decides when it is over and sums up (``libdtsa_sim/metrics.c``).

    Ages leave out those that an observer takes to stand: a mover that nobody has heard since it set out is in none of
    them. Ages from waking on begin with the goal, for every receiver, heard or not.
    """

    def __init__(self, run: RunConfig, scenario: Scenario) -> None:
        swarm, limits, agents = run.swarm, run.limits, run.swarm.agents
        self.run = run
        self.scenario = scenario
        self.lost: set[int] = set()  # ids of agents that fell out of the flight
        self.awaited: set[int] = set()  # ids of those of them that will come back: the flight is not complete without
        self._torn_ways: set[int] = set()  # ids of those of whose way a part is not known
        self._frames: Counter[int] = Counter()  # frames on the air, by their lengths in bytes
        self._last = np.array(scenario.start, dtype=np.float64)  # (3, N) m, positions at the end of the last slot
        self._path = np.zeros(agents)  # m
        self._flies = np.array(scenario.moving, dtype=np.uint8)
        self._moving = self._flies.copy()  # of those, that have never been lost
        self._lost = np.zeros(agents, dtype=np.uint8)
        self.woken = np.full(agents, -1, dtype=np.int64)  # (N,) slot in which each that flies got its goal; -1: stands
        self._heard = np.zeros(agents, dtype=np.uint8)  # whether any agent has heard it since
        goals = 1 if scenario.plan is None else len(scenario.plan.goals)  # each of which wakes an agent once at most
        self._delays = np.zeros(agents * goals, dtype=np.int64)  # slots until each waking was heard, of those that were
        self._course = scenario.course(np.arange(agents, dtype=np.int32), swarm.r_min)
        target = np.array(scenario.target, dtype=np.float64)
        arrays = {
            "path": self._path, "last_position": self._last, "target": target, "goal": target.copy(),
            "flies": self._flies, "moving": self._moving, "lost": self._lost, "woken": self.woken,
            "heard": self._heard, "delays": self._delays,
        }  # fmt: skip
        self._lent = {name: memory(array, writable=True) for name, array in arrays.items()}
        tail, limit = (math.ceil(s * 1e9 / swarm.slot_ns - 1e-6) for s in (limits.tail_s, limits.timeout_s))
        self.kernel = ffi.new("metrics *", {
            **self._lent, "n": agents, "news_from": agents, "collision_m": limits.collision_m, "r_min": swarm.r_min,
            "stop_on_crash": limits.stop_on_crash, "tail": tail, "limit": max(1, limit), "min_distance2": 1e300,
            "completion_slot": -1, "crash_slot": -1, "split_slot": -1,
            "course": ffi.NULL if self._course is None else self._course.kernel,
        })  # fmt: skip
        self._seen: tuple[Any, Any] = None, None  # track and tables of the last slot
        self._track: Any = None  # memory of that track
        lib.metrics_start(self.kernel)

    @property
    def end(self) -> str:
        """COMPLETED, CRASHED, TIMED_OUT, or "" while the flight goes on."""
        return ENDS[self.kernel.end]

    @property
    def slots(self) -> int:
        """Slots flown."""
        return int(self.kernel.slots)

    @property
    def crash_slot(self) -> int:
        """Slots flown when the first two had crashed, -1: none have."""
        return int(self.kernel.crash_slot)

    @property
    def collided_pair(self) -> tuple[int, int] | None:
        """Ids of the first two that crashed."""
        return (self.kernel.crash_1, self.kernel.crash_2) if self.kernel.crash_slot >= 0 else None

    def update(self, slot: int, track: Array, tables: Swarm | None, outcome: int, lengths: Iterable[int] = ()) -> str:
        """Takes in a slot that has just ended.

        :param track: (S, 3, N) m, frame map: true positions at its control instants, the last at its end.
        :param tables: what the agents (or :func:`metrics_tables`) know after ``end(slot)``; None: ages are left out.
        :param outcome: the channel's verdict on it, IDLE, SUCCESS or COLLISION.
        :param lengths: bytes of each frame that was sent in it, whether or not anybody received it.
        :returns: why the flight is over now, or "" if it goes on.
        """
        if outcome not in (IDLE, SUCCESS, COLLISION):
            raise ValueError(f"outcome: got {outcome}")
        for length in lengths:
            self._frames[length] += 1
        if self._torn_ways:
            track = track.copy()
            for agent in self.lost:  # its vehicle hovers where it was last known, or nobody knows
                track[:, :, agent - 1] = self._last[:, agent - 1]
                if tables is not None:  # what it knew last does not grow old
                    tables.in_ap[tables.observer == agent - 1] = 0
            self.kernel.waits = not self._others_arrived(track[-1])
        if track is not self._seen[0] or tables is not self._seen[1]:  # mostly they are the same again
            self.use_arrays(track, tables)
        return ENDS[_update(self.kernel, slot, outcome)]

    def use_arrays(self, track: Array, tables: Swarm | None) -> None:
        """Read these arrays from the next slot on; parameters are those of :meth:`update`."""
        if track.shape[1:] != (3, len(self._moving)):
            raise ValueError(f"track: shape {track.shape}")
        self._seen, self._track = (track, tables), memory(track)
        self.kernel.track, self.kernel.steps = self._track, len(track)
        self.kernel.tables = ffi.NULL if tables is None else tables.kernel

    def count_frames(self, length: int, count: int) -> None:
        """Count frames of some bytes that were sent in slots which C has flown."""
        self._frames[length] += count

    def lose(self, agent: int, hovers: bool = True) -> None:
        """Leave out an agent that fell out of the flight: its path counts no more.

        :param hovers: its vehicle hovers where it was last known; otherwise its place is not known, and distances to
            it are left out until it is back.
        """
        if not hovers:
            self._last[:, agent - 1] = np.nan
        self.lost.add(agent)
        self._torn_ways.add(agent)
        self._lost[agent - 1], self._moving[agent - 1], self.woken[agent - 1] = 1, 0, -1

    def regain(self, agent: int) -> None:
        """Count an agent again that fell out: it has to arrive; its path stays unknown, its state out of the ages."""
        self.lost.discard(agent)
        self._lost[agent - 1] = 0
        self.awaited.discard(agent)

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(N,) agents whose state is in the ages and errors: movers that have never been lost."""
        return self._moving != 0

    def _others_arrived(self, now: Array) -> bool:
        """Whether movers are left, and those that came back are at their targets, too, and no more will come."""
        movers = {int(k) + 1 for k in np.flatnonzero(self._flies)}
        if movers & self.awaited or (movers and movers <= self.lost):
            return False
        back = [agent - 1 for agent in (self._torn_ways - self.lost) & movers]
        away = now[:, back] - self.scenario.target[:, back]
        return bool((np.sqrt((away * away).sum(axis=0)) <= self.run.swarm.r_min).all())

    def compare_tables(self, slot: int, digests: NDArray[np.uint32], chosen: NDArray[np.uint16]) -> None:
        """Take in what all agents believe at the start of a slot, where that may differ.

        :param digests: (N,) digests of their tables, equal where tables are equal.
        :param chosen: (N,) ids that they take for the slot's sender.
        """
        if self.lost:
            here = [agent not in self.lost for agent in range(1, len(digests) + 1)]
            digests, chosen = digests[here], chosen[here]
        _compare(self.kernel, slot, len(digests), memory(digests), memory(chosen))

    def closest(self) -> tuple[float, tuple[int, int]]:
        """Smallest distance so far, m, and the ids of the two agents."""
        return math.sqrt(self.kernel.min_distance2), (self.kernel.pair_1, self.kernel.pair_2)

    def efficiencies(self) -> dict[int, float]:
        """Distance from start to end over the path flown (1), by the id of each mover that has moved.

        With several goals it is the length of the straight lines from goal to goal, and known of complete flights only.
        """
        path, plan = self._path, self.scenario.plan
        if plan is not None and len(plan.goals) > 1:
            if self.kernel.completion_slot < 0:  # not all have arrived at the same time
                return {}
            direct = self.scenario.path_length
        else:
            direct = np.sqrt(((self._last - self.scenario.start) ** 2).sum(axis=0))
        return {int(k) + 1: float(direct[k] / path[k]) for k in np.flatnonzero(self._moving) if path[k] > 0.0}

    def summary(self, wall_time_s: float | None = None) -> dict[str, Any]:
        """The results as plain values, with the wall-clock time that the flight took, s.

        A figure that does not exist (no movers, not complete, ...) is None.
        """
        swarm, sums, complete = self.run.swarm, self.kernel, self.kernel.completion_slot >= 0
        flown = self.slots * swarm.slot_ns / 1e9
        pair = [sums.pair_1, sums.pair_2] if sums.pair_1 else None
        news = sums.age_count
        efficiency = list(self.efficiencies().values())
        airtime = self.run.air.airtime
        on_air_s = sum(airtime.on_air_ns(length) * count for length, count in self._frames.items()) / 1e9
        # Who sends at any instant expects no agent in a slot.
        agreement = None if swarm.policy_row.unslotted else 1.0 - sums.torn / max(1, sums.compared)
        outcomes = {"success": SUCCESS, "collision": COLLISION, "idle": IDLE}
        return {
            "agents": swarm.agents, "moving": swarm.movers, "policy": swarm.policy, "estimator": swarm.estimator,
            "avoider": swarm.avoider, "slot_ms": swarm.slot_ms, "loss": self.run.air.loss, "seed": swarm.seed,
            "end": self.end or STOPPED, "completed": complete, "timed_out": self.end == TIMED_OUT,
            "collided": self.crash_slot >= 0,
            "collided_pair": list(self.collided_pair) if self.collided_pair else None,
            "slots": {"total": self.slots, **{name: sums.outcomes[code] for name, code in outcomes.items()}},
            "min_distance_m": math.sqrt(sums.min_distance2) if pair else None,
            "min_distance_pair": pair,
            "min_distance_time_s": sums.min_slot * swarm.slot_ns / 1e9 if pair else None,
            "efficiency_mean": sum(efficiency) / len(efficiency) if efficiency else None,
            "completion_time_s": sums.completion_slot * swarm.slot_ns / 1e9 if complete else None,
            "flight_time_s": flown,
            "first_divergence_slot": sums.split_slot if sums.split_slot >= 0 else None,
            "equal_tables_share": 1.0 - sums.split / max(1, sums.compared),
            "agreement_share": agreement,
            "lost_agents": sorted(self.lost),
            "age_mean_slots": sums.age_sum / news if news else None,
            "age_max_slots": sums.age_max if news else None,
            "age_mean_ms": sums.age_sum / news * swarm.slot_ms if news else None,
            "age_max_ms": sums.age_max * swarm.slot_ms if news else None,
            **self._waking_results(),
            "frames_per_s": self._frames.total() / flown if flown else None,
            "bytes_per_s": sum(length * count for length, count in self._frames.items()) / flown if flown else None,
            "channel_load": on_air_s / flown if flown else None,
            "estimate_error_mean_m": sums.error_sum / news if news else None,
            "estimate_error_max_m": sums.error_max if news else None,
            "wall_time_s": wall_time_s,
            "realtime_factor": flown / wall_time_s if wall_time_s else None,
        }  # fmt: skip

    def _waking_results(self) -> dict[str, Any]:
        """Return what became of the agents that got goals; None where none did."""
        sums, slot_ms = self.kernel, self.run.swarm.slot_ms
        waiting = sums.slots - self.woken[(self.woken >= 0) & (self._heard == 0)]  # at least so long
        delays = np.sort(np.concatenate((self._delays[: sums.wakings_heard], waiting)))
        mean = sums.waking_sum / sums.waking_count if sums.waking_count else None
        return {
            "waking_age_mean_slots": mean,
            "waking_age_max_slots": None if mean is None else sums.waking_max,
            "waking_age_mean_ms": None if mean is None else mean * slot_ms,
            "waking_age_max_ms": None if mean is None else sums.waking_max * slot_ms,
            "wakings": sums.wakings,
            "wakings_unheard": sums.wakings - sums.wakings_heard,
            "first_heard_median_slots": _quantile(delays, 0.5),
            "first_heard_95_slots": _quantile(delays, 0.95),
            "first_heard_max_slots": _quantile(delays, 1.0),
        }


def _quantile(values: NDArray[np.int64], share: float) -> int | None:
    """The least of sorted values that a share of them does not exceed."""
    return int(values[max(0, int(np.ceil(share * len(values))) - 1)]) if len(values) else None
