"""Agents over UDP on the loopback interface, or another port, in threads of the test, with a bag each."""

from __future__ import annotations

import json
import math
import os
import random
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_for

from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.port import PortSettings, open_port
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.air.settings import AgentSettings, UdpSettings
from dtsa_agent.air.udp_port import UdpPort
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.stop import Stop
from dtsa_bench.log.agent_bag import AgentRecorder, read
from dtsa_bench.log.arrays import FlightArrays
from dtsa_bench.log.merge.merge import Merge, is_verified
from dtsa_bench.log.merged_bag import write_merged
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.network.sniffer import Sniffer
from dtsa_bench.pages.view.history import MAX_MOMENTS, RunHistory
from dtsa_bench.pages.view.network_listener import NetworkListener

_PATIENCE_S = 60.0
Own = Callable[[int], dict[str, Any]]  # settings of an agent, by its id


def own_group() -> str:
    """A multicast group that no other test uses."""
    draw = random.Random(f"{os.getpid()} {time.monotonic_ns()}")
    return f"239.255.{draw.randrange(256)}.{draw.randrange(1, 255)}:{draw.randrange(20_000, 30_000)}"


def need_multicast() -> None:
    """Skips the test where the loopback interface carries no multicast."""
    try:
        settings = UdpSettings(interface="lo", group=own_group())
        with UdpPort(settings) as end, UdpPort(settings) as other:
            other.send(b"x")
            for _ in range(100):
                if end.receive(1):
                    return
                time.sleep(0.01)
    except ConfigError as error:
        pytest.skip(str(error))
    pytest.skip("the loopback interface carries no multicast")


class Flying:
    """One agent in a thread; a watcher of it beside its recorder."""

    def __init__(self, own: AgentSettings, config: SwarmConfig, settings: PortSettings, path: Path) -> None:
        self.port = open_port(settings)
        self.said: list[str] = []  # in flight
        self.agent = LiveAgent(own, config, self.port, log=self.said.append)
        self.recorder = AgentRecorder(path, own, config, settings)
        self.agent.watcher = self
        self.stop = Stop()
        self.heard: Counter[int] = Counter()  # frames by sender, since it began anew
        self.slots: list[int] = []
        self.speed = 0.0  # m/s, at the start of the last slot
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def slot(self, record: SlotRecord) -> None:
        if record.is_first:
            self.heard.clear()
        self.heard.update(frame.sender for frame in record.heard)
        self.slots.append(record.slot)
        self.speed = math.sqrt(float(record.velocity @ record.velocity))
        self.recorder.slot(record)

    def refused(self, reason: str, data: bytes, arrival_ns: int) -> None:
        self.recorder.refused(reason, data, arrival_ns)

    def _run(self) -> None:
        with self.recorder, self.port:
            self.agent.run(self.stop)
            self.recorder.finish(self.agent.summary())

    def end(self) -> None:
        self.stop.signal = self.stop.count = 1
        self._thread.join(_PATIENCE_S)
        assert not self._thread.is_alive()


class Sniffing:
    def __init__(self, config: SwarmConfig, settings: PortSettings, *files: Path) -> None:
        self.sniffer = Sniffer(config, settings, *files)
        self._stop = Stop()
        self._thread = threading.Thread(target=self.sniffer.run, args=(self._stop,))

    def start(self) -> None:
        self._thread.start()

    def end(self) -> dict[str, Any]:
        """Ends, if it has begun; what it has found."""
        self._stop.signal = self._stop.count = 1
        if self._thread.ident is not None:
            self._thread.join(_PATIENCE_S)
            assert not self._thread.is_alive()
        self.sniffer.close()
        return self.sniffer.summary()


def hear(port: UdpPort, count: int) -> list[bytes]:
    """So many datagrams that others send, or more."""
    found: list[bytes] = []
    wait_for(lambda: found.extend(d.data for d in port.receive(16)) or len(found) >= count)
    return found


class Carrier:
    """Carries datagrams between two groups of the loopback interface, late, either way while that is not cut."""

    def __init__(self, near: str, far: str, delay_s: float = 0.0, back: bool = True) -> None:
        self._ends = [UdpPort(UdpSettings(interface="lo", group=group)) for group in (near, far)]
        self.to_far, self.to_near, self._delay_s, self._stopped = True, back, delay_s, False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        waiting: deque[tuple[float, UdpPort, bytes]] = deque()
        near, far = self._ends
        while not self._stopped:
            now = time.monotonic()
            for source, target, carries in ((near, far, self.to_far), (far, near, self.to_near)):
                found = [datagram.data for datagram in source.receive(100) if carries]
                waiting.extend((now + self._delay_s, target, data) for data in found)
            while waiting and waiting[0][0] <= now:
                _, target, data = waiting.popleft()
                target.send(data)
            time.sleep(0.0005)

    def end(self) -> None:
        self._stopped = True
        self._thread.join(_PATIENCE_S)
        for end in self._ends:
            end.close()


@contextmanager
def flying(
    config: SwarmConfig, ports: Iterable[PortSettings], directory: Path, own: Own = lambda _: {}
) -> Iterator[list[Flying]]:
    """Agents 1, 2, ... at ports, one started after the other, with bags in a directory; `own` gives their settings."""
    agents: list[Flying] = []
    try:
        for id, port in enumerate(ports, 1):
            agents.append(Flying(AgentSettings(id=id, **own(id)), config, port, directory / f"cf{id}.mcap"))
        yield agents
    finally:
        for one in agents:
            one.end()


def go_on(agents: Sequence[Flying], slots: int) -> None:
    """All go on for so many slots."""
    seen = [len(one.slots) for one in agents]
    wait_for(lambda: all(len(one.slots) > before + slots for one, before in zip(agents, seen, strict=True)))


def hear_each_other(agents: Sequence[Flying], frames: int) -> None:
    """Wait until each has heard more frames than that of every other one."""
    wait_for(lambda: all(len(o.heard) == len(agents) - 1 and min(o.heard.values()) > frames for o in agents))


@contextmanager
def listening(config: SwarmConfig, settings: PortSettings) -> Iterator[Callable[[], list[dict[str, Any]]]]:
    """A page's listener; what is given are the moments that it has told so far."""
    history = RunHistory("listener")
    source = NetworkListener(history, config, settings)
    thread = threading.Thread(target=source.run)
    thread.start()
    try:
        yield lambda: [json.loads(moment.text) for moment in history.since(0, MAX_MOMENTS)[1]]
    finally:
        source.stopped = True
        thread.join()


def merge_bags(paths: Iterable[Path], whole: Path) -> tuple[FlightArrays, dict[str, Any]]:
    """The merged run, and what was found of it; its bag is written to `whole`."""
    together = Merge([read(path) for path in paths])
    merged = together.summary()
    run = together.log
    write_merged(whole, run, merged)
    return run, merged


def check_merged(merged: dict[str, Any], whole: Path, decisions: int) -> None:
    """No slot had two senders, and the same receptions give the same decisions, more than so many."""
    assert merged["common_slot"] is not None
    assert merged["slots_with_two_senders"] == merged["frames_heard_not_as_sent"] == 0
    assert merged["frames_sent"] > 60
    again = merged["decisions_again"]
    assert again["differences"] == []
    assert again["equal"] == again["of"] > decisions
    assert is_verified(merged)
    assert verify_bag(whole).to_dict()["difference"] is None
