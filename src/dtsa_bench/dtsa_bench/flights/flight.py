"""One flight with real nodes: the channel and the recorder in this process, the agents in others.

This module owns the order in which a flight ends, however it ends; each step has a limit of its own:

1. **Why.** The run is over, or a `StopToken` is true (a signal, or no more wall time), or an error. Ctrl-C reaches this
   process alone (`children.Children.start`), and sets a flag (`dtsa_agent/stop.py`): the slot that goes on is carried
   out whole.
2. **The channel** leaves its loop and publishes the END message, by which agents end by themselves.
3. **The bag.** `channel.close()` closes the observers, the recorder first: from here on the bag is whole, whatever
   happens to processes. Then it waits up to ``END_S`` until all nodes have heard of the end.
4. **The processes.** `children.stop()` waits for them, sends SIGTERM, waits, sends SIGKILL.
5. **The results:** summary and picture, from the metrics of this process; no picture after an early end. Then an error
   of the flight is raised.
6. **The node** of this process is destroyed last of all, and its ROS context after it.

If a call into a library stands still after a signal, `Stop` ends this process after its patience, with the place of
each thread.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shutil import rmtree
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node

from dtsa_agent.core import Scenario, SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.core.station import check_joinable, check_slotted
from dtsa_agent.keys import check_key
from dtsa_agent.priority import set_nice, set_realtime, set_realtime_or_nice
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.names import agent_names
from dtsa_agent.ros.common.node_process import init_ros, limit_to_machine
from dtsa_agent.ros.common.parameters import to_parameters
from dtsa_agent.stop import Stop, StopToken
from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_bench.runs.metrics import may_share
from dtsa_bench.runs.options import new_directory
from dtsa_channel_sim.ros.channel_node import declare_channel
from dtsa_channel_sim.ros.lockstep import LockstepChannel
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

from .children import Children
from .domain import ros_domain
from .options import CHANNEL_NICE, FlightOptions, agent_processes
from .progress import FlightProgress, ProgressLine
from .recorded_channel import BAG, RecordedFlight
from .supervisor import LateStart, RealtimeSupervisor, Supervisor

# A node needs no more threads than its own: NumPy's would cost start-up time and memory.
ENVIRONMENT = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

# The log of this process's nodes goes to /rosout alone: the progress line tells the same here.
QUIET = ["--ros-args", "--disable-stdout-logs", "--disable-external-lib-logs"]

END_S = 1.0  # wall time in which the nodes are to hear of the end; those that have not are ended then


def run_environment(domain: int, logs: Path) -> dict[str, str]:
    """Variables for the processes of a run; this process gets those that its own node needs."""
    for name, value in ENVIRONMENT.items():
        os.environ.setdefault(name, value)
    limit_to_machine(os.environ)
    os.environ["ROS_LOG_DIR"] = str(logs.resolve())
    return {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(logs.resolve())}


def parameter_arguments(directory: Path, parameters: dict[str, Any]) -> list[str]:
    """Write parameters of agents' nodes into a file; the arguments by which a node reads them, and logs little."""
    path = directory / "parameters.yaml"
    content = {"/**": {"ros__parameters": parameters}}
    path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")
    return ["--ros-args", "--params-file", str(path), "--disable-external-lib-logs", "--disable-rosout-logs"]


@dataclass(frozen=True, slots=True)
class Flight:
    """What is left of a flight."""

    summary: dict[str, Any]  # as in summary.json
    scenario: Scenario
    positions: NDArray[np.float64]  # (T, 3, N) m, frame map, at starts of slots: of all, or evenly spread ones
    bag: Path


def check_options(run: RunConfig, options: FlightOptions) -> None:
    """What can be known before anything is started.

    :raises ConfigError: for options that do not fit the run.
    """
    check_key(run.swarm)
    make_scenario(run.swarm)  # says so if the field is larger than frames can say
    agents, policy, late = run.swarm.agents, run.swarm.policy_row, dict(options.late)
    if options.processes is not None and options.processes > agents:
        raise ConfigError("processes", options.processes, f"per-agent, or 1 to {agents}, the number of agents")
    check_slotted(policy.name)
    if run.mode != LOCKSTEP or (options.processes or agents) > 1:
        if run.swarm.estimator_row.needs_everybody:
            allowed = "hold, linear or intent; the oracle in lockstep with --processes 1 only"
            raise ConfigError("estimator", "oracle", allowed)
        if policy.needs_everybody:
            raise ConfigError("policy", policy.name, "in lockstep with --processes 1 only: it looks into all agents")
    for name, value in (("respawn", options.respawn), ("late", late or None)):
        if value is not None and run.mode == LOCKSTEP:
            raise ConfigError(name, value, "only with --mode realtime: in lockstep all wait for all")
        if value is not None:
            check_joinable(run.swarm.policy)
    if late and not set(late) < set(range(1, agents + 1)):
        raise ConfigError("late", late, f"some, not all, of the agents 1 to {agents}")
    if late and options.processes is not None:
        raise ConfigError("late", late, "only with --processes per-agent")


def fly(
    run: RunConfig, out: str | Path, options: FlightOptions | None = None, stop: Stop | None = None,
    label: str = "fly", started: Callable[[Children], None] | None = None, observers: Sequence[ChannelObserver] = (),
    progress: ProgressLine | None = None, on_domain: Callable[[int, Mapping[str, str]], None] | None = None,
) -> Flight:  # fmt: skip
    """Carries out one flight; when this returns or raises, no process of it is left and its bag is closed.

    :param out: directory for the bag and the results; empty, or not there yet.
    :param progress: shows how it goes; None: a line on standard error.
    :param on_domain: called with the ROS domain and the variables of its processes before the flight begins.
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
        environment = run_environment(domain, directory / "log")
        children = Children(directory / "log", environment)
        progress = progress or ProgressLine(label)
        try:
            # Started first: the interpreter of each process needs longer than all that follows here.
            late = _start_agents(children, run, options, directory, stop)
            try:
                with stop.interruptible():
                    if on_domain:
                        on_domain(domain, environment)
                    init_ros(QUIET, context, domain)
                    if started:
                        started(children)
                    node = Node("channel", namespace=names.SWARM, context=context)
                    declare_channel(node, run.air)
                    flight = RecordedFlight(node, run, directory, options.startup_s, options.answer_s, END_S)
            except KeyboardInterrupt:
                rmtree(directory / BAG, ignore_errors=True)  # there is nothing in it yet
                raise
            return _fly(flight, node, directory, children, progress, options, stop, late, observers)
        finally:
            children.stop(hurry=bool(stop))
            with stop.in_time():
                context.try_shutdown()


def _fly(
    flight: RecordedFlight, node: Node, directory: Path, children: Children, progress: ProgressLine,
    options: FlightOptions, stop: Stop, late: Sequence[LateStart], observers: Sequence[ChannelObserver],
) -> Flight:  # fmt: skip
    failure: DtsaError | None = None
    try:
        channel, measurement = flight.channel, flight.measurement
        shown = FlightProgress(progress, measurement, channel)
        supervisor: Supervisor | RealtimeSupervisor = Supervisor(children)
        if isinstance(channel, RealtimeChannel):
            supervisor = RealtimeSupervisor(children, channel, measurement, progress.print_line, options.respawn, late)
            supervisor.follow_parameters(node)
        channel.observe(supervisor, shown, *observers)
        limit_s = options.wall_limit_s(flight.run_config.limits.timeout_s)
        late_text = f"the flight took longer than {limit_s:g} s by the clock on the wall (--wall-timeout-s)"
        ended = StopToken(stop, lambda: late_text if measurement.wall_time_s > limit_s else "")
        try:
            _run(channel, ended, shown, options.priority)
        except DtsaError as error:
            failure = error
        progress.end()
        children.stop(hurry=bool(stop))
        try:
            pictures = options.pictures and not ended and failure is None
            # Why it ended before its time: not if the user ended it.
            reason = str(failure or "") or ended.reason or getattr(channel, "fell_behind", "")
            summary = flight.write_results(pictures, **({"cut_short": reason} if reason else {}))
        except OSError:
            if failure is None:
                raise
        if failure is not None:
            raise failure
        return Flight(summary, flight.scenario, measurement.positions.array(), directory / BAG)
    finally:
        # Last of all (6): the middleware may stand still for ever if others leave in the same moment.
        with stop.in_time():
            node.destroy_node()


def _run(channel: LockstepChannel | RealtimeChannel, ended: StopToken, shown: FlightProgress, priority: int) -> None:
    """The flight itself; the channel is closed afterwards."""
    # Before its agents, and both before all else if that is allowed.
    own = priority and priority + 1
    first = isinstance(channel, RealtimeChannel) and not set_realtime_or_nice(own, CHANNEL_NICE, False)
    try:
        channel.run(ended)
        shown.show()
    finally:
        if ended.stop:
            channel.hurry()
        try:
            channel.close()
        finally:
            if first and not ended.stop:  # who has been told to end does so before all else
                set_realtime(0)
                set_nice(0)


def _start_agents(
    children: Children, run: RunConfig, options: FlightOptions, directory: Path, stop: Stop
) -> list[LateStart]:
    """Start the agents' processes, but for those that come late; KeyboardInterrupt: on a signal, between two."""
    common = parameter_arguments(directory, {**to_parameters(run.swarm.to_dict(), SwarmConfig), "mode": run.mode})
    late: list[LateStart] = []
    for process in agent_processes(run, options.processes, options.priority):
        if stop:
            raise KeyboardInterrupt
        own, name, module = dict(process.parameters), f"cf{process.ids[0]}", "dtsa_agent.ros.agent_node"
        if process.executable == "swarm_host":
            name, module = f"{process.node} with {agent_names(process.ids)}", "dtsa_agent.ros.swarm_host"
            own["shared_table"] = run.mode == LOCKSTEP and may_share(run)
        words = [*common, "-r", f"__ns:={process.namespace}", "-r", f"__node:={process.node}"]
        words += [word for key, value in own.items() for word in ("-p", f"{key}:={json.dumps(value)}")]
        start = partial(children.start, name, process.ids, module, words)
        if options.processes is None and process.ids[0] in options.late:
            late.append(LateStart(options.late[process.ids[0]], process.ids[0], start))
        else:
            start()
    return late
