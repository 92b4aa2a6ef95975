"""Agents over UDP on the loopback interface, or another port, in threads of the test, with a bag each."""

from __future__ import annotations

import math
import os
import random
import socket
import threading
import time
from collections import Counter, deque
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from waiting import wait_for

from dtsa_agent.air.driver import LiveAgent
from dtsa_agent.air.port import PortSettings
from dtsa_agent.air.ports import open_port
from dtsa_agent.air.record import SlotRecord
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.air.udp import UdpPort, UdpSettings
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_agent.stop import Stop
from dtsa_bench.network.sniffer import Sniffer
from dtsa_bench.recordings.merge.agent_recorder import AgentRecorder

_PATIENCE_S = 60.0


def own_group() -> str:
    """A multicast group that no other test uses."""
    draw = random.Random(f"{os.getpid()} {time.monotonic_ns()}")
    return f"239.255.{draw.randrange(256)}.{draw.randrange(1, 255)}:{draw.randrange(20_000, 30_000)}"


def need_multicast() -> None:
    """Skips the test where the loopback interface carries no multicast."""
    try:
        with UdpPort(UdpSettings(interface="lo", group=own_group())) as end:
            end.send(b"x")
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
        self.agent = LiveAgent(own, config, self.port, say=self.said.append)
        self.recorder = AgentRecorder(path, own, config, settings)
        self.agent.watcher = self
        self.stop = Stop()
        self.heard: Counter[int] = Counter()  # frames by sender, since it began anew
        self.slots: list[int] = []
        self.speed = 0.0  # m/s, at the start of the last slot
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def slot(self, record: SlotRecord) -> None:
        """See Watcher."""
        if record.anew:
            self.heard.clear()
        self.heard.update(frame.sender for frame in record.heard)
        self.slots.append(record.slot)
        self.speed = math.sqrt(float(record.velocity @ record.velocity))
        self.recorder.slot(record)

    def other(self, reason: str, data: bytes, arrival_ns: int) -> None:
        """See Watcher."""
        self.recorder.other(reason, data, arrival_ns)

    def _run(self) -> None:
        with self.recorder, self.port:
            self.agent.run(self.stop)
            self.recorder.finish(self.agent.summary())

    def end(self) -> None:
        """As by a signal."""
        self.stop.signal = self.stop.count = 1
        self._thread.join(_PATIENCE_S)
        assert not self._thread.is_alive()


class Sniffing:
    """Somebody who listens, in a thread."""

    def __init__(self, config: SwarmConfig, settings: PortSettings, *files: Path) -> None:
        self.sniffer = Sniffer(config, settings, *files)
        self._stop = Stop()
        self._thread = threading.Thread(target=self.sniffer.run, args=(self._stop,))

    def start(self) -> None:
        """Begins."""
        self._thread.start()

    def end(self) -> dict[str, Any]:
        """Ends, if it has begun; what it has found."""
        self._stop.signal = self._stop.count = 1
        if self._thread.ident is not None:
            self._thread.join(_PATIENCE_S)
            assert not self._thread.is_alive()
        self.sniffer.close()
        return self.sniffer.summary()


class Stranger:
    """Sends what it likes to a group of the loopback interface, and hears what is said there."""

    def __init__(self, group: str) -> None:
        self.socket = UdpPort(UdpSettings(interface="lo", group=group))

    def hear(self, count: int) -> list[bytes]:
        """Datagrams of others."""
        found: list[bytes] = []

        def enough() -> bool:
            found.extend(datagram.data for datagram in self.socket.receive(16) if not datagram.own)
            return len(found) >= count

        wait_for(enough)
        return found

    def close(self) -> None:
        """Leaves."""
        with suppress(socket.error):
            self.socket.close()


class TwoWays:
    """Carries datagrams between two groups of the loopback interface, either way while that is not cut.

    :param near: a group.
    :param far: another one.
    """

    def __init__(self, near: str, far: str) -> None:
        self._ends = [UdpPort(UdpSettings(interface="lo", group=group)) for group in (near, far)]
        self.to_far = self.to_near = True
        self._stopped = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        near, far = self._ends
        while not self._stopped:
            for source, target, carries in ((near, far, self.to_far), (far, near, self.to_near)):
                for datagram in source.receive(100):
                    if carries and not datagram.own:
                        target.send(datagram.data)
            time.sleep(0.0005)

    def end(self) -> None:
        """Carries nothing any more."""
        self._stopped = True
        self._thread.join(_PATIENCE_S)
        for end in self._ends:
            end.close()


class OneWay:
    """Carries datagrams from one group of the loopback interface to another one, late, and none back.

    :param source: the group that is heard.
    :param target: the group that hears it.
    :param delay_s: s, how long each is under way.
    """

    def __init__(self, source: str, target: str, delay_s: float) -> None:
        self._ends = [UdpPort(UdpSettings(interface="lo", group=group)) for group in (source, target)]
        self._delay_s = delay_s
        self._stopped = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        waiting: deque[tuple[float, bytes]] = deque()
        source, target = self._ends
        while not self._stopped:
            now = time.monotonic()
            waiting.extend((now + self._delay_s, datagram.data) for datagram in source.receive(100))
            while waiting and waiting[0][0] <= now:
                target.send(waiting.popleft()[1])
            time.sleep(0.0005)

    def end(self) -> None:
        """Carries nothing any more."""
        self._stopped = True
        self._thread.join(_PATIENCE_S)
        for end in self._ends:
            end.close()
