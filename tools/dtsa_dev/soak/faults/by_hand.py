"""Nodes started by hand: in any order, with other settings, without a channel."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dtsa_dev.soak.checks import met
from dtsa_dev.soak.flights import PATIENCE_S, until
from dtsa_dev.soak.item import NotMet
from dtsa_dev.soak.nodes import node_command, node_environment

from .fault import Fault

CHANNEL = "dtsa_channel_sim.ros.channel_node"
AGENT = "dtsa_agent.ros.agent_node"
_TWO = ("-p", "agents:=2")
_SLOTS = ("-p", "slots:=200")


class Nodes:
    """Node processes in a domain of their own.

    :param directory: where each puts what it says.
    :param domain: ROS domain.
    """

    def __init__(self, directory: Path, domain: int) -> None:
        self.directory, self.domain = directory, domain
        self.all: list[subprocess.Popen[bytes]] = []

    def start(self, module: str, *words: str) -> subprocess.Popen[bytes]:
        """Starts a node.

        :param module: its module.
        :param words: its ROS arguments.
        """
        environment = node_environment(self.domain, self.directory)
        with (self.directory / f"{len(self.all)}.txt").open("wb") as said:
            process = subprocess.Popen(
                node_command(module, *words), env=environment, stderr=said, stdout=subprocess.DEVNULL
            )
        self.all.append(process)
        return process

    def said(self, process: subprocess.Popen[bytes]) -> str:
        """What a node has said on its standard error."""
        return (self.directory / f"{self.all.index(process)}.txt").read_text(errors="replace").strip()

    def end(self, process: subprocess.Popen[bytes], code: int, *said: str, patience_s: float = PATIENCE_S) -> None:
        """A node ends by itself with a code, saying something, without a traceback.

        :param process: the node.
        :param code: its exit code.
        :param said: texts that it says.
        :param patience_s: s of wall time that it may take.
        """
        try:
            found = process.wait(patience_s)
        except subprocess.TimeoutExpired:
            raise NotMet(f"a node did not end within {patience_s:g} s: {self.said(process)[-200:]}") from None
        text = self.said(process)
        met(found == code, f"exit code {found} instead of {code}: {text[-300:]}")
        met("Traceback" not in text, f"a traceback: {text[-300:]}")
        for part in said:
            met(part in text, f"it does not say {part!r}: {text[-300:]}")


@contextmanager
def nodes(directory: Path) -> Iterator[Nodes]:
    """Node processes; none of them is left afterwards."""
    from dtsa_bench.flights.domain import ros_domain

    with ros_domain() as domain:
        found = Nodes(directory, domain)
        try:
            yield found
        finally:
            for process in found.all:
                if process.poll() is None:
                    process.kill()
                process.wait()


def _agents_first(directory: Path) -> None:
    with nodes(directory) as graph:
        agents = [graph.start(AGENT, "-p", f"id:={k}", *_TWO) for k in (1, 2)]
        time.sleep(3.0)
        channel = graph.start(CHANNEL, *_TWO, *_SLOTS)
        for process in (channel, *agents):
            graph.end(process, 0)


def _channel_first(directory: Path) -> None:
    with nodes(directory) as graph:
        channel = graph.start(CHANNEL, *_TWO, *_SLOTS)
        agents = [graph.start(AGENT, "-p", "id:=2", *_TWO)]
        time.sleep(3.0)
        agents.append(graph.start(AGENT, "-p", "id:=1", *_TWO))
        for process in (channel, *agents):
            graph.end(process, 0)


def _agent_missing(directory: Path) -> None:
    with nodes(directory) as graph:
        agent = graph.start(AGENT, "-p", "id:=1", *_TWO)
        channel = graph.start(CHANNEL, *_TWO, "-p", "startup_s:=8.0")
        graph.end(channel, 1, "cf2 did not", "within 8 s: dead or hung?")
        graph.end(agent, 0)


def _begun(graph: Nodes) -> tuple[subprocess.Popen[bytes], list[subprocess.Popen[bytes]]]:
    """A channel and two agents in a run without an end; they are at work."""
    channel = graph.start(CHANNEL, *_TWO)
    agents = [graph.start(AGENT, "-r", f"__ns:=/cf{k}", "-p", f"id:={k}", *_TWO) for k in (1, 2)]
    busy = [_ticks(process.pid) for process in agents]
    until(lambda: all(_ticks(p.pid) > b + 100 for p, b in zip(agents, busy, strict=True)), "the run begins")
    time.sleep(3.0)
    return channel, agents


def _channel_killed(directory: Path) -> None:
    with nodes(directory) as graph:
        channel, agents = _begun(graph)
        channel.kill()
        for process in agents:
            graph.end(process, 1, "the channel has gone", patience_s=30.0)


def _channel_restarted(directory: Path) -> None:
    with nodes(directory) as graph:
        channel, agents = _begun(graph)
        channel.kill()
        second = graph.start(CHANNEL, *_TWO, *_SLOTS)
        for process in agents:
            graph.end(process, 1, "the channel has gone", patience_s=30.0)
        if second.poll() is None:
            fresh = [graph.start(AGENT, "-p", f"id:={k}", *_TWO) for k in (1, 2)]
            for process in (second, *fresh):
                graph.end(process, 0)
        else:  # it began while the old agents were still there
            graph.end(second, 2, "no process of another run")


def _second_channel(directory: Path) -> None:
    with nodes(directory) as graph:
        channel, agents = _begun(graph)
        graph.end(graph.start(CHANNEL, "-r", "__node:=second", *_TWO), 2, "allowed: no")
        time.sleep(2.0)
        met(all(process.poll() is None for process in (channel, *agents)), "the first run has ended")
        channel.terminate()
        for process in (channel, *agents):
            graph.end(process, 0)


def _refused(directory: Path, second: tuple[str, ...], says: str) -> None:
    with nodes(directory) as graph:
        graph.start(AGENT, "-r", "__ns:=/cf1", "-p", "id:=1", *_TWO)
        graph.start(AGENT, "-r", "__ns:=/cf2", *second, *_TWO)
        graph.end(graph.start(CHANNEL, *_TWO), 2, says, "got", "allowed")


def _other_seed(directory: Path) -> None:
    _refused(directory, ("-p", "id:=2", "-p", "seed:=7"), "seed of /cf")


def _same_id(directory: Path) -> None:
    _refused(directory, ("-p", "id:=1"), "agents of no other process")


def _ticks(pid: int) -> int:
    """Processor time of a process, hundredths of a second."""
    words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return int(words[11]) + int(words[12])


def _wrong(module: str, *words: str, says: str) -> None:
    done = subprocess.run(node_command(module, *words), capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    said = done.stderr.strip()
    met(done.returncode == 2, f"exit code {done.returncode}: {said[-300:]}")
    met(says in said.splitlines()[-1] and "Traceback" not in said, f"it does not say {says!r}: {said[-300:]}")


def _unknown_policy(directory: Path) -> None:
    _wrong(AGENT, *_TWO, "-p", "policy:=polite", says="policy")


def _id_too_large(directory: Path) -> None:
    _wrong(AGENT, *_TWO, "-p", "id:=7", says="id")


def _impossible_loss(directory: Path) -> None:
    _wrong(CHANNEL, *_TWO, "-p", "loss:=2.0", says="loss")


_LINE = "one line that names setting and value, and code 2"

FAULTS = (
    Fault("agents before the channel", "all agents are started 3 s before the channel", "they wait; the run goes well",
          _agents_first, True),
    Fault("an agent after the others", "channel, then cf2, then, 3 s later, cf1", "they wait; the run goes well",
          _channel_first),
    Fault("an agent is never started", "an agent is missing at the start",
          "the channel names it and ends with code 1; the agents end", _agent_missing),
    Fault("channel killed, by hand", "SIGKILL to a channel whose agents were started by hand, lockstep",
          "the agents say that it has gone and end with code 1", _channel_killed),
    Fault("channel restarted, by hand", "the same, and a new channel is started at once",
          "the agents say that theirs has gone and end; the new one waits for others, or refuses the old ones by name",
          _channel_restarted),
    Fault("second channel", "a second channel is started beside a run under way",
          "it names the first, or its agents, and ends with code 2; the run goes on", _second_channel),
    Fault("other seed", "an agent has another seed than the others",
          "the channel refuses the run before slot 0, with setting, both values and node, and code 2", _other_seed,
          True),
    Fault("the same id twice", "two processes have the same agent",
          "the channel refuses the run before slot 0, names both, and ends with code 2", _same_id, True),
    Fault("unknown policy", "an agent's parameter `policy` is unknown", _LINE, _unknown_policy, True),
    Fault("id too large", "an agent's `id` is larger than `agents`", _LINE, _id_too_large, True),
    Fault("impossible loss", "the channel's parameter `loss` is 2", _LINE, _impossible_loss, True),
)  # fmt: skip
