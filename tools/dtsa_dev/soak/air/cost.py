"""What agents over UDP cost, beside the same agents as ROS nodes; how punctual they are, beside a bare timer."""

from __future__ import annotations

import contextlib
import json
import os
import random
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.air.datagram import Wrapping
from dtsa_agent.air.udp import MulticastSocket, UdpSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.agents.authentication import Authenticator
from dtsa_agent.keys import VARIABLE
from dtsa_dev.network.trial import swarm_words
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.flights import PATIENCE_S, command, flying, until
from dtsa_dev.soak.item import Item, NotMet

_WINDOW_S = 20.0  # at least
_ANCHORS = 1.5  # within so many times the longest silence of one that rests, all are heard
_START_S = 3.0  # for each agent
_NEW_ROUNDS = 30  # of N slots: who is new speaks at its anchors only
_SETTLED_S = 5.0  # after the last one has begun
_ON_TIME_NS = 1_000_000
_PUNCTUAL = 0.02  # share of frames on time may be smaller than the timer's by this
_SHARE = 0.5  # of the other form's cost
_COSTS = ("processor_us_per_slot", "memory_pss_mb")
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


def items() -> Iterator[Item]:
    """Twelve agents, both forms at the same time; seventy, one form after the other: two processors hold no more."""
    for agents, slot_ms, seconds in ((12, 10.0, 90.0), (70, 20.0, 420.0)):
        settings = {"agents": agents, "slot_ms": slot_ms, "cost": True, "together": agents == 12}
        yield Item(f"{agents} agents, {slot_ms:g} ms: cost and punctuality", settings, 1, seconds)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Flies both forms.

    :param item: one of this module's.
    :param directory: an empty one.
    :raises NotMet: if agents over UDP are less punctual than a timer, or cost more than half of the other form.
    """
    swarm = SwarmConfig(
        agents=item.settings["agents"], slot_ms=item.settings["slot_ms"], policy="lease", auth=True, auth_session=1
    )
    found: dict[str, Any] = {}
    if item.settings["together"]:
        with contextlib.suppress(_Apart):
            found = _together(swarm, directory)
    if not found:
        with over_udp(swarm, directory) as udp:
            _settle(udp)
            found = {"together": False, **_window(swarm, udp)}
        try:
            with over_ros(swarm, directory / "ros") as ros:
                time.sleep(_SETTLED_S)
                found |= _window(swarm, ros=ros)
        except NotMet as error:
            found["ros"] = f"did not fly: {error}"
    _judge(found)
    return found


class _Apart(NotMet):
    """The machine does not hold both forms at the same time."""


def _together(swarm: SwarmConfig, directory: Path) -> dict[str, Any]:
    """Both forms at the same time: what else the machine does weighs on both alike."""
    with over_udp(swarm, directory) as udp:
        try:
            with over_ros(swarm, directory / "ros-beside") as ros:
                _settle(udp)
                return {"together": True, **_window(swarm, udp, ros)}
        except NotMet as error:
            raise _Apart(str(error)) from error


def _judge(found: dict[str, Any]) -> None:
    """Compares with the bare timer, and with the other form."""
    udp, ros = found["udp"], found["ros"]
    frames, timer = udp["frames_on_time_share"], udp["timer_on_time_share"]
    met(frames >= timer - _PUNCTUAL, f"{frames:.1%} of frames on time, {timer:.1%} of a bare timer's wake-ups; {found}")
    if isinstance(ros, dict):
        found["share"] = {name: udp[name] / ros[name] for name in _COSTS}
        met(max(found["share"].values()) <= _SHARE, f"more than half of the cost as ROS nodes: {found}")


class Udp:
    """Agents on the loopback interface, without bags.

    :param swarm: the settings that all share.
    :param group: theirs.
    :param key: theirs.
    :param processes: theirs.
    :param listener: hears them.
    """

    def __init__(
        self, swarm: SwarmConfig, group: str, key: str, processes: Sequence[subprocess.Popen[bytes]],
        listener: MulticastSocket,
    ) -> None:  # fmt: skip
        self._listener, self.processes, self.swarm = listener, processes, swarm
        self.pids = [process.pid for process in processes]
        self._wrapping = Wrapping(swarm, Authenticator.from_hex(key, swarm.auth_session))
        self.heard: set[int] = set()

    def late(self) -> list[int]:
        """How late the frames left that have come since the last call, ns."""
        found = []
        for datagram in self._listener.receive(256):
            said = self._wrapping.read(datagram.data)
            if not said.fault:
                self.heard.add(said.sender)
                found.append(said.late_ns)
        return found

    def listen(self, seconds: float) -> list[int]:
        """How late the frames of a time left, ns.

        :param seconds: s, how long.
        """
        found, end = [], time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(0.02)
            found += self.late()
        return found


def _settle(udp: Udp) -> None:
    """Who is new speaks at its anchors only: waits until nobody is any more."""
    udp.listen(max(_SETTLED_S, _NEW_ROUNDS * udp.swarm.agents * udp.swarm.slot_s))


@contextmanager
def over_udp(swarm: SwarmConfig, directory: Path) -> Iterator[Udp]:
    """Agents on the loopback interface that all have spoken.

    :param swarm: the settings that all share.
    :param directory: for what they say.
    :raises NotMet: if one does not begin.
    """
    draw = random.Random(os.getpid())
    group = f"239.255.{draw.randrange(256)}.{draw.randrange(1, 255)}:{draw.randrange(20_000, 30_000)}"
    key = secrets.token_hex(32)
    with (
        MulticastSocket(UdpSettings(interface="lo", group=group)) as listener,
        _agents(swarm, group, key, directory) as all_of,
    ):
        udp = Udp(swarm, group, key, all_of, listener)

        def all_speak() -> bool:
            udp.late()
            if any(process.poll() is not None for process in all_of):
                raise NotMet(f"an agent has ended: {(directory / 'said.txt').read_text()[-300:]}")
            return len(udp.heard) == swarm.agents

        until(all_speak, "all agents speak", PATIENCE_S + _START_S * swarm.agents)
        yield udp


@contextmanager
def over_ros(swarm: SwarmConfig, directory: Path) -> Iterator[list[int]]:
    """The same agents as ROS nodes in real time, a process each, without the channel's and the recorder's.

    :param swarm: the settings that all share.
    :param directory: for the flight.
    :raises NotMet: if the flight does not begin, or ends.
    """
    words = ["--mode", "realtime", "--policy", "lease", "--agents", str(swarm.agents)]
    words += ["--slot-ms", f"{swarm.slot_ms:g}", "--processes", "per-agent", "--no-picture", "--no-stop-on-crash"]
    with flying(directory, *words, "--timeout-s", "3600", "--tail-s", "3600") as flight:
        try:
            yield [flight.pid_of(agent) for agent in range(1, swarm.agents + 1)]
        except OSError as error:  # a process that is asked for what it has used is gone
            raise NotMet(f"a node has ended: {error}; {flight.said().strip()[-300:]}") from error
        met(flight.process.poll() is None, f"the flight has ended: {flight.said().strip()[-300:]}")
        flight.process.send_signal(signal.SIGINT)
        flight.end()


def _window(swarm: SwarmConfig, udp: Udp | None = None, ros: Sequence[int] = ()) -> dict[str, Any]:
    """What agents use within a time, both forms the same time; how late frames over UDP and a bare timer are."""
    forms = {"udp": [] if udp is None else udp.pids, "ros": list(ros)}
    window_s = max(_WINDOW_S, _ANCHORS * (swarm.main_every + 1) * swarm.agents * swarm.slot_s)
    words = [sys.executable, "-m", "dtsa_dev.soak.air.bare_timer", str(swarm.slot_ns), str(window_s)]
    with contextlib.ExitStack() as stack:
        timer = None if udp is None else stack.enter_context(subprocess.Popen(words, stdout=subprocess.PIPE, text=True))
        before, begin = {name: _processor_s(pids) for name, pids in forms.items()}, time.monotonic()
        lates: list[int] = []
        if udp is None:
            time.sleep(window_s)
        else:
            udp.heard.clear()
            lates = udp.listen(window_s)
        used = {name: _processor_s(pids) - before[name] for name, pids in forms.items()}
        slots = (time.monotonic() - begin) / swarm.slot_s
        found = {
            name: {
                "processor_us_per_slot": used[name] / slots / len(pids) * 1e6,
                "processors": used[name] / slots / swarm.slot_s,
                "memory_pss_mb": _pss_mb(pids),
            }
            for name, pids in forms.items()
            if pids
        }
        if udp is not None and timer is not None:
            bare = json.loads(timer.communicate(timeout=PATIENCE_S)[0])
            met(len(udp.heard) == swarm.agents, f"only {len(udp.heard)} agents were heard within {window_s:g} s")
            found["udp"] |= {"frames": len(lates), "slots": round(slots)}
            found["udp"] |= {**_punctual("frames", lates), **_punctual("timer", bare)}
    return found


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
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10.0)
            process.kill()
            process.wait()
        said.close()


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
