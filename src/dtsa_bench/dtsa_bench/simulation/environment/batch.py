"""Many flights at once, on arrays: every agent of every flight says in each slot whether it sends."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dtsa_agent.core import ConfigError
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import COMPLETED, CRASHED

from .flight import ActedFlight, Memory, acted, seeded
from .observation import Encoder, size
from .reward import MeanAge, Reward, SlotResults

_MOST_SEED = 2**62  # those that follow it are seeds, too


@dataclass(frozen=True, slots=True)
class Ended:
    """A flight that is over."""

    flight: int  # its row in the arrays
    seed: int
    summary: dict[str, Any]  # the results, with the keys of summary.json
    observation: NDArray[np.float32]  # (N, F) the last one, after its last slot


class BatchEnv:
    """B flights of N agents each, slot by slot; arrays are made once and written again in each slot.

    :param run: what is flown; its policy does not count, its seed is that of the first flight.
    :param flights: number of flights B.
    :param reward: what a slot was worth, for each agent: (B, N) or (B, 1) of :class:`SlotResults`.
    :param slots: a flight that is not over after so many slots is truncated; None: at its ``timeout_s``.
    :param autoreset: a flight that is over is followed by one with the next seed; False: its row waits for
        :meth:`reset`, and what is said for it has no effect.
    :raises ConfigError: for a value that is not usable.
    """

    def __init__(
        self,
        run: RunConfig,
        flights: int = 1,
        *,
        reward: Reward | None = None,
        slots: int | None = None,
        autoreset: bool = True,
    ) -> None:
        for name, value in (("flights", flights), ("slots", slots)):
            if value is not None and (isinstance(value, bool) or not isinstance(value, int) or value < 1):
                raise ConfigError(name, value, "a whole number from 1 on")
        self.config = acted(run)
        self.flights, self.agents = flights, run.swarm.agents
        self.observation_size = size(self.agents)
        self.ended: list[Ended] = []  # flights that the last step has ended
        self._reward: Reward = MeanAge() if reward is None else reward
        self._limit, self._autoreset = slots, autoreset
        self._seeds: Iterator[int] = count(run.swarm.seed)
        self._memory = Memory(flights)
        self._encoder = Encoder(self.config.swarm, range(1, self.agents + 1), flights)
        self._ids = np.arange(1, self.agents + 1, dtype=np.uint16)
        self._others = ~np.eye(self.agents, dtype=np.bool_)
        self._rows: list[ActedFlight] = []
        shape = flights, self.agents
        self._slot, self._outcome = (np.zeros(flights, dtype=np.int64) for _ in range(2))
        self._moving, self._woken = np.zeros(shape, dtype=np.bool_), np.full(shape, -1, dtype=np.int64)
        self._end_position = np.zeros((flights, 3, self.agents))
        self.rewards = np.zeros(shape)  # (B, N)
        self.terminated, self.truncated = (np.zeros(flights, dtype=np.bool_) for _ in range(2))  # (B,)

    @property
    def observations(self) -> NDArray[np.float32]:
        """(B, N, F) what each agent has heard so far; the same array after each slot."""
        return self._encoder.observations

    def flight(self, row: int) -> ActedFlight:
        """A flight under way, to look at.

        :param row: its row in the arrays.
        """
        return self._rows[row]

    def reset(self, seed: int | Sequence[int] | None = None) -> NDArray[np.float32]:
        """Begins B new flights.

        :param seed: that of the first, the others have the numbers after it; or the B seeds; flights that follow have
            the numbers after the last. None: the numbers after those that have been flown.
        :returns: (B, N, F) the observations.
        :raises ConfigError: for seeds that are none.
        """
        if seed is not None:
            self._seeds = self._numbers(seed)
        self.ended = []
        last = self._rows or [None] * self.flights
        self._rows = [self._begin(row, last[row]) for row in range(self.flights)]
        self.terminated[:] = self.truncated[:] = False
        self.rewards[:] = 0.0
        return self._encoder.fill(self._slot, self._memory)

    def step(
        self, actions: ArrayLike
    ) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
        """Flies one slot of each flight.

        :param actions: (B, N), 1: the agent sends in this slot, 0: it is silent.
        :returns: observations (B, N, F), rewards (B, N), terminated (B,): crashed or complete, truncated (B,): not over
            within the limit. Where a flight is over the observation is the first one of the next.
        :raises ConfigError: for actions of another shape or other values, or a reward of another shape.
        """
        sends = self._sends(actions)
        self.ended = []
        memory, flew = self._memory, ~(self.terminated | self.truncated)
        if self._autoreset:
            flew[:] = True
        sends &= flew[:, None] & (memory.present > 0)
        memory.sends[...] = sends
        # An agent that is silent says nothing of whom it takes for the sender.
        memory.chosen[...] = np.where(sends, self._ids, 0)
        woken, begun = self._woken.copy(), self._slot.copy()
        over = self._fly(flew)
        results = self._results(begun, flew, sends, woken, over)
        worth = np.asarray(self._reward(results))
        if worth.shape not in (self.rewards.shape, (self.flights, 1)):
            raise ConfigError(
                "reward", f"an array of shape {worth.shape}", f"{self.rewards.shape} or {(self.flights, 1)}"
            )
        self.rewards[...] = np.where(flew[:, None], worth, 0.0)
        if over:
            self._end(over)
        return self._encoder.fill(self._slot, memory), self.rewards, self.terminated, self.truncated

    def _sends(self, actions: ArrayLike) -> NDArray[np.bool_]:
        if not self._rows:
            raise ConfigError("actions", "step()", "reset() first")
        given = np.asarray(actions)
        if given.shape != (self.flights, self.agents) or not (given.dtype == np.bool_ or given.dtype.kind in "iu"):
            got = f"{given.dtype} of shape {given.shape}"
            raise ConfigError("actions", got, f"whole numbers 0 and 1 of shape {(self.flights, self.agents)}")
        sends: NDArray[np.bool_] = given != 0
        if given.dtype != np.bool_ and (given != sends).any():
            raise ConfigError("actions", int(given[given != sends][0]), "0 or 1")
        return sends.copy() if given.dtype == np.bool_ else sends

    def _fly(self, flew: NDArray[np.bool_]) -> dict[int, str]:
        """Flies a slot of each flight that is not over; returns why those end that are over now."""
        over: dict[int, str] = {}
        self.terminated[flew] = self.truncated[flew] = False
        slot, outcome, woken, memory = self._slot, self._outcome, self._woken, self._memory
        torn = (memory.chosen != memory.chosen[:, :1]).any(axis=1).tolist()
        split = (memory.table_hash != memory.table_hash[:, :1]).any(axis=1).tolist()
        for row, flight in enumerate(self._rows):
            if not flew[row]:
                continue
            end = flight.step(torn[row], split[row])
            slot[row], outcome[row], woken[row] = flight.slot, flight.outcome, flight.metrics.woken
            if end or flight.slot == self._limit:
                over[row] = end
        return over

    def _results(
        self,
        begun: NDArray[np.int64],
        flew: NDArray[np.bool_],
        sends: NDArray[np.bool_],
        woken: NDArray[np.int64],
        over: dict[int, str],
    ) -> SlotResults:
        sent, woken = self._memory.sent_slot, woken[:, None, :]
        counts = ((woken >= 0) & self._moving[:, None, :]) & self._others
        ages = np.where(counts, begun[:, None, None] - np.where(sent >= woken, sent, woken - 1), -1)
        crashed, completed = (np.zeros(self.flights, dtype=np.bool_) for _ in range(2))
        for row, end in over.items():
            crashed[row], completed[row] = end == CRASHED, end == COMPLETED
        if not self.config.limits.stop_on_crash:
            for row, flight in enumerate(self._rows):
                crashed[row] = flew[row] and flight.metrics.crash_slot == flight.slot
        return SlotResults(begun, flew, sends, self._outcome, ages, crashed, completed, self._memory.position)

    def _end(self, over: dict[int, str]) -> None:
        last = self._encoder.fill(self._slot, self._memory)
        for row, end in over.items():
            flight = self._rows[row]
            self.terminated[row] = end in (CRASHED, COMPLETED)
            self.truncated[row] = not self.terminated[row]
            self.ended.append(Ended(row, flight.run.swarm.seed, flight.summary(), last[row].copy()))
            if self._autoreset:
                self._rows[row] = self._begin(row, flight)

    def _begin(self, row: int, last: ActedFlight | None) -> ActedFlight:
        flight = ActedFlight(seeded(self.config, next(self._seeds)), self._memory, row, last)
        self._slot[row] = self._outcome[row] = 0
        self._moving[row], self._woken[row] = flight.scenario.moving, flight.metrics.woken
        return flight

    def _numbers(self, seed: int | Sequence[int]) -> Iterator[int]:
        try:
            given = [operator.index(seed)] if not isinstance(seed, Sequence) else [operator.index(one) for one in seed]
        except TypeError:
            given = []
        count_fits = len(given) == (self.flights if isinstance(seed, Sequence) else 1)
        if not count_fits or min(given) < 0 or max(given) > _MOST_SEED:
            raise ConfigError("seed", seed, f"a whole number from 0 to 2^62, or {self.flights} of them")
        return iter(_seeds(given))


def _seeds(given: list[int]) -> Iterator[int]:
    yield from given
    yield from count(given[-1] + 1)
