"""Costs of agents over UDP, beside the same agents as ROS nodes at the same time, on the same machine."""

from __future__ import annotations

import json
import os
import random
import secrets
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.keys import VARIABLE

from . import Measurement

AGENTS, SLOT_S = 12, 0.01
WINDOW_S = 20.0
BEGIN_S, SETTLE_S = 10.0, 5.0  # until all have begun; new agents send at their anchors only for some rounds
PATIENCE_S = 180.0
SHARE = 0.5  # of the other form's processor time at most


def agents() -> Iterator[Measurement]:
    """Processor time of a slot and agent, and memory: `lease`, twelve agents, slots of 10 ms, no bags."""
    with tempfile.TemporaryDirectory() as place:
        udp, ros = _start_agents(), _start_flight(Path(place) / "flight")
        try:
            nodes = _wait_for_nodes(ros, Path(place) / "flight")
            time.sleep(BEGIN_S + SETTLE_S)
            forms = {"UDP": [process.pid for process in udp], "ROS": nodes}
            before, start = {name: _processor_s(pids) for name, pids in forms.items()}, time.monotonic()
            time.sleep(WINDOW_S)
            used = {name: _processor_s(pids) - before[name] for name, pids in forms.items()}
            slots = (time.monotonic() - start) / SLOT_S
            cost = {name: 1e6 * used[name] / slots / AGENTS for name in forms}
            memory = {name: _memory_mb(pids) for name, pids in forms.items()}
            _end_agents(udp)
        finally:
            for process in (*udp, ros):
                process.send_signal(signal.SIGINT)
            for process in (*udp, ros):
                process.wait(PATIENCE_S)
    ratio = cost["UDP"] / cost["ROS"]
    what, other = "a slot of an agent over UDP", f"as a ROS node {cost['ROS']:.3g} us"
    yield Measurement(what, f"{cost['UDP']:.3g} us", other, ratio, f"<= {SHARE:g}", ratio <= SHARE)
    other = f"as a ROS node {memory['ROS']:.3g} MB"
    yield Measurement("its memory (PSS)", f"{memory['UDP']:.3g} MB", other, memory["UDP"] / memory["ROS"])


def _start_agents() -> list[subprocess.Popen[str]]:
    draw = random.Random(os.getpid())
    group = f"239.255.{draw.randrange(256)}.{draw.randrange(1, 255)}:{draw.randrange(20_000, 30_000)}"
    words = ["--interface=lo", f"--group={group}", f"--agents={AGENTS}", "--policy=lease", f"--slot-ms={1e3 * SLOT_S}"]
    words += ["--auth-session=1", "--seal", "--json"]
    environment = {**os.environ, VARIABLE: secrets.token_hex(32)}
    return [
        subprocess.Popen(
            [sys.executable, "-m", "dtsa_bench", "agent", f"--id={number}", *words],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, text=True,
        )
        for number in range(1, AGENTS + 1)
    ]  # fmt: skip


def _end_agents(processes: Sequence[subprocess.Popen[str]]) -> None:
    """All have sent frames, or nothing was measured."""
    for process in processes:
        process.send_signal(signal.SIGTERM)
    for process in processes:
        summary = json.loads(process.communicate(timeout=PATIENCE_S)[0])
        if not summary["sent"]:
            raise DtsaError(f"cf{summary['id']} has sent nothing over UDP")


def _start_flight(directory: Path) -> subprocess.Popen[str]:
    """The ROS form: nodes in real time, a process each."""
    words = ["--mode", "realtime", "--policy", "lease", "--agents", str(AGENTS), "--slot-ms", f"{1e3 * SLOT_S:g}"]
    words += ["--processes", "per-agent", "--no-picture", "--no-stop-on-crash", "--timeout-s", "3600", "--tail-s"]
    command = [sys.executable, "-m", "dtsa_bench", "fly", "--out", str(directory), *words, "3600"]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True)


def _wait_for_nodes(flight: subprocess.Popen[str], directory: Path) -> list[int]:
    """The agents' processes of a flight whose slots are recorded; without channel and recorder."""
    bag, end = directory / "bag" / "bag_0.mcap", time.monotonic() + PATIENCE_S
    while not (bag.exists() and bag.stat().st_size > 6000):
        if flight.poll() is not None or time.monotonic() > end:
            raise DtsaError("the ROS form does not fly")
        time.sleep(0.1)
    pids = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_bytes(), (entry / "environ").read_bytes()
            except OSError:
                continue
            if f"DTSA_SUPERVISOR={flight.pid}\0".encode() in words[1] and b"__ns:=/cf" in words[0]:
                pids.append(int(entry.name))
    if len(pids) != AGENTS:
        raise DtsaError(f"{len(pids)} nodes of {AGENTS} fly")
    return pids


def _processor_s(pids: Sequence[int]) -> float:
    """Processor time of processes so far, s."""
    ticks = 0
    for pid in pids:
        ticks += sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]))
    return ticks / os.sysconf("SC_CLK_TCK")


def _memory_mb(pids: Sequence[int]) -> float:
    """Mean memory of processes, MB; what several share counts in parts."""
    total = 0
    for pid in pids:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
        total += next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total / len(pids) / 1024
