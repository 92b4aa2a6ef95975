"""One flight with real nodes: the channel and the recorder in this process, the agents in others."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dtsa_agent.core import Scenario, SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.joining import check_joinable
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.loop import Stop
from dtsa_agent.ros.common.parameters import to_parameters
from dtsa_bench.metrics import FlightMetrics
from dtsa_bench.options import new_directory
from dtsa_bench.recorded_channel import BAG, RealtimeRecordedChannel, RecordedChannel, write_results
from dtsa_bench.run_config import LOCKSTEP, RunConfig
from dtsa_bench.simulate import may_share
from dtsa_channel_sim import make_clocks
from dtsa_channel_sim.ros.answers import named
from dtsa_channel_sim.ros.channel_node import declare_channel
from dtsa_channel_sim.ros.realtime_channel import LOST_AFTER_S

from .children import Child, Children, NodeError, describe_end
from .domain import ros_domain
from .progress import ProgressLine, flight_text

ENVIRONMENT = {
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    # A node needs no more threads than its own: NumPy's would cost start-up time and memory.
    "OPENBLAS_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
}


def run_environment(domain: int, logs: Path) -> dict[str, str]:
    """Variables for the processes of a run; this process gets those that its own node needs.

    :param domain: ROS domain.
    :param logs: directory for ROS's logs.
    """
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    os.environ["ROS_LOG_DIR"] = str(logs.resolve())
    return {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(logs.resolve())}


@dataclass(frozen=True, slots=True)
class FlightOptions:
    """How a flight is carried out; none of it changes what happens in it."""

    processes: int | None = None  # None: one an agent
    domain: int | None = None  # None: any that is free
    startup_s: float = 60.0
    answer_s: float = 10.0
    respawn_s: float | None = None  # real time: a process that died is started again after so long; None: it is not
    late_s: Mapping[int, float] = field(default_factory=dict)  # real time: agents that start so long after slot 0
    pictures: bool = True


@dataclass(frozen=True, slots=True)
class Flight:
    """What is left of a flight."""

    summary: dict[str, Any]  # as in summary.json
    scenario: Scenario
    positions: NDArray[np.float64]  # (T, 3, N) m, frame map, at the start of each slot
    bag: Path


class Supervision:
    """What makes a recorded channel look after the agents' processes and show how far it is; mixed into its class."""

    farewell_s = 1.0  # the supervisor ends those that have not heard

    def __init__(
        self, node: Node, run: RunConfig, directory: Path, children: Children, progress: ProgressLine, **more: Any
    ) -> None:
        super().__init__(node, run, directory, **more)  # type: ignore[call-arg]
        self._children, self._progress = children, progress
        self._start = time.monotonic()

    def idle(self) -> None:
        """Called about ten times a second."""
        super().idle()  # type: ignore[misc]
        self._look()
        if not self._progress.due():
            return
        if not self.begin_s:  # type: ignore[attr-defined]
            missing, agents = self.answers.missing, self.agents  # type: ignore[attr-defined]
            waited = time.monotonic() - self._start
            self._progress.show(f"starting, {waited:.0f} s, waiting for {missing} of {agents} agents")
        else:
            self.show()

    def _look(self) -> None:
        """Whether all processes are alive: in lockstep the flight cannot go on without one of them."""
        self._children.check()

    def show(self) -> None:
        """Brings the progress line up to date."""
        metrics: FlightMetrics = self.metrics  # type: ignore[attr-defined]
        flown = metrics.slots * self.slot_ns / 1e9  # type: ignore[attr-defined]
        closest, pair = metrics.closest()
        text = flight_text(metrics.slots, flown, self.wall_time_s, closest, pair)  # type: ignore[attr-defined]
        self._progress.show(text)


class SupervisedChannel(Supervision, RecordedChannel):
    """A lockstep flight under supervision."""


@dataclass(frozen=True, slots=True)
class LateStart:
    """An agent whose process is started while the flight is under way."""

    after_s: float  # s after slot 0
    agent: int
    start: Callable[[], None]


class SupervisedRealtimeChannel(Supervision, RealtimeRecordedChannel):
    """A flight in real time under supervision: the others fly on when a process dies, and it may be started again."""

    def __init__(self, *args: Any, respawn_s: float | None = None, late: Sequence[LateStart] = (), **more: Any) -> None:
        super().__init__(*args, **more)
        self._respawn_s = respawn_s
        self._late = sorted(late, key=lambda start: start.after_s)
        self._dead: list[tuple[float, Child]] = []  # time.monotonic() at which each is started again
        self._new = {start.agent for start in late}  # those that have never taken part
        for start in late:
            self.metrics.awaited.add(start.agent)
            self.expect_later(start.agent, self.scenario.start[:, start.agent - 1])

    def _look(self) -> None:
        for child in self._children.ended():
            if not self.begin_s:
                self._children.check()
            left = not child.process.returncode
            self._progress.say(f"{f'{child.name} has left' if left else describe_end(child)}; the others fly on")
            for agent in child.agents:
                self.lose(agent)
            if self._respawn_s is not None and not left:
                self._dead.append((time.monotonic() + self._respawn_s, child))
                self.metrics.awaited.update(child.agents)
            if len(self.lost) == self.agents and not self._dead and not self._late:
                raise NodeError(f"nobody is left: {describe_end(child)}")
        while self._dead and time.monotonic() >= self._dead[0][0]:
            self._start_again(self._dead.pop(0)[1])
        while self._late and self.begin_s and time.monotonic() - self.begin_s >= self._late[0].after_s:
            start = self._late.pop(0)
            start.start()
            self._progress.say(f"{named([start.agent])} is started")

    def _start_again(self, child: Child) -> None:
        """Starts the program of some agents again; their vehicles have gone on hovering where they were."""
        text = ", ".join(f"{value:.6f}" for agent in child.agents for value in self.last_place(agent))
        self._children.again(child, ["-p", f"resume_at:=[{text}]"])
        self._progress.say(f"{child.name} is started again")

    def back(self, agents: list[int]) -> None:
        super().back(agents)
        again = "" if self._new.issuperset(agents) else " again"
        self._new.difference_update(agents)
        self._progress.say(f"{named(agents)} {'takes' if len(agents) == 1 else 'take'} part{again}")

    def silent(self, agent: int) -> None:
        super().silent(agent)
        known = {agent for child in self._children.all if child.process.poll() is not None for agent in child.agents}
        if agent not in known | {start.agent for start in self._late}:
            self._progress.say(f"{named([agent])} has not been heard of for {LOST_AFTER_S:g} s; the others fly on")


def split(agents: int, processes: int) -> list[list[int]]:
    """Ids of the agents of each process, as evenly as possible."""
    return [
        list(range(agents * index // processes + 1, agents * (index + 1) // processes + 1))
        for index in range(processes)
    ]


def check_options(run: RunConfig, options: FlightOptions) -> None:
    """What can be known before anything is started.

    :raises ConfigError: for options that do not fit the run.
    """
    agents = run.swarm.agents
    if options.processes is not None and not 1 <= options.processes <= agents:
        raise ConfigError("processes", options.processes, f"per-agent, or 1 to {agents}, the number of agents")
    if run.swarm.estimator == "oracle" and (options.processes or agents) > 1:
        raise ConfigError("estimator", "oracle", "hold, linear or intent; the oracle only with --processes 1")
    late = dict(options.late_s)
    for name, value in (("respawn", options.respawn_s), ("late", late or None)):
        if value is not None and run.mode == LOCKSTEP:
            raise ConfigError(name, value, "only with --mode realtime: in lockstep all wait for all")
        if value is not None:
            check_joinable(run.swarm.policy)
    if options.respawn_s is not None and not 0.0 <= options.respawn_s <= 3600.0:
        raise ConfigError("respawn", options.respawn_s, "0 to 3600 s")
    if late and (not set(late) < set(range(1, agents + 1)) or not all(0.0 <= s <= 86400.0 for s in late.values())):
        raise ConfigError("late", late, f"some, not all, of the agents 1 to {agents}, and 0 to 86400 s")
    if late and options.processes is not None:
        raise ConfigError("late", late, "only with --processes per-agent")


def fly(
    run: RunConfig,
    out: str | Path,
    options: FlightOptions | None = None,
    stop: Stop | None = None,
    label: str = "fly",
    started: Callable[[Children], None] | None = None,
) -> Flight:
    """Carries out one flight; when this returns or raises, no process of it is left and its bag is closed.

    :param run: what is flown.
    :param out: directory for the bag and the results; empty, or not there yet.
    :param options: how.
    :param stop: a flag that ends the flight early.
    :param label: what stands in front of the progress line.
    :param started: is told the processes once they are started.
    :returns: its results, which are also in ``out``.
    :raises ConfigError: for options that are not usable; nothing has been started then.
    :raises DtsaError: when a node dies, hangs or sends garbage; the message names it.
    """
    options = options or FlightOptions()
    stop = stop if stop is not None else Stop()
    check_options(run, options)
    with ros_domain(options.domain) as domain:
        directory = new_directory(out)
        (directory / "log").mkdir()
        context = Context()
        children = Children(directory / "log", run_environment(domain, directory / "log"))
        progress = ProgressLine(label)
        # Started first: the interpreter of each process needs longer than all that follows here.
        late = _start_agents(children, run, options, directory)
        try:
            rclpy.init(args=[], context=context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
            if started:
                started(children)
            return _fly(context, run, directory, children, progress, options, stop, late)
        finally:
            children.stop()
            context.try_shutdown()


def _fly(
    context: Context,
    run: RunConfig,
    directory: Path,
    children: Children,
    progress: ProgressLine,
    options: FlightOptions,
    stop: Stop,
    late: Sequence[LateStart],
) -> Flight:
    node = Node("channel", namespace=names.SWARM, context=context, enable_rosout=False)
    try:
        declare_channel(node, run.air)
        limits = {"startup_s": options.startup_s, "answer_s": options.answer_s}
        channel: SupervisedChannel | SupervisedRealtimeChannel
        if run.mode == LOCKSTEP:
            channel = SupervisedChannel(node, run, directory, children, progress, **limits)
        else:
            again = options.respawn_s
            channel = SupervisedRealtimeChannel(
                node, run, directory, children, progress, respawn_s=again, late=late, **limits
            )
        try:
            channel.run(stop)
            channel.show()
        finally:
            channel.close()
            progress.end()
        children.stop()
        summary = write_results(channel, directory, pictures=options.pictures and not stop)
        return Flight(summary, channel.scenario, np.array(channel.positions), directory / BAG)
    finally:
        node.destroy_node()


def _start_agents(children: Children, run: RunConfig, options: FlightOptions, directory: Path) -> list[LateStart]:
    """Starts the agents' processes, but for those that come late."""
    swarm = run.swarm
    parameters = directory / "parameters.yaml"
    values = {**to_parameters(swarm.to_dict(), SwarmConfig), "mode": run.mode}
    content = {"/**": {"ros__parameters": values}}
    parameters.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    common = ["--ros-args", "--params-file", str(parameters), "--disable-external-lib-logs", "--disable-rosout-logs"]
    late: list[LateStart] = []
    if options.processes is None:
        for agent in range(1, swarm.agents + 1):
            place = ["-r", f"__ns:={names.agent_namespace(agent)}", *_clock_parameters(run, [agent])]
            start = partial(children.start, f"cf{agent}", [agent], "dtsa_agent.ros.agent_node", [*common, *place])
            if agent in options.late_s:
                late.append(LateStart(options.late_s[agent], agent, start))
            else:
                start()
        return late
    shared = str(run.mode == LOCKSTEP and may_share(run)).lower()
    for number, ids in enumerate(split(swarm.agents, options.processes), 1):
        own = ["-r", f"__node:=swarm_host_{number}", "-p", f"ids:={ids}", "-p", f"shared_view:={shared}"]
        name = f"swarm_host_{number} with {named(ids)}"
        children.start(name, ids, "dtsa_agent.ros.swarm_host", [*common, *own, *_clock_parameters(run, ids)])
    return late


def _clock_parameters(run: RunConfig, ids: list[int]) -> list[str]:
    """The clocks of some agents, and how long a frame takes, for real time."""
    if run.mode == LOCKSTEP:
        return []
    clocks = [make_clocks(run.clocks, run.swarm.agents)[agent - 1] for agent in ids]
    airtime, link = run.air.airtime, run.air.link_delay_ns
    fixed = airtime.total_ns(0)
    values = {
        "clock_offset_ns": [clock.offset_ns for clock in clocks],
        "clock_drift_ppb": [clock.drift_ppb for clock in clocks],
        "clock_jitter_ns": float(run.clocks.jitter_ns),
        "align": str(run.align).lower(),
        "flight_time_ns": [fixed + link, airtime.total_ns(1) - fixed],
    }
    return [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
