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
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from dtsa_dev.network.fake_modems import FakeModems, FakeModemSettings
from dtsa_dev.network.hosts import CABLE, EmulatedHost, hosts
from dtsa_dev.network.switch import Links, Switch

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.keys import VARIABLE
from dtsa_bench.log.agent_bag import AgentBag, read
from dtsa_bench.log.merge.merge import Merge, is_verified
from dtsa_bench.log.merged_bag import write_merged
from dtsa_bench.log.verify.check import verify_bag
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
    swarm: SwarmConfig
    channel: dict[str, Any] = field(default_factory=dict)  # settings of the medium that do not follow from the swarm
    links: Links = field(default_factory=Links)  # over UDP: what links do beside the medium
    modems: FakeModemSettings | None = None  # None: over UDP
    seconds: float = 8.0  # from when all have begun
    drift_ppm: float = 50.0  # largest drift of a clock, either way
    spread_s: float = 0.5  # within which processes start, in any order
    seed: int = 1  # of order, drifts and offsets


class AgentFlight:
    """A trial under way. A medium says how a process starts, how time goes on, and how often an agent has sent."""

    def __init__(self, trial: Trial, directory: Path) -> None:
        self.trial, self.directory = trial, directory
        self.agents = list(range(1, trial.swarm.agents + 1))
        (directory / "swarm.yaml").write_text(yaml.safe_dump(trial.swarm.to_dict()), encoding="utf-8")
        self.key = secrets.token_hex(32)
        self.random = random.Random(trial.seed)
        self._processes: dict[int, subprocess.Popen[str]] = {}
        self._lives: dict[int, int] = {}

    def popen(self, agent: int, command: list[str], **more: Any) -> subprocess.Popen[str]:
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
        raise NotImplementedError

    def start(self, agent: int) -> None:
        life = self._lives[agent] = self._lives.get(agent, 0) + 1
        options = {
            "id": agent, "clock-offset-ns": self.random.randrange(10**12),
            "clock-drift-ppb": round(self.random.uniform(-1.0, 1.0) * self.trial.drift_ppm * 1000),
            "out": self.directory / f"cf{agent}-{life}", "swarm": self.directory / "swarm.yaml", **self.options(agent),
        }  # fmt: skip
        command = [sys.executable, "-m", "dtsa_bench", "agent", *(f"--{key}={value}" for key, value in options.items())]
        with (self.directory / f"cf{agent}-{life}.err").open("w") as errors:
            self._processes[agent] = self.popen(
                agent, command, stdout=subprocess.DEVNULL, stderr=errors,
                env={**os.environ, VARIABLE: self.key},
            )  # fmt: skip

    def kill_and_restart(self, agent: int, seconds: float) -> None:
        """An agent's process is killed, and started again after so long; it sends again."""
        self.signal(agent, signal.SIGKILL)
        self.carry(seconds)
        self.start(agent)
        self.wait_for_frames([agent])

    def signal(self, agent: int, number: int) -> None:
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
        for process in self._living():
            process.send_signal(signal.SIGTERM)
        self.run(lambda: not self._living(), _END_S)
        self._check(0, -signal.SIGKILL)

    def close(self) -> None:
        for process in self._living():
            process.kill()
            process.wait()

    def bags(self) -> list[AgentBag]:
        return [read(path) for path in sorted(self.directory.glob("cf*-*")) if path.is_dir()]

    def stderr(self, agent: int) -> str:
        path = self.directory / f"cf{agent}-{self._lives[agent]}.err"
        return " ".join(path.read_text(encoding="utf-8").split())

    def findings(self, from_ns: int, to_ns: int) -> dict[str, Any]:
        return {}

    def now_ns(self) -> int:
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
    def __init__(self, trial: Trial, joined: Sequence[EmulatedHost], directory: Path) -> None:
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
        return {"interface": CABLE, "group": "{}:{}".format(*GROUP), "flight-time-ns": fixed, "byte-time-ns": byte}

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
    with ExitStack() as stack:
        flight: AgentFlight
        if trial.modems is None:
            flight = UdpFlight(trial, stack.enter_context(hosts(trial.swarm.agents)), directory)
            stack.enter_context(_as_medium())
        else:
            channel = FakeModems.channel(trial.modems.count, seed=trial.seed, **trial.channel)
            flight = SerialFlight(trial, stack.enter_context(FakeModems(trial.modems, channel, directory)), directory)
        stack.callback(flight.close)
        flight.begin()
        yield flight


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


def fly(trial: Trial, directory: Path, disturb: Callable[[Any], None], **simulators: Any) -> dict[str, Any]:
    """Fly a trial, whose bags verify and become a bag that verifies (``WHOLE``).

    :param disturb: called when all have begun and a third of the time is over; carries the flight on as it likes.
    :returns: the merged flight, what the medium has seen, and the simulator's summary of such a flight.
    """
    with under_way(trial, directory) as flight:
        begun = flight.now_ns()
        flight.carry(trial.seconds / 3)
        disturb(flight)
        flight.carry(trial.seconds * 2 / 3)
        flown = flight.now_ns()
        flight.end()
        medium = flight.findings(begun, flown)
    merged = Merge(flight.bags())
    found = merged.summary()
    assert is_verified(found), (found["decisions_again"], found["turns"]["which"], found["frames_heard_not_as_sent"])
    assert found["flight"] is not None, "they never counted alike"
    write_merged(directory / WHOLE, merged.log, found)
    checked = verify_bag(directory / WHOLE)
    assert checked.ok, checked.difference
    channel = {"loss": trial.channel["loss"], **simulators}
    return {**found, "medium": medium, "simulated": simulated(trial.swarm, found["flight"]["flight_time_s"], **channel)}


def apart(agents: int) -> list[list[int]]:
    return [list(range(1, agents // 2 + 1)), list(range(agents // 2 + 1, agents + 1))]


def simulated(swarm: SwarmConfig, seconds: float, **channel: Any) -> dict[str, Any]:
    limits = RunLimits(timeout_s=max(1.0, seconds), tail_s=3600.0, stop_on_crash=False)
    config = SwarmConfig.from_dict({**swarm.to_dict(), "auth": False, "auth_session": 0})
    summary = simulate(RunConfig(config, ChannelConfig(**channel, **from_swarm(config)), limits)).summary()
    return dict(summary)


def flight_time(airtime: Airtime) -> tuple[int, int]:
    """How long a datagram is under way on an air, as `agent` asks for it: ns for any, ns more for each byte."""
    return airtime.on_air_ns(0) + airtime.ramp_up_ns, 8 * 1_000_000_000 // airtime.bitrate
