"""What a flight was worth: the one definition of all results, for `simulate`, `fly`, `sweep` and `verify`.

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
from dtsa_agent.core.plugins.entry_points import make_swarm, shareable
from dtsa_agent.keys import with_key
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS

from .config import RunConfig
from .sums import ARRIVED as _ARRIVED
from .sums import CRASHED as _CRASHED
from .sums import FlightSums
from .wakings import Wakings

Array = NDArray[np.float64]

# Why a flight ended; an empty text while it goes on. STOPPED: the user, or an error, ended it early.
COMPLETED, CRASHED, TIMED_OUT, STOPPED = "completed", "crashed", "timed out", "stopped"


def metrics_tables(run: RunConfig, scenario: Scenario, everyone: bool) -> Swarm:
    """Tables that follow a flight from what the air carried, for callers that do not host all agents.

    :param run: the run.
    :param scenario: its scenario.
    :param everyone: one table an agent, which any loss needs; otherwise one that stands for all.
    """
    observers = list(range(1, run.swarm.agents + 1)) if everyone else [0]
    return with_key(make_swarm(run.swarm, scenario, local=[], observers=observers))


def may_share(run: RunConfig) -> bool:
    """Whether one table may stand for all agents: nothing is ever lost, and all would decide the same.

    In slots that a frame may outlast the channel names each frame's receivers, for which one table has no room.

    :param run: the run.
    """
    air, swarm = run.air, run.swarm
    lossless = not (
        air.loss
        or air.burst_length
        or air.p_good
        or air.jam
        or air.partition
        or air.range_m
        or air.capture_db
        or air.loss_matrix
        or air.link_loss
        or air.losses
        or air.schedule
        or air.airtime.total_ns(air.airtime.longest) > air.slot_ns
    )
    return lossless and shareable(swarm)


class FlightMetrics:
    """Follows one flight slot by slot, decides when it is over and sums up.

    :param run: the run.
    :param scenario: its scenario.
    """

    def __init__(self, run: RunConfig, scenario: Scenario) -> None:
        swarm, limits = run.swarm, run.limits
        self.run = run
        self.scenario = scenario
        self.end = ""  # COMPLETED, CRASHED, TIMED_OUT, or "" while the flight goes on
        self.slots = 0
        self.completion_slot = -1  # slots flown when all had arrived at the same time, -1: not yet
        self.crash_slot = -1  # slots flown when the first two had crashed
        self.collided_pair: tuple[int, int] | None = None
        self.split_slot = -1  # first slot in which two agents' tables differed, -1: never
        self._split = 0  # slots in which they did
        self._torn = 0  # slots in which two agents took different agents for the sender
        self._compared = 0
        self.lost: set[int] = set()  # ids of agents that fell out of the flight
        self.awaited: set[int] = set()  # ids of those of them that will come back: the flight is not complete without
        self._torn_ways: set[int] = set()  # ids of those of whose way a part is not known
        self._outcomes = [0, 0, 0]  # by IDLE, SUCCESS, COLLISION
        start = np.ascontiguousarray(scenario.start, dtype=np.float64)
        target = np.ascontiguousarray(scenario.target, dtype=np.float64)
        moving = np.ascontiguousarray(scenario.moving, dtype=np.uint8)
        self._wakings = Wakings(scenario)
        self._sums = FlightSums(start, target, moving, swarm.agents, limits.collision_m, swarm.r_min, self._wakings)
        self._last = start  # (3, N) m, positions at the end of the last slot
        self._frames: Counter[int] = Counter()  # frames on the air, by their lengths in bytes
        self._tail = math.ceil(limits.tail_s * 1e9 / swarm.slot_ns - 1e-6)
        # First number of slots at which the flight is over whatever happens.
        self._limit = max(1, math.ceil(limits.timeout_s * 1e9 / swarm.slot_ns - 1e-6))

    def update(self, slot: int, track: Array, tables: Swarm | None, outcome: int, lengths: Iterable[int] = ()) -> str:
        """Takes in a slot that has just ended.

        :param track: (S, 3, N) m, frame map: true positions at its control instants, the last at its end.
        :param tables: what the agents (or :func:`metrics_tables`) know after ``end(slot)``; None: ages are left out.
        :param outcome: the channel's verdict on it, IDLE, SUCCESS or COLLISION.
        :param lengths: bytes of each frame that was sent in it, whether or not anybody received it.
        :returns: why the flight is over now, or "" if it goes on.
        """
        if not self.slots:
            self._wakings.begin(slot)
        self.slots = done = slot + 1
        self._outcomes[outcome] += 1
        for length in lengths:
            self._frames[length] += 1
        if self.lost:
            track = track.copy()
            for agent in self.lost:  # its vehicle hovers where it was last known, or nobody knows
                track[:, :, agent - 1] = self._last[:, agent - 1]
        self._last = track[-1].copy()
        state = self._sums.update(done, track, tables)
        self._wakings.follow(done, self._last)
        final = self._wakings.final
        if final is not None and not all(final[k] for k in range(len(final)) if k + 1 not in self.lost):
            state &= ~_ARRIVED  # at its target by chance, with goals still to come
        if state & _ARRIVED and self.lost | self._torn_ways and not self._others_arrived():
            state &= ~_ARRIVED
        if state:
            if state & _CRASHED and self.crash_slot < 0:
                self.crash_slot = done
                self.collided_pair = self._sums.result()["pair"]
                if self.run.limits.stop_on_crash:
                    self.end = CRASHED
                    return CRASHED
            if state & _ARRIVED and self.completion_slot < 0:
                self.completion_slot = done
                self._limit = done + self._tail
        if done >= self._limit:
            self.end = TIMED_OUT if self.completion_slot < 0 else COMPLETED
        return self.end

    def lose(self, agent: int, hovers: bool = True) -> None:
        """Leave out an agent that fell out of the flight: its path counts no more.

        :param hovers: its vehicle hovers where it was last known; otherwise its place is not known, and distances to
            it are left out until it is back.
        """
        if not hovers:
            self._last = self._last.copy()
            self._last[:, agent - 1] = np.nan
        self.lost.add(agent)
        self._wakings.gone[agent - 1], self._wakings.woken[agent - 1] = 1, -1
        self._torn_ways.add(agent)
        self._sums.drop(agent - 1)

    def regain(self, agent: int) -> None:
        """Count an agent again that fell out: it has to arrive; its path stays unknown, its state out of the ages."""
        self.lost.discard(agent)
        self._wakings.gone[agent - 1] = 0
        self.awaited.discard(agent)

    @property
    def woken(self) -> NDArray[np.int64]:
        """(N,) slot in which each agent that flies got its goal; -1: it stands."""
        return self._wakings.woken

    @property
    def counted(self) -> NDArray[np.bool_]:
        """(N,) agents whose state is in the ages and errors: movers that have never been lost."""
        counted = np.asarray(self.scenario.moving, dtype=np.bool_).copy()
        counted[[agent - 1 for agent in self._torn_ways]] = False
        return counted

    def _others_arrived(self) -> bool:
        """Whether movers are left, and those that came back are at their targets, too, and no more will come."""
        movers = {int(k) + 1 for k in np.flatnonzero(self.scenario.moving)}
        if movers & self.awaited or (movers and movers <= self.lost):
            return False
        back = [agent - 1 for agent in (self._torn_ways - self.lost) & movers]
        away = self._last[:, back] - self.scenario.target[:, back]
        return bool((np.sqrt((away * away).sum(axis=0)) <= self.run.swarm.r_min).all())

    def compare_tables(self, slot: int, digests: NDArray[np.uint32], chosen: NDArray[np.uint16]) -> None:
        """Takes in what all agents believe at the start of a slot, where that may differ.

        :param slot: its number.
        :param digests: (N,) digests of their tables, equal where tables are equal.
        :param chosen: (N,) ids that they take for the slot's sender.
        """
        if self.lost:
            here = [agent not in self.lost for agent in range(1, len(digests) + 1)]
            digests, chosen = digests[here], chosen[here]
        if len(digests):
            self._compared += 1
            self._torn += bool((chosen != chosen[0]).any())
            if (digests != digests[0]).any():
                self._split += 1
                if self.split_slot < 0:
                    self.split_slot = slot

    @property
    def agreed(self) -> tuple[int, int]:
        """Slots in which decisions were compared so far, and those in which all took the same agent for the sender."""
        return self._compared, self._compared - self._torn

    def closest(self) -> tuple[float, tuple[int, int]]:
        """Smallest distance so far, m, and the ids of the two agents."""
        sums = self._sums.result()
        return math.sqrt(sums["min_distance2"]), sums["pair"]

    def efficiencies(self) -> dict[int, float]:
        """Distance from start to end over the path flown (1), by the id of each mover that has moved.

        With several goals it is the length of the straight lines from goal to goal, and known of complete flights only.
        """
        path, plan = self._sums.result()["path"], self.scenario.plan
        if plan is not None and len(plan.goals) > 1:
            if self.completion_slot < 0:
                return {}
            direct = plan.way
        else:
            direct = np.sqrt(((self._last - self.scenario.start) ** 2).sum(axis=0))
        movers = np.flatnonzero(self.scenario.moving)
        return {
            int(k) + 1: float(direct[k] / path[k])
            for k in movers
            if path[k] > 0.0 and int(k) + 1 not in self._torn_ways
        }

    def summary(self, wall_time_s: float | None = None) -> dict[str, Any]:
        """The results as plain values; what does not exist (no movers, not complete, ...) is None.

        :param wall_time_s: wall-clock time that the flight took, s.
        """
        swarm, sums = self.run.swarm, self._sums.result()
        flown = self.slots * swarm.slot_ns / 1e9
        pair = sums["pair"] if sums["pair"][0] else None
        news = sums["age_count"]
        efficiency = list(self.efficiencies().values())
        airtime = self.run.air.airtime
        on_air_s = sum(airtime.on_air_ns(length) * count for length, count in self._frames.items()) / 1e9
        return {
            "agents": swarm.agents,
            "moving": swarm.movers,
            "policy": swarm.policy,
            "estimator": swarm.estimator,
            "avoider": swarm.avoider,
            "slot_ms": swarm.slot_ms,
            "loss": self.run.air.loss,
            "seed": swarm.seed,
            "end": self.end or STOPPED,
            "completed": self.completion_slot >= 0,
            "timed_out": self.end == TIMED_OUT,
            "collided": self.crash_slot >= 0,
            "collided_pair": list(self.collided_pair) if self.collided_pair else None,
            "slots": {
                "total": self.slots,
                "success": self._outcomes[SUCCESS],
                "collision": self._outcomes[COLLISION],
                "idle": self._outcomes[IDLE],
            },
            "min_distance_m": math.sqrt(sums["min_distance2"]) if pair else None,
            "min_distance_pair": list(pair) if pair else None,
            "min_distance_time_s": sums["min_slot"] * swarm.slot_ns / 1e9 if pair else None,
            "efficiency_mean": sum(efficiency) / len(efficiency) if efficiency else None,
            "completion_time_s": self.completion_slot * swarm.slot_ns / 1e9 if self.completion_slot >= 0 else None,
            "flight_time_s": flown,
            "first_divergence_slot": self.split_slot if self.split_slot >= 0 else None,
            "equal_tables_share": 1.0 - self._split / self._compared if self._compared else 1.0,
            "agreement_share": 1.0 - self._torn / self._compared if self._compared else 1.0,
            "lost_agents": sorted(self.lost),
            "age_mean_slots": sums["age_sum"] / news if news else None,
            "age_max_slots": sums["age_max"] if news else None,
            "age_mean_ms": sums["age_sum"] / news * swarm.slot_ms if news else None,
            "age_max_ms": sums["age_max"] * swarm.slot_ms if news else None,
            **self._wakings.summary(sums, self.slots, swarm.slot_ms),
            "frames_per_s": self._frames.total() / flown if flown else None,
            "bytes_per_s": sum(length * count for length, count in self._frames.items()) / flown if flown else None,
            "channel_load": on_air_s / flown if flown else None,
            "estimate_error_mean_m": sums["error_sum"] / news if news else None,
            "estimate_error_max_m": sums["error_max"] if news else None,
            "wall_time_s": wall_time_s,
            "realtime_factor": flown / wall_time_s if wall_time_s else None,
        }
