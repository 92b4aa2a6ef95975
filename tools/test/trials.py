"""Flights of agents on a network, a process each: started in any order, disturbed, merged and judged.

Two media: hosts of their own over a switch that is the medium (UDP), and simulated modems (serial lines).
"""

from __future__ import annotations

import os
import random
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_dev.network.fake_modems import FakeModems, FakeModemSettings
from dtsa_dev.network.hosts import CABLE, Host, hosts
from dtsa_dev.network.switch import Links, Switch

from dtsa_agent.air.datagram import HEADER
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.keys import VARIABLE
from dtsa_bench.recordings.merge.agent_bag import AgentBag, read
from dtsa_bench.recordings.merge.merge import Merge
from dtsa_bench.recordings.merge.merged_run import lay
from dtsa_bench.recordings.merge.merged_writer import write
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.airtime import Airtime

GROUP = ("239.68.84.83", 7583)
WHOLE = "whole"  # the bag of the whole flight, in its directory
_CLOCKS_S = 10**6  # CLOCK_MONOTONIC of the hosts differ by up to this
_START_S = 120.0  # until all have begun, on a busy machine
_END_S = 30.0
_PRIORITY = 40  # of the switch: above that of the agents
_AFTER_S = 2.0  # of the flight, from when on overlaps count


class TrialError(DtsaError):
    """A trial did not go as it must; the message says what."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What is flown.

    :param channel: settings of the medium, without what follows from the swarm.
    :param links: over UDP: what links do beside the medium.
    :param modems: None: over UDP.
    :param seconds: s from when all have begun.
    :param drift_ppm: largest drift of a clock, either way.
    :param spread_s: s within which processes start, in any order.
    :param seed: of order, drifts and offsets.
    """

    swarm: SwarmConfig
    channel: dict[str, Any] = field(default_factory=dict)
    links: Links = field(default_factory=Links)
    modems: FakeModemSettings | None = None
    seconds: float = 8.0
    drift_ppm: float = 50.0
    spread_s: float = 0.5
    seed: int = 1


class AgentFlight:
    """A trial under way. A medium says how a process starts, how time goes on, and how often an agent has sent.

    :param directory: for bags; each process has one of its own below.
    """

    def __init__(self, trial: Trial, directory: Path) -> None:
        self.trial, self.directory = trial, directory
        self.agents = list(range(1, trial.swarm.agents + 1))
        self.key = secrets.token_hex(32)
        self.random = random.Random(trial.seed)
        self._processes: dict[int, subprocess.Popen[str]] = {}
        self._lives: dict[int, int] = {}

    def popen(self, agent: int, command: list[str], **more: Any) -> subprocess.Popen[str]:
        """Start a process of an agent."""
        return subprocess.Popen(command, text=True, **more)

    def options(self, agent: int) -> dict[str, object]:
        """Options of an agent that its medium decides."""
        raise NotImplementedError

    def run(self, until: Callable[[], bool], seconds: float) -> bool:
        """Let time go on for so long, or until something is so; whether it is."""
        end = time.monotonic() + seconds
        while not (done := until()) and time.monotonic() < end:
            time.sleep(0.02)
        return done

    def sent_count(self, agent: int) -> int:
        """Frames that an agent has sent so far."""
        raise NotImplementedError

    def start(self, agent: int) -> None:
        """Start the process of an agent, for the first time or again."""
        life = self._lives[agent] = self._lives.get(agent, 0) + 1
        options = {
            "id": agent, "clock-offset-ns": self.random.randrange(10**12),
            "clock-drift-ppb": round(self.random.uniform(-1.0, 1.0) * self.trial.drift_ppm * 1000),
            "out": self.directory / f"cf{agent}-{life}", **self.options(agent),
        }  # fmt: skip
        command = [sys.executable, "-m", "dtsa_bench", "agent", *(f"--{key}={value}" for key, value in options.items())]
        with (self.directory / f"cf{agent}-{life}.err").open("w") as errors:
            self._processes[agent] = self.popen(
                agent, command + swarm_options(self.trial.swarm), stdout=subprocess.DEVNULL, stderr=errors,
                env={**os.environ, VARIABLE: self.key},
            )  # fmt: skip

    def signal(self, agent: int, number: int) -> None:
        """Send a signal to an agent's process."""
        self._processes[agent].send_signal(number)
        if number == signal.SIGKILL:
            self._processes[agent].wait()

    def begin(self) -> None:
        """Start all in any order, and wait until each has sent a frame."""
        order = list(self.agents)
        self.random.shuffle(order)
        for agent in order:
            self.start(agent)
            self.carry(self.random.uniform(0.0, 2.0) * self.trial.spread_s / len(order))
        self.wait_for_frames(order, 0)

    def wait_for_frames(self, agents: Sequence[int], before: int | None = None) -> None:
        """Let time go on until agents have sent a frame more than before; default: than now."""
        counts = {agent: self.sent_count(agent) if before is None else before for agent in agents}

        def silent() -> list[int]:
            return [agent for agent in agents if self.sent_count(agent) <= counts[agent]]

        slots_s = 10 * self.trial.swarm.agents * self.trial.swarm.slot_s
        self.run(lambda: not silent() or bool(self._ended()), _START_S + slots_s)
        if left := silent():
            first = next((agent for agent in left if agent in self._ended()), left[0])
            raise TrialError(f"cf{first} has not sent: {self.stderr(first)}")

    def carry(self, seconds: float) -> None:
        """Let time go on for so long; no process may end by itself meanwhile."""
        self.run(lambda: bool(self._ended()), seconds)
        self._check(None, -signal.SIGKILL)

    def end(self) -> None:
        """End all in order."""
        for process in self._living():
            process.send_signal(signal.SIGTERM)
        self.run(lambda: not self._living(), _END_S)
        self._check(0, -signal.SIGKILL)

    def close(self) -> None:
        """Kill whatever still runs."""
        for process in self._living():
            process.kill()
            process.wait()

    def bags(self) -> list[AgentBag]:
        """All bags."""
        return [read(path) for path in sorted(self.directory.glob("cf*-*")) if path.is_dir()]

    def stderr(self, agent: int) -> str:
        """What an agent's last process has printed on its standard error."""
        path = self.directory / f"cf{agent}-{self._lives[agent]}.err"
        return " ".join(path.read_text(encoding="utf-8").split())

    def findings(self, from_ns: int, to_ns: int) -> dict[str, Any]:
        """What the medium has seen between two times."""
        return {}

    def now_ns(self) -> int:
        """Time of the medium."""
        return time.monotonic_ns()

    def _check(self, *codes: int | None) -> None:
        for agent, process in self._processes.items():
            if process.poll() not in codes:
                raise TrialError(f"cf{agent} has ended with {process.returncode}: {self.stderr(agent)[-300:]}")

    def _ended(self) -> list[int]:
        """Agents whose process has ended without being killed."""
        return [agent for agent, one in self._processes.items() if one.poll() not in (None, -signal.SIGKILL)]

    def _living(self) -> list[subprocess.Popen[str]]:
        return [process for process in self._processes.values() if process.poll() is None]


class UdpFlight(AgentFlight):
    """Agents on hosts of their own, joined by a switch."""

    def __init__(self, trial: Trial, joined: Sequence[Host], directory: Path) -> None:
        super().__init__(trial, directory)
        self.hosts = {host.number: host for host in joined}
        swarm = trial.swarm
        shared = {"agents": swarm.agents, "slot_ns": swarm.slot_ns, "seed": trial.seed, "link_delay_ns": 0}
        self.config = ChannelConfig(**{**shared, **trial.channel})
        self.switch = Switch(joined, GROUP, self.config, trial.links)

    def popen(self, agent: int, command: list[str], **more: Any) -> subprocess.Popen[str]:
        return self.hosts[agent].start(command, self.random.randrange(1, _CLOCKS_S), **more)

    def options(self, agent: int) -> dict[str, object]:
        fixed, byte = flight_time(self.config.airtime)
        group = f"{GROUP[0]}:{GROUP[1]}"
        return {"interface": CABLE, "group": group, "flight-time-ns": fixed, "byte-time-ns": byte}

    def run(self, until: Callable[[], bool], seconds: float) -> bool:
        return self.switch.run(until, seconds)

    def sent_count(self, agent: int) -> int:
        return sum(frame.agent == agent for frame in self.switch.log)

    def now_ns(self) -> int:
        return self.switch.now_ns

    def findings(self, from_ns: int, to_ns: int) -> dict[str, Any]:
        swarm = self.trial.swarm
        log = [frame for frame in self.switch.log if from_ns + _AFTER_S * 1e9 <= frame.start_ns < to_ns]
        # Agents that have arrived send at their main anchors only; one of them may be lost.
        reach_ns = 2 * (swarm.main_every + 1) * swarm.agents * swarm.slot_ns
        return {
            "slots": max(1, (to_ns - from_ns - round(_AFTER_S * 1e9)) // swarm.slot_ns),
            "overlap_slots": len({frame.start_ns // swarm.slot_ns for frame in log if frame.collided}),
            "heard_at_the_end": sorted({frame.agent for frame in log if frame.start_ns >= to_ns - reach_ns}),
        }


class SerialFlight(AgentFlight):
    """Agents with a simulated modem each."""

    def __init__(self, trial: Trial, modems: FakeModems, directory: Path) -> None:
        super().__init__(trial, directory)
        self.modems = modems

    def options(self, agent: int) -> dict[str, object]:
        settings = self.trial.modems
        assert settings is not None
        device = self.modems.devices[agent - 1]
        return {"air": "serial", "device": device, "modem": settings.modem, "baud": settings.line_baud}

    def sent_count(self, agent: int) -> int:
        return self.modems.packets_of[agent]

    def findings(self, from_ns: int, to_ns: int) -> dict[str, Any]:
        return dict(self.modems.counts)


@contextmanager
def under_way(trial: Trial, directory: Path) -> Iterator[Any]:
    """A trial whose agents all have begun; at the end of the context none is left.

    :raises Unavailable: if hosts cannot be made here.
    """
    if trial.modems is None:
        with hosts(trial.swarm.agents) as joined, _as_medium():
            yield from _begun(UdpFlight(trial, joined, directory))
    else:
        channel = FakeModems.channel(trial.modems.count, seed=trial.seed, **trial.channel)
        with FakeModems(trial.modems, channel, directory) as modems:
            yield from _begun(SerialFlight(trial, modems, directory))


def _begun(flight: AgentFlight) -> Iterator[AgentFlight]:
    try:
        flight.begin()
        yield flight
    finally:
        flight.close()


@contextmanager
def _as_medium() -> Iterator[None]:
    """The air waits for no process: the switch runs before all others where it may; what it starts does not."""
    before = os.sched_getscheduler(0)
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    try:
        yield
    finally:
        with suppress(OSError):
            os.sched_setscheduler(0, before, os.sched_param(0))


def fly(trial: Trial, directory: Path, disturb: Callable[[Any], None] | None = None) -> dict[str, Any]:
    """Fly a trial and judge it; a flight in which all came to count alike is kept as a bag (``WHOLE``).

    :param disturb: called when all have begun and a third of the time is over; carries the flight on as it likes.
    :returns: the merged flight, and what the medium has seen.
    """
    with under_way(trial, directory) as flight:
        begun = flight.now_ns()
        flight.carry(trial.seconds / 3)
        if disturb is not None:
            disturb(flight)
        flight.carry(trial.seconds * 2 / 3)
        flown = flight.now_ns()
        flight.end()
        medium = flight.findings(begun, flown)
        airtime = flight.config.airtime if trial.modems is None else None
    merged = Merge(flight.bags())
    found = merged.judge(*([] if airtime is None else [airtime.on_air_ns(HEADER + trial.swarm.frame_length)]))
    if found["common_slot"] is not None:
        write(directory / WHOLE, lay(merged, found), found)
    return {**found, "medium": medium}


def simulated(swarm: SwarmConfig, seconds: float, **channel: Any) -> dict[str, Any]:
    """The summary of the same flight in the simulator."""
    limits = RunLimits(timeout_s=max(1.0, seconds), tail_s=3600.0, stop_on_crash=False)
    config = SwarmConfig.from_dict({**swarm.to_dict(), "auth": False, "auth_session": 0})
    summary = simulate(RunConfig(config, ChannelConfig(**channel, **from_swarm(config)), limits)).summary()
    return dict(summary)


def flight_time(airtime: Airtime) -> tuple[int, int]:
    """How long a datagram is under way on an air, as `agent` asks for it: ns for any, ns more for each byte."""
    return airtime.on_air_ns(0) + airtime.ramp_up_ns, 8 * 1_000_000_000 // airtime.bitrate


def swarm_options(swarm: SwarmConfig) -> list[str]:
    """Options of `agent` for a swarm's settings, as far as they differ from their defaults."""
    plain, words = SwarmConfig(agents=swarm.agents).to_dict(), [f"--agents={swarm.agents}", f"--policy={swarm.policy}"]
    for name, value in swarm.to_dict().items():
        option = name.replace("_", "-")
        if name in ("agents", "policy", "auth") or value == plain[name]:
            continue
        if isinstance(value, dict):
            value = ",".join(f"{key}={number}" for key, number in value.items())
        words.append(f"--{option}={value}" if not isinstance(value, bool) else f"--{'' if value else 'no-'}{option}")
    return [*words, "--seal" if swarm.auth else "--no-seal"]
