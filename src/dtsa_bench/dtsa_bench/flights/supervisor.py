"""Looks after the processes of a flight while it is under way."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.station import check_joinable
from dtsa_agent.ros.common.names import agent_names
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.realtime_channel import LOST_AFTER_S, RealtimeChannel

from .children import Child, Children, NodeError, describe_end
from .measurement import FlightMeasurement, tight


class Supervisor(ChannelObserver):
    """Ends the run when a process has ended: in lockstep a flight cannot go on without one of them."""

    def __init__(self, children: Children) -> None:
        self._children = children

    def idle(self, slot: int, awaited: list[int]) -> None:
        self._children.check()


@dataclass(frozen=True, slots=True)
class LateStart:
    """An agent whose process is started while the flight is under way."""

    after_s: float  # s after slot 0
    agent: int
    start: Callable[[], None]


class RealtimeSupervisor(ChannelObserver):
    """In real time the others fly on when a process ends, and it may be started again.

    :param respawn_s: s of wall time after which a process that died is started again; None: it is not.
    """

    def __init__(
        self, children: Children, channel: RealtimeChannel, measurement: FlightMeasurement,
        print_line: Callable[[str], None], respawn_s: float | None = None, late: Sequence[LateStart] = (),
    ) -> None:  # fmt: skip
        self._children, self._channel, self._measurement, self._print = children, channel, measurement, print_line
        self._respawn_s = respawn_s
        self._late = sorted(late, key=lambda start: start.after_s)
        self._dead: list[tuple[float, Child]] = []  # time.monotonic() at which each is started again
        self._new = {start.agent for start in late}  # those that have never taken part
        for start in late:
            measurement.metrics.awaited.add(start.agent)
            channel.expect_later(start.agent, measurement.scenario.start[:, start.agent - 1])

    def start_known(self, at_s: float) -> None:
        if text := tight(self._channel):
            self._print(text)

    def idle(self, slot: int, awaited: list[int]) -> None:
        begin_s = self._measurement.begin_s
        for child in self._children.ended():
            if not begin_s:
                self._children.check()
            self._report_end(child)
        while self._dead and time.monotonic() >= self._dead[0][0]:
            self._restart(self._dead.pop(0)[1])
        while self._late and begin_s and time.monotonic() - begin_s >= self._late[0].after_s:
            start = self._late.pop(0)
            start.start()
            self._print(f"{agent_names([start.agent])} is started")

    def _report_end(self, child: Child) -> None:
        """Take note that a process has ended; NodeError: no agent is left."""
        left = not child.process.returncode
        self._print(f"{f'{child.name} has left' if left else describe_end(child)}; the others fly on")
        for agent in child.agents:
            self._channel.lose(agent)
        if self._respawn_s is not None and not left:
            self._dead.append((time.monotonic() + self._respawn_s, child))
            self._measurement.metrics.awaited.update(child.agents)
        if len(self._channel.lost) == self._channel.agents and not self._dead and not self._late:
            raise NodeError(f"no agent is left: {describe_end(child)}")

    def _restart(self, child: Child) -> None:
        """Start the program of some agents again; their vehicles have gone on hovering where they were."""
        places = [value for agent in child.agents for value in self._channel.last_place(agent)]
        self._children.restart(child, ["-p", f"resume_at:=[{', '.join(f'{value:.6f}' for value in places)}]"])
        self._print(f"{child.name} is started again")

    def follow_parameters(self, node: Node) -> None:
        """Let parameters of the channel's node kill and start the processes of agents, as faults would."""
        for name in ("kill", "start"):
            node.declare_parameter(name, 0, ParameterDescriptor(description=f"id of an agent to {name} now"))

        def apply(parameters: list[Parameter]) -> SetParametersResult:
            try:
                for parameter in parameters:
                    if parameter.name in ("kill", "start"):
                        self._kill_or_start(parameter.value, kill=parameter.name == "kill")
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
            return SetParametersResult(successful=True)

        node.add_on_set_parameters_callback(apply)

    def _kill_or_start(self, agent: int, kill: bool) -> None:
        child = next((child for child in self._children.all if agent in child.agents), None)
        if child is None or child.has_ended == kill:
            raise ConfigError("agent", f"cf{agent}", f"one whose process {'runs' if kill else 'has ended'}")
        if kill:
            child.process.kill()
            return
        check_joinable(self._measurement.metrics.run.swarm.policy)
        self._dead = [entry for entry in self._dead if entry[1] is not child]
        self._measurement.metrics.awaited.update(child.agents)
        self._restart(child)

    def agents_back(self, agents: list[int]) -> None:
        again = "" if self._new.issuperset(agents) else " again"
        self._new.difference_update(agents)
        self._print(f"{agent_names(agents)} {'takes' if len(agents) == 1 else 'take'} part{again}")

    def agent_silent(self, agent: int) -> None:
        known = {agent for child in self._children.all if child.has_ended for agent in child.agents}
        if agent not in known | {start.agent for start in self._late}:
            self._print(f"{agent_names([agent])} has not been heard of for {LOST_AFTER_S:g} s; the others fly on")
