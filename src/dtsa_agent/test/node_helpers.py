"""A ROS graph for one test alone, and node processes in it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from waiting import wait_for

from dtsa_agent.ros.common.loop import ExecutorThread
from dtsa_agent.ros.common.node_process import init_ros, limit_to_machine
from dtsa_bench.flights.domain import ros_domain

PATIENCE_S = 120.0


def node_command(module: str, *arguments: str, logs: bool = False) -> list[str]:
    """``python -m module --ros-args arguments``; with ``logs`` its log goes to standard error, before its last line."""
    quiet = [] if logs else ["--disable-stdout-logs"]
    return [sys.executable, "-m", module, "--ros-args", *quiet, *arguments]


def node_environment(domain: int, logs: Path) -> dict[str, str]:
    """Environment of nodes that discover none beyond this machine."""
    here = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**here, **os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(logs)}


class Graph:
    """A node of the test, and processes in the same domain."""

    def __init__(self, node: Node, executor: SingleThreadedExecutor, environment: dict[str, str]) -> None:
        self.node, self.executor, self.environment = node, executor, environment
        self.processes: list[subprocess.Popen[str]] = []

    def start(self, module: str, *arguments: str, logs: bool = False) -> subprocess.Popen[str]:
        command = node_command(module, *arguments, logs=logs)
        process = subprocess.Popen(
            command, env=self.environment, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
        )
        self.processes.append(process)
        return process

    def until(self, condition: Callable[[], object], act: Callable[[], object] = lambda: None) -> None:
        """Serves the test's node until a condition holds, and acts again and again meanwhile."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            ended = [process.stderr.read() for process in self.processes if process.poll() and process.stderr]
            assert not ended, ended
            assert time.monotonic() < deadline, "nothing happened"
            act()
            self.executor.spin_once(timeout_sec=0.05)

    def ask(self, client: Client, request: Any) -> Any:
        """Answer of a service, asked again every few seconds: one that has not found its client yet drops answers."""
        answers = [client.call_async(request)]
        next_time = time.monotonic() + 5

        def again() -> None:
            nonlocal next_time
            if time.monotonic() > next_time:
                next_time = time.monotonic() + 5
                answers.append(client.call_async(request))

        self.until(lambda: any(answer.done() for answer in answers), again)
        return next(answer.result() for answer in answers if answer.done())


class ServedNode:
    """A node of a test that a thread serves until it is closed."""

    def __init__(self, domain: int, name: str) -> None:
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        self.node = _made(domain, name)
        self._clients: dict[str, Client] = {}
        self._serving = ExecutorThread(self.node, name)

    def client(self, kind: Any, name: str) -> Client:
        if name not in self._clients:
            began = time.monotonic()
            client = self.node.create_client(kind, name)
            assert client.wait_for_service(PATIENCE_S), name
            # The answer to a client that the server has not found yet is dropped; that takes about as long again.
            time.sleep(0.1 + 2 * (time.monotonic() - began))
            self._clients[name] = client
        return self._clients[name]

    def call(self, kind: Any, name: str, **fields: Any) -> Any:
        future = self.client(kind, name).call_async(kind.Request(**fields))
        wait_for(future.done, what=f"{name} does not answer")
        return future.result()

    def close(self) -> None:
        self._serving.close()
        _ended(self.node)


@contextmanager
def ros_graph(logs: Path) -> Iterator[Graph]:
    """A free domain with a node in it; all processes started in it end with it."""
    with ros_domain() as domain, graph_in(domain, logs) as graph:
        yield graph


@contextmanager
def graph_in(domain: int, logs: Path) -> Iterator[Graph]:
    """A node in a domain in which there may be others; all processes started in it end with it."""
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    environment = node_environment(domain, logs)
    node = _made(domain, "test")
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    graph = Graph(node, executor, environment)
    try:
        yield graph
    finally:
        for process in graph.processes:
            if process.poll() is None:
                process.kill()
            process.communicate()
        executor.shutdown()
        _ended(node)


def _made(domain: int, name: str) -> Node:
    """A node in a context of its own."""
    limit_to_machine(os.environ)
    context = Context()
    init_ros([], context, domain)
    return Node(name, context=context, enable_rosout=False, start_parameter_services=False)


def _ended(node: Node) -> None:
    node.destroy_node()
    node.context.try_shutdown()


def end_of(process: subprocess.Popen[str], number: int | None = None) -> tuple[int, str]:
    """Exit code and what was printed to standard error, after a signal, if one is given."""
    if number is not None:
        process.send_signal(signal.Signals(number))
    _, said = process.communicate(timeout=PATIENCE_S)
    return process.returncode, said
