"""Nodes started by hand: in any order, with other settings, without a channel."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from fly_helpers import PATIENCE_S
from waiting import wait_for

from .row import FAULTS, Fault

if TYPE_CHECKING:
    from node_helpers import Graph

_CHANNEL = "dtsa_channel_sim.ros.channel_node"
_AGENT = "dtsa_agent.ros.agent_node"
_TWO = ("-p", "agents:=2")
_SLOTS = ("-p", "slots:=200")
_LINE = "one line that names setting and value, and code 2"


class Nodes:
    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def channel(self, *words: str) -> subprocess.Popen[str]:
        return self._graph.start(_CHANNEL, *_TWO, *words)

    def agent(self, number: int, *words: str) -> subprocess.Popen[str]:
        return self._graph.start(_AGENT, "-r", f"__ns:=/cf{number}", "-p", f"id:={number}", *_TWO, *words)

    def begin(self) -> tuple[subprocess.Popen[str], list[subprocess.Popen[str]]]:
        """Start a channel and two agents in a run without an end; they are at work."""
        channel, agents = self.channel(), [self.agent(1), self.agent(2)]
        idle = [_ticks(process.pid) for process in agents]
        wait_for(lambda: all(_ticks(p.pid) > t + 100 for p, t in zip(agents, idle, strict=True)), PATIENCE_S)
        time.sleep(3.0)
        return channel, agents


Act = Callable[[Nodes], None]


def _by_hand(what: str, reaction: str, *, sample: bool = False) -> Callable[[Act], Act]:
    """Declare a function as the row of a fault that befalls nodes started by hand; none is left afterwards."""

    def declare(act: Act) -> Act:
        def run(directory: Path) -> None:
            from node_helpers import ros_graph  # needs ROS, which the page's table does not

            with ros_graph(directory) as graph:
                act(Nodes(graph))

        FAULTS.append(Fault(what, reaction, run, act.__name__, sample))
        return act

    return declare


def _assert_ends(process: subprocess.Popen[str], code: int, *messages: str, patience_s: float = PATIENCE_S) -> None:
    _, text = process.communicate(timeout=patience_s)
    assert process.returncode == code, text[-300:]
    assert "Traceback" not in text, text[-300:]
    for message in messages:
        assert message in text, text[-300:]


def _ticks(pid: int) -> int:
    return sum(map(int, Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]))


@_by_hand("all agents are started 3 s before the channel", "they wait; the run goes well", sample=True)
def agents_before_the_channel(nodes: Nodes) -> None:
    agents = [nodes.agent(1), nodes.agent(2)]
    time.sleep(3.0)
    for process in (nodes.channel(*_SLOTS), *agents):
        _assert_ends(process, 0)


@_by_hand("channel, then cf2, then, 3 s later, cf1", "they wait; the run goes well")
def an_agent_after_the_others(nodes: Nodes) -> None:
    processes = [nodes.channel(*_SLOTS), nodes.agent(2)]
    time.sleep(3.0)
    for process in (*processes, nodes.agent(1)):
        _assert_ends(process, 0)


@_by_hand("an agent is missing at the start", "the channel names it and ends with code 1; the agents end")
def an_agent_is_never_started(nodes: Nodes) -> None:
    agent = nodes.agent(1)
    _assert_ends(nodes.channel("-p", "startup_s:=8.0"), 1, "cf2 did not", "within 8 s: dead or hung?")
    _assert_ends(agent, 0)


@_by_hand(
    "SIGKILL to a channel whose agents were started by hand, lockstep",
    "the agents say that it has gone and end with code 1",
    sample=True,
)
def channel_killed(nodes: Nodes) -> None:
    _kill_channel(nodes)


def _kill_channel(nodes: Nodes, *words: str) -> subprocess.Popen[str] | None:
    """The agents end when the channel is killed, also where another one is started with words at once: that one."""
    channel, agents = nodes.begin()
    channel.kill()
    second = nodes.channel(*words) if words else None
    for process in agents:
        _assert_ends(process, 1, "the channel has gone", patience_s=30.0)
    return second


@_by_hand(
    "the same, and a new channel is started at once",
    "the agents say that theirs has gone and end; the new one waits for others, or refuses the old ones by name",
    sample=True,
)
def channel_restarted(nodes: Nodes) -> None:
    second = _kill_channel(nodes, *_SLOTS)
    assert second is not None
    if second.poll() is None:
        for process in (nodes.agent(1), nodes.agent(2), second):
            _assert_ends(process, 0)
    else:  # it began while the old agents were still there
        _assert_ends(second, 2, "no process of another run")


@_by_hand(
    "a second channel is started beside a run under way",
    "it names the first, or its agents, and ends with code 2; the run goes on",
    sample=True,
)
def second_channel(nodes: Nodes) -> None:
    channel, agents = nodes.begin()
    _assert_ends(nodes.channel("-r", "__node:=second"), 2, "allowed: no")
    time.sleep(2.0)
    assert all(process.poll() is None for process in (channel, *agents))
    channel.terminate()
    for process in (channel, *agents):
        _assert_ends(process, 0)


@_by_hand(
    "an agent has another seed than the others",
    "the channel refuses the run before slot 0, with setting, both values and node, and code 2",
)
def other_seed(nodes: Nodes) -> None:
    nodes.agent(1)
    nodes.agent(2, "-p", "seed:=7")
    _assert_ends(nodes.channel(), 2, "seed of /cf", "got", "allowed")


@_by_hand(
    "two processes have the same agent",
    "the channel refuses the run before slot 0, names both, and ends with code 2",
    sample=True,
)
def the_same_id_twice(nodes: Nodes) -> None:
    nodes.agent(1)
    nodes.agent(2, "-p", "id:=1")
    _assert_ends(nodes.channel(), 2, "agents of no other process", "got", "allowed")


@_by_hand("an agent's parameter `policy` is unknown", _LINE)
def unknown_policy(nodes: Nodes) -> None:
    _assert_ends(nodes.agent(1, "-p", "policy:=polite"), 2, "policy")


@_by_hand("an agent's `id` is larger than `agents`", _LINE)
def id_too_large(nodes: Nodes) -> None:
    _assert_ends(nodes.agent(7), 2, "id")


@_by_hand("the channel's parameter `loss` is 2", _LINE)
def impossible_loss(nodes: Nodes) -> None:
    _assert_ends(nodes.channel("-p", "loss:=2.0"), 2, "loss")
