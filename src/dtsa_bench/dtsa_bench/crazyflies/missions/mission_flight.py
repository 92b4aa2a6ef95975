"""A mission with Crazyflies: take-off, exchange of places in real time, landing; recorded like any other flight."""

from __future__ import annotations

import dataclasses
import os
import signal
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from rclpy.context import Context
from rclpy.node import Node

from dtsa_agent.core import Scenario, SwarmConfig
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.core.station import check_slotted
from dtsa_agent.crazyflie.link import require_cflib
from dtsa_agent.crazyflie.node.bridge_node import is_urgent
from dtsa_agent.crazyflie.settings import SwarmSettings
from dtsa_agent.keys import check_key
from dtsa_agent.priority import avoid_last_processor, set_ordinary_thread, set_realtime
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.node_process import init_ros
from dtsa_agent.ros.common.parameters import to_parameters
from dtsa_agent.stop import Stop, StopToken
from dtsa_bench.flights.children import Children, NodeError, describe_end
from dtsa_bench.flights.domain import LAST_DOMAIN, ros_domain
from dtsa_bench.flights.flight import END_S, QUIET, Flight, parameter_arguments, run_environment
from dtsa_bench.flights.options import FlightOptions
from dtsa_bench.flights.progress import FlightProgress, ProgressLine
from dtsa_bench.flights.recorded_channel import BAG, RecordedFlight
from dtsa_bench.flights.supervisor import RealtimeSupervisor
from dtsa_bench.pages.view.process import PageOptions, view_process
from dtsa_bench.runs.config import LOCKSTEP, RunConfig
from dtsa_bench.runs.metrics import FlightMetrics
from dtsa_bench.runs.options import new_directory, whole_number
from dtsa_bench.runs.program import end_process, program
from dtsa_channel_sim.ros.channel_node import declare_channel
from dtsa_channel_sim.ros.observer import ChannelObserver
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

from .ground_station import GroundStation
from .mission_record import MISSION_BAG
from .places import APART_M, MissionError, check_places

RECORDER_END_S = 30.0  # it gives way to all others
BRIDGE_END_S = 40.0  # s, to land by itself and close the links


class MissionWatch(ChannelObserver):
    """Ends the exchange: at once when the bridge has died, else when all have come to rest, apart from each other.

    Two that are as near as in a crash end it, too, if there are metrics: a run that ended by itself would not let all
    come to rest. True once it is over; until then the agents avoid each other.
    """

    def __init__(self, mission: GroundStation, channel: RealtimeChannel, metrics: FlightMetrics | None) -> None:
        self._mission, self._channel, self._metrics = mission, channel, metrics

    def idle(self, slot: int, awaited: list[int]) -> None:
        self._mission.check_bridge_process()
        ended, metrics = self._mission.ended, self._metrics
        if metrics is not None and metrics.collided_pair and not ended.reason:
            a, b = metrics.collided_pair
            distance, limit = metrics.closest()[0], metrics.run.limits.collision_m
            ended.reason = f"cf{a} and cf{b} came within {distance:.2f} m of each other (collision_m is {limit:g})"

    def __bool__(self) -> bool:
        ended = self._mission.ended
        return bool(ended) and (is_urgent(ended.stop) or self._mission.at_rest(self._apart))

    def _apart(self) -> bool:
        places = np.array([self._channel.last_place(agent)[:2] for agent in range(1, self._channel.agents + 1)])
        gaps = np.linalg.norm(places[:, None] - places, axis=2) + np.diag(np.full(len(places), np.inf))
        return bool(gaps.min() >= APART_M)


class _Mission:
    """One mission: its processes, and the one order in which they end; `attach`: a bridge runs already, and goes on."""

    def __init__(
        self, run: RunConfig, settings: SwarmSettings, directory: Path, environment: dict[str, str], stop: Stop,
        attach: bool,
    ) -> None:  # fmt: skip
        self.run, self.settings, self.directory, self.attach = run, settings, directory, attach
        self.ended, self.context, self.progress = StopToken(stop), Context(), ProgressLine("fly")
        self.bridge, self.agents, self.recorder = (Children(directory / "log", environment) for _ in range(3))
        self.ground: GroundStation | None = None

    def start(self, swarm_yaml: Path) -> None:
        """Start the recorder, and the bridge unless there is one."""
        robots = [robot.name for robot in self.settings.robots]
        arguments = ["--bag", str(self.directory / MISSION_BAG), "--names", *robots]
        self.recorder.start("recorder", [], "dtsa_bench.crazyflies.missions.mission_record", arguments)
        if not self.attach:
            arguments = ["--ros-args", "-p", f"config:={swarm_yaml.resolve()}"]
            self.bridge.start("bridge", [], "dtsa_agent.crazyflie.node.bridge_node", arguments)

    def take_off(self, scenario: Scenario, domain: int) -> GroundStation:
        """Connect all vehicles, start the agents, and bring the vehicles into the air, at their places.

        Nothing of ours keeps the bridge waiting: it runs before all others, on a processor of its own, and what takes
        a processor for seconds, as the start of the agents' process does, is over before a motor turns.
        """
        avoid_last_processor()
        init_ros(QUIET, self.context, domain)
        node = Node("mission", context=self.context, enable_rosout=False, start_parameter_services=False)
        check, priority = None if self.attach else self.bridge.check, self.settings.station.priority
        ground = GroundStation(node, self.settings, scenario, self.ended, self.progress.show, check)
        self.ground = ground
        set_realtime(below(priority, 1))
        swarm = ground.connect(self.run.swarm)
        if swarm != self.run.swarm:
            self.progress.print_line(f"not where they would begin: exchange of roles, places {swarm.places}")
            self.run = dataclasses.replace(self.run, swarm=swarm)
        self.progress.show("agents")
        safety = self.settings.station.safety
        own = {
            "command_hz": float(max(robot.command_rate_hz for robot in self.settings.robots)),
            "priority": below(priority, 2),
            "vehicles": " ".join(robot.name for robot in self.settings.robots),
            "origin": list(self.settings.station.room_origin_in_world),
            "fence": safety.geofence, "fence_min": list(safety.geofence_min), "fence_max": list(safety.geofence_max),
        }  # fmt: skip
        arguments = parameter_arguments(self.directory, to_parameters(swarm.to_dict(), SwarmConfig) | own)
        ids = list(range(1, swarm.agents + 1))
        self.agents.start("agents", ids, "dtsa_agent.crazyflie.node.agents_node", arguments)
        ground.wait_for_agents(self.agents.check)
        ground.take_off()
        return ground

    def exchange(self, ground: GroundStation, options: FlightOptions) -> Flight:
        """The exchange of places, and the landing; its results."""
        ended, limits = self.ended, self.run.limits
        run = dataclasses.replace(self.run, limits=dataclasses.replace(limits, stop_on_crash=False))
        node = Node("channel", namespace=names.SWARM, context=self.context)
        try:
            declare_channel(node, run.air)
            flight = RecordedFlight(node, run, self.directory, options.startup_s, answer_s=2.0, end_s=END_S)
            channel, measurement = flight.channel, flight.measurement
            assert isinstance(channel, RealtimeChannel)
            shown = FlightProgress(self.progress, measurement, channel)
            watch = MissionWatch(ground, channel, measurement.metrics if limits.stop_on_crash else None)
            processes = RealtimeSupervisor(self.agents, channel, measurement, self.progress.print_line)
            channel.observe(watch, processes, shown)
            try:
                channel.run(watch)
                ended.reason = ended.reason or channel.fell_behind
                shown.show()
            except (NodeError, MissionError) as error:  # the bridge has died: what was flown is there all the same
                ended.reason = str(error)
            finally:
                channel.close()
                self.progress.end()
            ground.land(self._find_urgent())  # first: what follows takes seconds
            self.agents.stop()
            set_ordinary_thread()  # the bridge does not: it has to watch them
            summary = flight.write_results(
                options.pictures and not ended, backend="cflib", cut_short=ended.reason, not_landed=ground.not_landed,
                vehicles=ground.log.diagnostics,
            )  # fmt: skip
            return Flight(summary, flight.scenario, measurement.positions.array(), self.directory / BAG)
        finally:
            node.destroy_node()

    def _find_urgent(self) -> Callable[[], bool]:
        """Return what says whether all motors are to stop: after a second Ctrl-C, or, while they land, the first."""
        stop, before = self.ended.stop, self.ended.stop.interrupts
        return lambda: is_urgent(stop) or stop.interrupts > before

    def end(self) -> None:
        """All land; then agents and bridge end, then the recorder closes its bag."""
        if self.ground is not None:
            self.ground.land(self._find_urgent())
            self.ground.close()
        self.agents.stop()
        try:
            if not self.attach:
                child = self.bridge.all[0]  # it lands all that may still fly, then closes its links
                if self.ground is not None and self.ground.not_landed:  # a further Ctrl-C is meant for it
                    signal.signal(signal.SIGINT, lambda number, _: child.process.send_signal(number))
                if not end_process(child.process, BRIDGE_END_S):
                    raise MissionError(f"{describe_end(child)}: it did not end by itself")
        finally:
            end_process(self.recorder.all[0].process, RECORDER_END_S)
            bag = self.directory / MISSION_BAG
            if not (bag / "metadata.yaml").is_file():
                self.progress.print_line(
                    f"the recorder did not close {bag}: `{program()} recover {bag}` saves what it holds"
                )
            if self.ground is not None:
                self.ground.log.write(self.directory, self.ended.reason)
        self.progress.end()
        self.context.try_shutdown()


def fly_crazyflies(
    run: RunConfig, settings: SwarmSettings, swarm_yaml: Path, out: str | Path, options: FlightOptions, stop: Stop, *,
    attach: bool = False, page: PageOptions | None = None,
) -> Flight:  # fmt: skip
    """One mission. When this returns or raises, all have landed (or were stopped) and no process is left.

    :param settings: the swarm's YAML, read; `swarm_yaml` is its path.
    :param attach: by the bridge that runs already on this ROS domain, and goes on running.
    :param page: shows the mission in a browser; None: nothing does.
    :raises ConfigError: before anything has been started.
    :raises DtsaError: something failed before the exchange began, or a node died.
    """
    if run.mode == LOCKSTEP:
        raise ConfigError("mode", run.mode, "realtime: vehicles do not wait for the agents")
    check_key(run.swarm)
    check_slotted(run.swarm.policy)
    require_cflib()
    scenario = check_places(settings, run.swarm)
    shared = attach or settings.station.positions.enabled
    wanted = options.domain
    if wanted is None and shared:  # that of the bridge, or of motion capture
        wanted = whole_number(os.environ.get("ROS_DOMAIN_ID") or "0", "ROS_DOMAIN_ID", 0, LAST_DOMAIN)
    with ros_domain(wanted, shared=shared) as domain, ExitStack() as shown:
        directory = new_directory(out)
        (directory / "log").mkdir()
        environment = run_environment(domain, directory / "log")
        if page is not None:
            shown.enter_context(view_process(domain, environment, page))
        mission = _Mission(run, settings, directory, environment, stop, attach)
        mission.start(swarm_yaml)
        try:
            return mission.exchange(mission.take_off(scenario, domain), options)
        except DtsaError as error:
            mission.ended.reason = mission.ended.reason or str(error)
            raise
        finally:
            mission.end()


def below(priority: int, steps: int) -> int:
    """A real-time priority below the bridge's; 0: none."""
    return max(priority - steps, min(priority, 1))
