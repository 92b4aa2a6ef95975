"""The flights of the demo: which, how they are flown, what is read from their bags, and their figures."""

from __future__ import annotations

import io
import os
import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Scenario, SwarmConfig
from dtsa_agent.stop import Stop
from dtsa_bench.flights.children import Children
from dtsa_bench.flights.flight import Flight, fly
from dtsa_bench.flights.options import FlightOptions
from dtsa_bench.flights.progress import ProgressLine
from dtsa_bench.log.flight_log import FlightLog
from dtsa_bench.log.merged_bag import open_log
from dtsa_bench.runs.config import REALTIME, RunConfig, RunLimits, from_swarm
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.ros.observer import ChannelObserver

AGENTS, LOSS = 12, 0.1
LIVE_AGENTS, LIVE_SLOT_MS = 4, 6.0  # few processes and short slots: what is shown takes 1040 slots
KILLED = 3  # id of the agent that is killed
KILL_AFTER_S = 1.0  # s after slot 0
SHOWN_S = 1.5  # s for which the flight goes on when the agent takes part again
GIVE_UP_S = 40.0  # s after slot 0: the flight ends even if the agent has not come back
RESPAWN_S = 6.0  # after that its turns are used by others, for as long as its process needs to start
AT_ONCE = 2  # starting a flight is mostly waiting; more at once only wait for each other
HEAD = ["", "flying", "frames lost", "known state is", "position wrong by", "all agree on the sender", "closest"]


@dataclass(frozen=True, slots=True)
class DemoFlight:
    """A flight of the demo, before it is flown."""

    key: str  # name of its directory
    name: str  # as readers know the scheme
    does: str
    run: RunConfig

    @property
    def live(self) -> bool:
        """Whether it is flown in real time, with a process for each agent."""
        return self.run.mode == REALTIME


@dataclass(frozen=True, slots=True)
class FinishedFlight:
    """A flight of the demo, and what is shown of it."""

    flight: DemoFlight
    summary: Mapping[str, Any]  # as in summary.json
    scenario: Scenario
    senders: tuple[tuple[int, ...], ...]  # ids of the agents that sent, a slot
    position: NDArray[np.float64]  # (M, 3, N) m, frame map, at the start of each slot
    error_m: NDArray[np.float64]  # (M,) mean distance of the agents' estimates of each other from the truth

    @property
    def error(self) -> str:
        """Mean error of what agents think of each other's position."""
        millimetres = 1000.0 * float(self.summary["estimate_error_mean_m"])
        return f"{millimetres:.0f} mm" if millimetres >= 9.95 else f"{millimetres:.1f} mm"

    @property
    def age(self) -> str:
        """Mean age of what agents know of those that fly."""
        return f"{self.summary['age_mean_slots']:.1f} slots"

    @property
    def agreement(self) -> str:
        """Share of slots in which all agents take the same one for the sender."""
        return f"{100 * self.summary['agreement_share']:.0f} %"


Flights = Mapping[str, FinishedFlight]  # by key


def demo_steps(seed: int) -> tuple[tuple[DemoFlight, ...], ...]:
    """The flights of the four steps."""

    def lockstep(
        key: str, name: str, does: str, policy: str, moving: int, estimator: str = "linear", loss: float = 0
    ) -> DemoFlight:
        swarm = SwarmConfig(agents=AGENTS, moving=moving, policy=policy, estimator=estimator, seed=seed)
        return DemoFlight(key, name, does, RunConfig(swarm, ChannelConfig(loss=loss, **from_swarm(swarm))))

    live = SwarmConfig(
        agents=LIVE_AGENTS, policy="lease", slot_ms=LIVE_SLOT_MS, seed=seed,
        scenario="waypoints", stops=100, pause_slots=0, axis_x_m=6.0,
    )  # fmt: skip
    limits = RunLimits(timeout_s=60.0, stop_on_crash=False)
    return (
        (
            lockstep("all-tdma-hold", "TDMA, as published", "others stand where last heard", "tdma", 12, "hold"),
            lockstep("all-tdma", "TDMA, extrapolated", "others fly on as last heard", "tdma", 12),
        ),
        (
            lockstep("two-tdma", "TDMA", "everybody in turn", "tdma", 2),
            lockstep("two-dtsa", "DTSA", "whose state is most urgent", "dtsa", 2),
            lockstep("two-lease", "lease", "hovering agents lease their turns", "lease", 2),
        ),
        (
            lockstep("loss-tdma", "TDMA", "everybody in turn", "tdma", 4, loss=LOSS),
            lockstep("loss-dtsa", "DTSA", "all must choose alike", "dtsa", 4, loss=LOSS),
            lockstep("loss-lease", "lease", "each owner decides alone", "lease", 4, loss=LOSS),
        ),
        (DemoFlight("killed-lease", "lease", "", RunConfig(live, limits=limits, mode=REALTIME)),),
    )


def table_rows(steps: Sequence[Sequence[DemoFlight]], flights: Flights) -> list[list[str]]:
    """A row a flight that is the same on every machine, below `HEAD`."""
    rows = []
    for number, step in enumerate(steps, 1):
        for finished in (flights[flight.key] for flight in step if not flight.live):
            summary = finished.summary
            rows.append([
                f"{number} {finished.flight.name}", f"{summary['moving']} of {summary['agents']}",
                f"{100 * summary['loss']:.0f} %", f"{finished.age} old", finished.error, finished.agreement,
                f"{summary['min_distance_m']:.2f} m",
            ])  # fmt: skip
    return rows


class KillAgent(ChannelObserver):
    """Kills the process of one agent (SIGKILL) while the flight is under way, and waits until it is back."""

    def __init__(self, agent: int) -> None:
        self._agent = agent
        self._children: Children | None = None
        self._begin_s = self._killed_s = self._back_s = 0.0

    def started(self, children: Children) -> None:
        """The flight's processes are started."""
        self._children = children

    def start_known(self, at_s: float) -> None:
        self._begin_s = at_s

    def idle(self, slot: int, awaited: list[int]) -> None:
        if self._killed_s or not self._begin_s or time.monotonic() < self._begin_s + KILL_AFTER_S:
            return
        assert self._children is not None
        for child in self._children.all:
            if list(child.agents) == [self._agent]:
                os.kill(child.process.pid, signal.SIGKILL)
        self._killed_s = time.monotonic()

    def agents_back(self, agents: list[int]) -> None:
        if self._agent in agents:
            self._back_s = time.monotonic()

    @property
    def is_over(self) -> bool:
        """Whether everything has happened, or will not happen any more."""
        now = time.monotonic()
        late = bool(self._begin_s) and now > self._begin_s + GIVE_UP_S
        return late or (bool(self._back_s) and now > self._back_s + SHOWN_S)


class StopOr(Stop):
    """A stop flag that is also up once a condition holds."""

    def __init__(self, stop: Stop, holds: Callable[[], bool]) -> None:
        super().__init__()
        self._stop, self._holds = stop, holds

    def __bool__(self) -> bool:
        return bool(self._stop) or self._holds()


def fly_all(steps: Sequence[Sequence[DemoFlight]], directory: Path, stop: Stop) -> dict[str, FinishedFlight]:
    """Fly all flights of the demo, each into a directory of its own; not all if `stop` came.

    :raises DtsaError: when a node dies, hangs or sends garbage.
    """
    demo = [flight for step in steps for flight in step]
    lockstep = [flight for flight in demo if not flight.live]
    line, failed = ProgressLine("flights in lockstep"), threading.Event()
    over = StopOr(stop, failed.is_set)

    def fly_demo_flight(flight: DemoFlight) -> Flight | None:
        quiet = ProgressLine(flight.key, io.StringIO())  # several flights at once have one line for all
        try:
            options = FlightOptions(processes=1, pictures=False)
            return None if over else fly(flight.run, directory / flight.key, options, over, progress=quiet)
        except BaseException:
            failed.set()
            raise

    finished: dict[str, FinishedFlight] = {}
    try:
        with ThreadPoolExecutor(AT_ONCE) as pool:
            flown = zip(lockstep, pool.map(fly_demo_flight, lockstep), strict=True)
            for number, (flight, result) in enumerate(flown, 1):
                line.show(f"{number} of {len(lockstep)} flown")
                if result is not None:
                    finished[flight.key] = read_flight(flight, result)
    finally:
        line.end()
    for flight in demo:
        if flight.live and not stop:
            finished[flight.key] = _fly_live(flight, directory / flight.key, stop)
    return finished


def _fly_live(flight: DemoFlight, out: Path, stop: Stop) -> FinishedFlight:
    kill = KillAgent(KILLED)
    options, over = FlightOptions(respawn=RESPAWN_S, pictures=False), StopOr(stop, lambda: kill.is_over)
    result = fly(flight.run, out, options, over, "flight in real time", kill.started, observers=[kill])
    return read_flight(flight, result)


def read_flight(flight: DemoFlight, result: Flight) -> FinishedFlight:
    """What is shown of a flight, from its bag."""
    log = open_log(result.bag)
    error = np.zeros(0)
    ages = None if flight.live else log.knowledge.ages
    if ages is not None:
        known = np.isfinite(ages.error)
        total = np.where(known, ages.error, 0.0).sum(axis=1)
        error = np.where(known.any(axis=1), total / np.maximum(1, known.sum(axis=1)), np.nan)
    return FinishedFlight(flight, result.summary, result.scenario, senders_of(log), result.positions, error)


def senders_of(log: FlightLog) -> tuple[tuple[int, ...], ...]:
    """Ids of the agents that sent in each slot."""
    return tuple(tuple((np.flatnonzero(row) + 1).tolist()) for row in log.sent)
