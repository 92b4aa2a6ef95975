"""A flight of agents on hosts of their own, over the switch: started in any order, disturbed, merged and judged."""

from __future__ import annotations

import os
import random
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_agent.air.datagram import HEADER
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.keys import VARIABLE
from dtsa_bench.recordings.merge.agent_bag import AgentBag, read
from dtsa_bench.recordings.merge.merge import Merge
from dtsa_bench.recordings.merge.merged_run import lay
from dtsa_bench.recordings.merge.merged_writer import write
from dtsa_channel_sim import ChannelConfig
from dtsa_channel_sim.model.airtime import Airtime

from .hosts import CABLE, Host, hosts
from .switch import Links, Switch

GROUP = ("239.68.84.83", 7583)
#: The bag of the whole flight, in its directory.
WHOLE = "whole"
_CLOCKS_S = 10**6  # CLOCK_MONOTONIC of the hosts differ by up to this
_START_S = 120.0  # until all have begun, on a busy machine
_END_S = 30.0
_PRIORITY = 40  # of the switch: above that of the agents
_AFTER_S = 2.0  # of the flight, from when on overlaps count


class NotFlown(DtsaError):
    """A trial did not go as it must; the message says what."""


@dataclass(frozen=True, slots=True)
class Trial:
    """What is flown.

    :param swarm: the settings that all agents share.
    :param channel: the medium, without what follows from the swarm.
    :param links: what links do beside it.
    :param seconds: s from when all have begun.
    :param drift_ppm: ppm, largest drift of a clock, either way.
    :param spread_s: s within which processes start, in any order.
    :param seed: of order, drifts and offsets.
    """

    swarm: SwarmConfig
    channel: dict[str, Any] = field(default_factory=dict)
    links: Links = field(default_factory=Links)
    seconds: float = 8.0
    drift_ppm: float = 50.0
    spread_s: float = 0.5
    seed: int = 1


class Flight:
    """A trial under way: what a disturbance can get at.

    :param trial: what is flown.
    :param joined: the hosts.
    :param directory: for bags; each process has one of its own below.
    """

    def __init__(self, trial: Trial, joined: Sequence[Host], directory: Path) -> None:
        self.trial, self.directory = trial, directory
        self.joined = {host.number: host for host in joined}
        swarm = trial.swarm
        shared = {"agents": swarm.agents, "slot_ns": swarm.slot_ns, "seed": trial.seed, "link_delay_ns": 0}
        self.config = ChannelConfig(**{**shared, **trial.channel})
        self.switch = Switch(joined, GROUP, self.config, trial.links)
        self._random = random.Random(trial.seed)
        self._processes: dict[int, subprocess.Popen[str]] = {}
        self._lives: dict[int, int] = {}
        self.key = secrets.token_hex(32)

    def start(self, agent: int) -> None:
        """Starts the process of an agent, for the first time or again.

        :param agent: its id.
        """
        life = self._lives[agent] = self._lives.get(agent, 0) + 1
        out = self.directory / f"cf{agent}-{life}"
        drift = round(self._random.uniform(-1.0, 1.0) * self.trial.drift_ppm * 1000)
        offset = self._random.randrange(10**12)
        fixed, byte = flight_time(self.config.airtime)
        words = {
            "id": agent, "interface": CABLE, "group": f"{GROUP[0]}:{GROUP[1]}", "flight-time-ns": fixed,
            "byte-time-ns": byte, "clock-drift-ppb": drift, "clock-offset-ns": offset, "out": out,
        }  # fmt: skip
        command = [sys.executable, "-m", "dtsa_bench", "agent"]
        command += [f"--{name}={value}" for name, value in words.items()] + swarm_words(self.trial.swarm)
        with (self.directory / f"cf{agent}-{life}.err").open("w") as errors:
            self._processes[agent] = self.joined[agent].start(
                command, self._random.randrange(1, _CLOCKS_S), stdout=subprocess.DEVNULL, stderr=errors,
                env={**os.environ, VARIABLE: self.key},
            )  # fmt: skip

    def signal(self, agent: int, number: int) -> None:
        """Sends a signal to an agent's process.

        :param agent: its id.
        :param number: the signal.
        """
        self._processes[agent].send_signal(number)
        if number == signal.SIGKILL:
            self._processes[agent].wait()

    def carry(self, seconds: float) -> None:
        """Time goes on.

        :param seconds: s, how long.
        :raises NotFlown: if a process has ended by itself.
        """
        self.switch.run(self._broken, seconds)
        for agent, process in self._processes.items():
            if process.poll() not in (None, -signal.SIGKILL):
                raise NotFlown(f"cf{agent} has ended with {process.returncode}: {self._said(agent)}")

    def begin(self) -> None:
        """Starts all in any order, and waits until each has sent a frame.

        :raises NotFlown: if one does not.
        """
        order = list(self.joined)
        self._random.shuffle(order)
        for agent in order:
            self.start(agent)
            self.carry(self._random.uniform(0.0, 2.0) * self.trial.spread_s / len(order))
        silent = set(order)

        def all_heard() -> bool:
            silent.difference_update(one.agent for one in self.switch.log)
            return not silent or self._broken()

        self.switch.run(all_heard, _START_S)
        if silent:
            ended = [agent for agent in sorted(silent) if self._processes[agent].poll() is not None]
            first = (ended or sorted(silent))[0]
            raise NotFlown(f"cf{first} has not sent: {self._said(first)}")

    def carry_until_heard(self, agent: int) -> None:
        """Time goes on until an agent has sent a frame.

        :param agent: its id.
        :raises NotFlown: if it does not.
        """
        seen = len(self.switch.log)
        self.switch.run(lambda: any(one.agent == agent for one in self.switch.log[seen:]) or self._broken(), _START_S)
        if all(one.agent != agent for one in self.switch.log[seen:]):
            raise NotFlown(f"cf{agent} has not sent: {self._said(agent)}")

    def end(self) -> None:
        """Ends all in order.

        :raises NotFlown: if one does not end, or not with 0.
        """
        for process in self._living():
            process.send_signal(signal.SIGTERM)
        self.switch.run(lambda: not self._living(), _END_S)
        for agent, process in self._processes.items():
            if process.poll() not in (0, -signal.SIGKILL):
                raise NotFlown(f"cf{agent} has ended with {process.returncode}: {self._said(agent)}")

    def close(self) -> None:
        """Whatever still runs is killed."""
        for process in self._living():
            process.kill()
            process.wait()

    def bags(self) -> list[AgentBag]:
        """All bags."""
        return [read(path) for path in sorted(self.directory.glob("cf*-*")) if path.is_dir()]

    def _broken(self) -> bool:
        """Whether a process has ended that nobody has killed."""
        return any(process.poll() not in (None, -signal.SIGKILL) for process in self._processes.values())

    def _living(self) -> list[subprocess.Popen[str]]:
        return [process for process in self._processes.values() if process.poll() is None]

    def _said(self, agent: int) -> str:
        path = self.directory / f"cf{agent}-{self._lives[agent]}.err"
        return " ".join(path.read_text(encoding="utf-8").split())[-300:]


@contextmanager
def under_way(trial: Trial, directory: Path) -> Iterator[Flight]:
    """A trial whose agents all have begun; at the end of the context none is left.

    :param trial: what is flown.
    :param directory: for bags.
    :raises Unavailable: if hosts cannot be made here.
    :raises NotFlown: if an agent does not begin.
    """
    with hosts(trial.swarm.agents) as joined:
        flight = Flight(trial, joined, directory)
        try:
            with _as_medium():
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


def fly(trial: Trial, directory: Path, disturb: Callable[[Flight], None] | None = None) -> dict[str, Any]:
    """Flies a trial and judges it; a flight in which all came to count alike is kept as a bag (``WHOLE``).

    :param trial: what is flown.
    :param directory: for bags.
    :param disturb: called when all have begun and a third of the time is over; carries the flight on as it likes.
    :returns: the merged flight, and what the switch has seen.
    :raises NotFlown: if an agent does not begin, fly or end as it must.
    """
    with under_way(trial, directory) as flight:
        begun = flight.switch.now_ns
        flight.carry(trial.seconds / 3)
        if disturb is not None:
            disturb(flight)
        flight.carry(trial.seconds * 2 / 3)
        flown = flight.switch.now_ns
        flight.end()
    merged = Merge(flight.bags())
    found = merged.judge(flight.config.airtime.on_air_ns(HEADER + trial.swarm.frame_length))
    if found["common_slot"] is not None:
        write(directory / WHOLE, lay(merged, found), found)
    return {**found, "switch": seen(flight, begun + round(_AFTER_S * 1e9), flown)}


def seen(flight: Flight, from_ns: int, to_ns: int) -> dict[str, Any]:
    """What the switch has seen of a flight.

    :param flight: the flight.
    :param from_ns: ns, from when on overlaps count.
    :param to_ns: ns, until when.
    """
    slot_ns = flight.trial.swarm.slot_ns
    log = [one for one in flight.switch.log if from_ns <= one.start_ns < to_ns]
    # Who has arrived speaks at its main anchors only; one of them may be lost.
    reach_ns = 2 * (flight.trial.swarm.main_every + 1) * flight.trial.swarm.agents * slot_ns
    slots = max(1, (to_ns - from_ns) // slot_ns)
    torn = {one.start_ns // slot_ns for one in log if one.collided}
    return {
        "slots": slots,
        "frames": len(log),
        "overlap_slots": len(torn),
        "overlap_share": len(torn) / slots,
        "frames_lost": sum(bool(one.lost) for one in log),
        "heard_at_the_end": sorted({one.agent for one in log if one.start_ns >= to_ns - reach_ns}),
        "undelivered": flight.switch.undelivered,
    }


def flight_time(airtime: Airtime) -> tuple[int, int]:
    """How long a datagram is under way on an air, as `agent` asks for it: ns for any, ns more for each byte.

    :param airtime: times of the radio.
    """
    byte = 8 * 1_000_000_000 // airtime.bitrate
    return airtime.on_air_ns(0) + airtime.ramp_up_ns, byte


def swarm_words(swarm: SwarmConfig) -> list[str]:
    """Options of `agent` for a swarm's settings, as far as they differ from their defaults.

    :param swarm: the settings.
    """
    plain, words = SwarmConfig(agents=swarm.agents).to_dict(), [f"--agents={swarm.agents}", f"--policy={swarm.policy}"]
    for name, value in swarm.to_dict().items():
        option = name.replace("_", "-")
        if name in ("agents", "policy", "auth") or value == plain[name]:
            continue
        if isinstance(value, dict):
            value = ",".join(f"{key}={number}" for key, number in value.items())
        words.append(f"--{option}={value}" if not isinstance(value, bool) else f"--{'' if value else 'no-'}{option}")
    return [*words, "--seal" if swarm.auth else "--no-seal"]
