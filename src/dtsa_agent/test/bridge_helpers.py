"""Simulated Crazyflies in a process of their own, and bridges that fly them, for the tests of the bridge."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from waiting import wait_for

from dtsa_agent.crazyflie.bridge import Bridge
from dtsa_agent.crazyflie.commands import velocity_world
from dtsa_agent.crazyflie.settings import parse_swarm
from dtsa_agent.crazyflie.state import State
from dtsa_bench.crazyflies.simulated import send_fault
from dtsa_bench.crazyflies.simulated.process import free_base_port
from dtsa_bench.crazyflies.simulated.truth import read_truth


@dataclass
class FakeFleet:
    process: subprocess.Popen[str]
    base_port: int
    count: int
    truth: Path

    def uri(self, cf: int) -> str:
        return f"udp://127.0.0.1:{self.base_port + cf - 1}"

    def fault(self, name: str, cf: object = "all", **numbers: Any) -> float:
        """Let one fail; the fleet's time."""
        return float(send_fault(("127.0.0.1", self.base_port - 1), fault=name, cf=cf, **numbers)["t"])

    def events(self, cf: int | None = None, name: str | None = None) -> list[dict[str, Any]]:
        found = read_truth(self.truth)[2]
        return [e for e in found if (cf is None or e["cf"] == cf) and (name is None or e["event"] == name)]

    def flown(self, cf: int) -> list[str]:
        """What its supervisor went through, from when it was ready for its first flight."""
        states = [e["state"] for e in self.events(cf, "state")]
        return states[states.index("flying") - 1 :] if "flying" in states else states

    def state_event(self, cf: int, state: str) -> dict[str, Any]:
        """The first time that a supervisor entered a state."""
        return next(e for e in self.events(cf, "state") if e["state"] == state)


@contextlib.contextmanager
def fake_fleet(
    folder: Path, count: int, *options: str, environment: dict[str, str] | None = None,
    program: Sequence[str] = ("dtsa_bench", "fake-crazyflie"),
) -> Iterator[FakeFleet]:  # fmt: skip
    base = free_base_port(count)
    truth = folder / f"truth-{base}.jsonl"
    command = [sys.executable, "-m", *program, "--count", str(count), "--base-port", str(base)]
    command += ["--truth", str(truth), "--quiet", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    try:
        assert process.stdout is not None
        assert any("Ctrl-C" in line for line in process.stdout), "the simulated Crazyflies did not start"
        yield FakeFleet(process, base, count, truth)
        process.send_signal(signal.SIGINT)
        assert process.wait(10) == 0
    finally:
        end_process(process)


@contextlib.contextmanager
def bridge_process(
    domain: int, config: Path, *parameters: str, output: int | IO[str] = subprocess.PIPE
) -> Iterator[subprocess.Popen[str]]:
    """The bridge's node in a process of its own, in a ROS domain."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    command = [sys.executable, "-m", "dtsa_agent.crazyflie.node.bridge_node", "--ros-args"]
    command += [word for value in (f"config:={config}", *parameters) for word in ("-p", value)]
    environment = os.environ | {"ROS_DOMAIN_ID": str(domain)}
    process = subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        end_process(process)


def end_process(process: subprocess.Popen[str]) -> None:
    process.kill()
    process.wait()
    if process.stdout is not None:
        process.stdout.close()


@dataclass
class Flight:
    """A bridge, its log, and a pilot that streams velocity commands at 50 Hz."""

    bridge: Bridge
    lines: list[tuple[float, str, str]]
    velocity: dict[str, tuple[float, float, float] | None] = field(default_factory=dict)  # None: no commands
    stop: threading.Event = field(default_factory=threading.Event)

    def logged(self, pattern: str, after: float = 0.0) -> float:
        """Time (s, monotonic) of the first line that matches."""
        for when, _, line in self.lines:
            if when >= after and re.search(pattern, line):
                return when
        raise AssertionError(f"no line matches {pattern!r} in\n" + "\n".join(line for _, _, line in self.lines))

    def state(self, cf: int) -> State:
        return self.bridge.vehicles[f"cf{cf}"].state

    def pilot(self) -> None:
        while not self.stop.wait(0.02):
            for name, velocity in self.velocity.items():
                if velocity is not None:
                    self.bridge.vehicles[name].command(velocity_world(velocity, 0.0, time.monotonic()))

    def take_off(self) -> None:
        """Arm, climb to the middle of the room, and begin to stream zero velocity."""
        names = list(self.bridge.vehicles)
        ready = [n for n in names if self.bridge.vehicles[n].state == State.READY]
        self.bridge.order_each(ready, lambda v: v.arm(True))
        wait_for(lambda: all(self.bridge.vehicles[n].state == State.ARMED for n in ready))
        assert self.bridge.order_each(ready, lambda v: v.takeoff(0.95, 2.0)) == (True, "")
        time.sleep(2.3)
        self.velocity = dict.fromkeys(ready, (0.0, 0.0, 0.0))
        threading.Thread(target=self.pilot, daemon=True).start()


def settings(fleet: FakeFleet, station: dict[str, Any] | None = None, **common: Any) -> dict[str, Any]:
    """A swarm's YAML, as data, for simulated Crazyflies."""
    robots = {f"cf{k}": {"uri": fleet.uri(k)} for k in range(1, fleet.count + 1)}
    cache = str(fleet.truth.parent / "cache")
    common = {"connect_timeout_s": 3.0, "estimator_timeout_s": 5.0} | common
    return {"robots": robots, "all": common, "station": {"toc_cache": cache} | (station or {})}


@contextlib.contextmanager
def flight(data: dict[str, Any]) -> Iterator[Flight]:
    lines: list[tuple[float, str, str]] = []
    bridge = Bridge(parse_swarm(data), lambda level, line: lines.append((time.monotonic(), level, line)))
    result = Flight(bridge, lines)
    try:
        yield result
    finally:
        result.stop.set()
        bridge.close()
