"""What agents over UDP cost, beside the same agents as ROS nodes; how punctual they are, beside a bare timer."""

from __future__ import annotations

import json
import os
import random
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.air.udp import MulticastSocket, UdpSettings
from dtsa_agent.air.udp.datagram import Wrapping
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.authentication import Authenticator
from dtsa_agent.keys import VARIABLE
from dtsa_bench.air.trial import swarm_words
from dtsa_bench.soak.checks import met
from dtsa_bench.soak.flights import PATIENCE_S, command, flying, until
from dtsa_bench.soak.item import Item, NotMet

_WINDOW_S = 10.0
_START_S = 3.0  # for each agent
_NEW_ROUNDS = 30  # of N slots: who is new speaks at its anchors only
_SETTLED_S = 5.0  # after the last one has begun
_ON_TIME_NS = 1_000_000
_PUNCTUAL = 0.02  # share of frames on time may be smaller than the timer's by this
_SHARE = 0.5  # of the other form's cost
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def items() -> Iterator[Item]:
    """Twelve and seventy agents."""
    for agents, slot_ms, seconds in ((12, 10.0, 60.0), (70, 20.0, 300.0)):
        settings = {"agents": agents, "slot_ms": slot_ms, "cost": True}
        yield Item(f"{agents} agents, {slot_ms:g} ms: cost and punctuality", settings, 1, seconds)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Flies both forms, one after the other.

    :param item: one of this module's.
    :param directory: an empty one.
    :raises NotMet: if agents over UDP are less punctual than a timer, or cost more than half of the other form.
    """
    swarm = SwarmConfig(
        agents=item.settings["agents"], slot_ms=item.settings["slot_ms"], policy="lease", auth=True, auth_session=1
    )
    udp = over_udp(swarm, directory)
    frames, timer = udp["frames_on_time_share"], udp["timer_on_time_share"]
    met(frames >= timer - _PUNCTUAL, f"{frames:.1%} of frames on time, {timer:.1%} of a bare timer's wake-ups; {udp}")
    try:
        ros = over_ros(swarm, directory / "ros")
    except NotMet as error:
        return {"udp": udp, "ros": f"did not fly: {error}"}
    for name in ("processor_us_per_slot", "memory_pss_mb"):
        met(
            udp[name] <= _SHARE * ros[name],
            f"{name}: {udp[name]:.4g}, as ROS nodes {ros[name]:.4g}; udp {udp}, ros {ros}",
        )
    return {"udp": udp, "ros": ros}


def over_udp(swarm: SwarmConfig, directory: Path) -> dict[str, Any]:
    """Agents on the loopback interface, without bags: what they cost, how late their frames leave.

    :param swarm: the settings that all share.
    :param directory: for what they say.
    :raises NotMet: if one does not begin.
    """
    draw = random.Random(os.getpid())
    group = f"239.255.{draw.randrange(256)}.{draw.randrange(1, 255)}:{draw.randrange(20_000, 30_000)}"
    key = secrets.token_hex(32)
    with (
        MulticastSocket(UdpSettings(interface="lo", group=group)) as ears,
        _agents(swarm, group, key, directory) as all_of,
    ):
        heard: set[int] = set()
        wrapping = Wrapping(swarm, Authenticator.from_hex(key, swarm.auth_session))

        def late() -> list[int]:
            found = []
            for datagram in ears.receive(256):
                said = wrapping.read(datagram.data)
                if not said.fault:
                    heard.add(said.sender)
                    found.append(said.late_ns)
            return found

        def all_speak() -> bool:
            late()
            ended = [process for process in all_of if process.poll() is not None]
            if ended:
                raise NotMet(f"an agent has ended: {(directory / 'said.txt').read_text()[-300:]}")
            return len(heard) == swarm.agents

        until(all_speak, "all agents speak", PATIENCE_S + _START_S * swarm.agents)
        _listen(late, max(_SETTLED_S, _NEW_ROUNDS * swarm.agents * swarm.slot_s))
        words = [sys.executable, "-m", "dtsa_bench.soak.air.bare_timer", str(swarm.slot_ns), str(_WINDOW_S)]
        heard.clear()
        timer = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
        pids = [process.pid for process in all_of]
        before, begin = _processor_s(pids), time.monotonic()
        lates = _listen(late, _WINDOW_S)
        used, took = _processor_s(pids) - before, time.monotonic() - begin
        memory = _pss_mb(pids)
        bare = json.loads(timer.communicate(timeout=PATIENCE_S)[0])
        missing = swarm.agents - len(heard)
    met(not missing, f"{missing} agents were not heard within {_WINDOW_S:g} s")
    return {
        "frames": len(lates),
        "slots": round(took * 1e9 / swarm.slot_ns),
        **_punctual("frames", lates),
        **_punctual("timer", bare),
        "processor_us_per_slot": used / (took * 1e9 / swarm.slot_ns) / swarm.agents * 1e6,
        "processors": used / took,
        "memory_pss_mb": memory,
    }


def over_ros(swarm: SwarmConfig, directory: Path) -> dict[str, Any]:
    """The same agents as ROS nodes in real time, a process each: what these cost, without channel and recorder.

    :param swarm: the settings that all share.
    :param directory: for the flight.
    :raises NotMet: if the flight does not begin.
    """
    words = [
        "--mode",
        "realtime",
        "--policy",
        "lease",
        "--agents",
        str(swarm.agents),
        "--slot-ms",
        f"{swarm.slot_ms:g}",
    ]
    words += ["--processes", "per-agent", "--no-picture", "--timeout-s", "3600", "--tail-s", "3600"]
    with flying(directory, *words) as flight:
        pids = [flight.pid_of(agent) for agent in range(1, swarm.agents + 1)]
        time.sleep(_SETTLED_S)
        before, begin = _processor_s(pids), time.monotonic()
        time.sleep(_WINDOW_S)
        used, took = _processor_s(pids) - before, time.monotonic() - begin
        memory = _pss_mb(pids)
        met(flight.process.poll() is None, f"the flight has ended: {flight.said().strip()[-300:]}")
        flight.process.send_signal(signal.SIGINT)
        flight.end()
    return {
        "processor_us_per_slot": used / (took * 1e9 / swarm.slot_ns) / swarm.agents * 1e6,
        "processors": used / took,
        "memory_pss_mb": memory,
    }


@contextmanager
def _agents(swarm: SwarmConfig, group: str, key: str, directory: Path) -> Iterator[list[subprocess.Popen[bytes]]]:
    """All agents of a swarm, a process each; none is left afterwards."""
    found: list[subprocess.Popen[bytes]] = []
    said = (directory / "said.txt").open("wb")
    try:
        for agent in range(1, swarm.agents + 1):
            words = command("agent", f"--id={agent}", "--interface=lo", f"--group={group}", *swarm_words(swarm))
            found.append(
                subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=said, env={**os.environ, VARIABLE: key})
            )
        yield found
    finally:
        for process in found:
            process.send_signal(signal.SIGTERM)
        for process in found:
            with suppress(subprocess.TimeoutExpired):
                process.wait(10.0)
            process.kill()
            process.wait()
        said.close()


def _listen(late: Callable[[], list[int]], seconds: float) -> list[int]:
    """How late the frames of a time left, ns."""
    found, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(0.02)
        found += late()
    return found


def _punctual(name: str, late_ns: Sequence[int]) -> dict[str, Any]:
    late = np.array(late_ns or [0])
    p50, p99 = np.percentile(late, (50, 99)) / 1e6
    return {
        f"{name}_on_time_share": float((late <= _ON_TIME_NS).mean()),
        f"{name}_late_ms": {"p50": round(float(p50), 3), "p99": round(float(p99), 3), "max": float(late.max()) / 1e6},
    }


def _processor_s(pids: Sequence[int]) -> float:
    """Processor time of processes so far, s."""
    total = 0
    for pid in pids:
        total += sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]))
    return total * _TICK_S


def _pss_mb(pids: Sequence[int]) -> float:
    """Mean memory of processes, MB; what several share counts in parts."""
    total = 0
    for pid in pids:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / len(pids) / 1024
