"""A flight of agents over simulated modems, a process each: started in any order, disturbed, merged and judged."""

from __future__ import annotations

import os
import random
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_agent.keys import VARIABLE
from dtsa_bench.recordings.merge.agent_bag import read
from dtsa_bench.recordings.merge.merge import Merge
from dtsa_bench.recordings.merge.merged_run import lay
from dtsa_bench.recordings.merge.merged_writer import write
from dtsa_dev.network.fake_modems import FakeModems, FakeModemSettings

from .trial import WHOLE, NotFlown, swarm_words

_START_S = 60.0  # until all have begun, on a busy machine
_END_S = 20.0
_WAIT_S = 0.05
_SPREAD_S = 2.0  # within which processes start, in any order


@dataclass(frozen=True, slots=True)
class SerialTrial:
    """What is flown.

    :param swarm: the settings that all agents share.
    :param modems: the modems.
    :param channel: the air between them: ``loss``, ``partition`` and others.
    :param seconds: s from when all have begun.
    :param seed: of order, clocks and losses.
    """

    swarm: SwarmConfig
    modems: FakeModemSettings
    channel: dict[str, Any] = field(default_factory=dict)
    seconds: float = 60.0
    seed: int = 1


class SerialFlight:
    """A trial under way: what a disturbance can get at.

    :param trial: what is flown.
    :param modems: its modems.
    :param directory: for bags; each process has one of its own below.
    """

    def __init__(self, trial: SerialTrial, modems: FakeModems, directory: Path) -> None:
        self.trial, self.modems, self._directory = trial, modems, directory
        self._random = random.Random(trial.seed)
        self._key = secrets.token_hex(32)
        self._processes: dict[int, subprocess.Popen[bytes]] = {}
        self._lives: dict[int, int] = {}

    def start(self, agent: int) -> None:
        """Starts the process of an agent, for the first time or again.

        :param agent: its id.
        """
        life = self._lives[agent] = self._lives.get(agent, 0) + 1
        words = {
            "air": "serial", "id": agent, "device": self.modems.devices[agent - 1], "modem": self.trial.modems.modem,
            "baud": self.trial.modems.line_baud, "clock-offset-ns": self._random.randrange(10**12),
            "clock-drift-ppb": self._random.randrange(-50_000, 50_000), "out": self._directory / f"cf{agent}-{life}",
        }  # fmt: skip
        command = [sys.executable, "-m", "dtsa_bench", "agent", *(f"--{name}={value}" for name, value in words.items())]
        with self._said_in(agent).open("wb") as errors:
            self._processes[agent] = subprocess.Popen(
                command + swarm_words(self.trial.swarm), stdout=subprocess.DEVNULL, stderr=errors,
                env={**os.environ, VARIABLE: self._key},
            )  # fmt: skip

    def begin(self) -> None:
        """Starts all in any order, and waits until each has sent a frame.

        :raises NotFlown: if one does not.
        """
        order = list(range(1, self.trial.swarm.agents + 1))
        self._random.shuffle(order)
        for agent in order:
            self.start(agent)
            time.sleep(self._random.uniform(0.0, 2.0) * _SPREAD_S / len(order))
        self.await_frames(order)

    def await_frames(self, agents: list[int]) -> None:
        """Time goes on until agents have sent, each a frame more than so far.

        :param agents: their ids.
        :raises NotFlown: if one does not.
        """
        before = {agent: self.modems.packets_of[agent] for agent in agents}
        end = time.monotonic() + _START_S + 10 * self.trial.swarm.agents * self.trial.swarm.slot_s
        while waits := [agent for agent in agents if self.modems.packets_of[agent] == before[agent]]:
            if time.monotonic() > end:
                raise NotFlown(f"cf{waits[0]} has not sent: {self.said(waits[0])}")
            self.carry(_WAIT_S)

    def carry(self, seconds: float) -> None:
        """Time goes on.

        :param seconds: s, how long.
        :raises NotFlown: if a process has ended by itself.
        """
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            for agent, process in self._processes.items():
                if process.poll() not in (None, -signal.SIGKILL):
                    raise NotFlown(f"cf{agent} has ended with {process.returncode}: {self.said(agent)}")
            time.sleep(min(left, _WAIT_S))

    def kill(self, agent: int) -> None:
        """Ends an agent's process at once.

        :param agent: its id.
        """
        self._processes[agent].kill()
        self._processes[agent].wait()

    def end(self) -> None:
        """Ends all in order.

        :raises NotFlown: if one does not end, or not with 0.
        """
        living = [process for process in self._processes.values() if process.poll() is None]
        for process in living:
            process.send_signal(signal.SIGTERM)
        end = time.monotonic() + _END_S
        while any(process.poll() is None for process in living) and time.monotonic() < end:
            time.sleep(_WAIT_S)
        for agent, process in self._processes.items():
            if process.poll() not in (0, -signal.SIGKILL):
                raise NotFlown(f"cf{agent} has ended with {process.returncode}: {self.said(agent)}")

    def close(self) -> None:
        """Whatever still runs is killed."""
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()

    def said(self, agent: int) -> str:
        """What an agent's last process has said in flight.

        :param agent: its id.
        """
        return " ".join(self._said_in(agent).read_text(encoding="utf-8").split())

    def _said_in(self, agent: int) -> Path:
        return self._directory / f"cf{agent}-{self._lives[agent]}.err"


@contextmanager
def under_way(trial: SerialTrial, directory: Path) -> Iterator[SerialFlight]:
    """A trial whose agents all have begun; at the end of the context none is left.

    :param trial: what is flown.
    :param directory: for bags.
    :raises NotFlown: if an agent does not begin.
    """
    channel = FakeModems.channel(trial.modems.count, seed=trial.seed, **trial.channel)
    with FakeModems(trial.modems, channel, directory) as modems:
        flight = SerialFlight(trial, modems, directory)
        try:
            flight.begin()
            yield flight
        finally:
            flight.close()


def fly(trial: SerialTrial, directory: Path, disturb: Callable[[SerialFlight], None] | None = None) -> dict[str, Any]:
    """Flies a trial and judges it; a flight in which all came to count alike is kept as a bag (``WHOLE``).

    :param trial: what is flown.
    :param directory: for bags.
    :param disturb: called when all have begun and half of the time is over; carries the flight on as it likes.
    :returns: the merged flight, what the modems have counted, and what agents have said in flight.
    :raises NotFlown: if an agent does not begin, fly or end as it must.
    """
    with under_way(trial, directory) as flight:
        flight.carry(trial.seconds / 2)
        before = dict(flight.modems.counts)
        if disturb is not None:
            disturb(flight)
        flight.carry(trial.seconds / 2)
        later = {name: count - before[name] for name, count in flight.modems.counts.items()}
        flight.end()
        counts = dict(flight.modems.counts)
        said = [text for agent in range(1, trial.swarm.agents + 1) if (text := flight.said(agent))]
    bags = [path for path in sorted(directory.glob("cf*-*")) if path.is_dir()]
    merged = Merge([read(path) for path in bags])
    found = merged.judge()
    if found["common_slot"] is not None:
        write(directory / WHOLE, lay(merged, found), found)
    return {**found, "modems": counts, "modems_in_second_half": later, "said": said}
