"""The ground in tests: a bridge's process, and an operator who calls its services and knows the vehicles' states."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from builtin_interfaces.msg import Duration
from dtsa_msgs.msg import Status
from dtsa_msgs.srv import Arm, Takeoff
from node_helpers import Graph


def children_of(process: int) -> list[int]:
    tasks = Path(f"/proc/{process}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


class Operator:
    """Calls services of a bridge on a graph, and knows the states of some vehicles."""

    def __init__(self, graph: Graph, names: Sequence[str]) -> None:
        self.graph, self.names = graph, names
        self.states: dict[str, str] = {}
        for name in names:
            graph.node.create_subscription(Status, f"/{name}/status", lambda m, name=name: self._keep(name, m), 10)  # type: ignore[misc]

    def _keep(self, name: str, message: Status) -> None:
        self.states[name] = message.state_name

    def until(self, *states: str) -> None:
        """Wait for the vehicles' states; one: that of all."""
        wanted = states * len(self.names) if len(states) == 1 else states
        self.graph.until(lambda: tuple(map(self.states.get, self.names)) == wanted)

    def call(self, kind: Any, name: str, **fields: Any) -> None:
        client = self.graph.node.create_client(kind, name)
        self.graph.until(client.service_is_ready)
        answer = self.graph.ask(client, kind.Request(**fields))
        assert getattr(answer, "success", True), answer

    def arm(self) -> None:
        self.until("ready")
        self.call(Arm, "/all/arm", arm=True)
        self.until("armed")

    def take_off(self, height: float = 0.5, seconds: float = 2.0) -> None:
        self.arm()
        duration = Duration(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
        self.call(Takeoff, "/all/takeoff", height=height, duration=duration)
        self.until("flying")


class Bridge:
    """A bridge's process, or another one, in a graph; what it prints; and an operator."""

    def __init__(self, graph: Graph, command: Sequence[str], names: Sequence[str], more: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command, env=graph.environment | more, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.operator = Operator(graph, names)
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as stream:
            self.lines.extend(iter(stream.readline, ""))

    def text(self) -> str:
        return "".join(self.lines)

    def end(self, number: int | None = None) -> int:
        """Wait for its end, after a signal; the exit code."""
        if number is not None:
            self.process.send_signal(number)
        code = self.process.wait(60.0)
        self._reader.join(10)
        return code

    def child(self) -> int:
        return children_of(self.process.pid)[0]


@contextmanager
def running(graph: Graph, command: Sequence[str], names: Sequence[str] = (), **more: str) -> Iterator[Bridge]:
    """A process in a graph with more in its environment, and an operator of vehicles; it is killed in the end."""
    started = Bridge(graph, command, names, more)
    try:
        yield started
    finally:
        started.process.kill()
        started.end()
