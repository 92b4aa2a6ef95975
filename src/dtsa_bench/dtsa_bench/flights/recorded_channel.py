"""The channel with a recorder and the metrics in one process: what makes a run of nodes a recorded flight."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.node import Node

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.core.settings.config import agreed_settings
from dtsa_agent.core.settings.declaration import Setting, settings_of
from dtsa_agent.core.station import longest_wait_ns
from dtsa_agent.keys import check_key
from dtsa_agent.priority import PrioritySettings, set_realtime
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.node_process import ending, run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_setting, declare_settings, swarm_wide_node
from dtsa_agent.ros.common.runs import Run
from dtsa_agent.stop import Stop
from dtsa_bench.drawing import optional_picture
from dtsa_bench.runs.config import FROM_SWARM, LOCKSTEP, RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.options import new_directory
from dtsa_channel_sim import Channel, ChannelConfig, ClockConfig
from dtsa_channel_sim.model.config import AnswerLimits
from dtsa_channel_sim.ros.channel_node import follow_parameters, watch
from dtsa_channel_sim.ros.lockstep import LockstepChannel
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

from .measurement import FlightMeasurement, TimingStatistics, channel_summary, warning
from .recorder import FlightRecorder
from .slot_messages import LiveTopics

BAG = "bag"  # the bag's directory within a flight's directory


class RecordedFlight:
    """A channel, and those that observe it in a recorded flight; its settings are parameters of the node.

    :param directory: the flight's directory; the bag becomes a directory in it.
    :param space: namespace of the swarm's topics; those in the bag have the default one.
    """

    def __init__(
        self, node: Node, run: RunConfig, directory: Path, startup_s: float, answer_s: float, end_s: float = 4.0,
        space: str = names.SWARM,
    ) -> None:  # fmt: skip
        identity = Run.draw(run.swarm.auth_session)
        agreed = agreed_settings(run.swarm, run.mode)
        if run.swarm.auth:  # the bag says in which session its frames are authentic
            run = replace(run, swarm=replace(run.swarm, auth_session=identity.session))
        self.run_config, self.directory = run, directory
        self.scenario = make_scenario(run.swarm)
        self.measurement = FlightMeasurement(run, self.scenario)
        model, steps, over = Channel(run.air), run.swarm.steps, self.measurement.over
        self.run_id = identity.number
        limits: dict[str, Any] = {
            "startup_s": startup_s, "end_s": end_s, "run": identity, "agreed": agreed, "swarm_namespace": space,
        }  # fmt: skip
        self.channel: LockstepChannel | RealtimeChannel = (
            LockstepChannel(node, model, steps, answer_s, over=over, **limits)
            if run.mode == LOCKSTEP
            else RealtimeChannel(node, model, steps, over=over, **limits)
        )
        self._timing = TimingStatistics(run.swarm.agents, longest_wait_ns(run.swarm))
        # The recorder comes first: whatever happens to the others, the bag is complete.
        self.channel.observe(
            FlightRecorder(directory / BAG, run, self.scenario, self.channel, self._timing),
            self.measurement,
            LiveTopics(node, self.scenario, run.swarm.slot_ns, self.run_id, space),
        )
        watch(self.channel, node, run.to_dict(), space)
        if run.mode != LOCKSTEP:
            self.channel.observe(self._timing)
        follow_parameters(node, self.channel)

    def summary(self) -> dict[str, Any]:
        """The flight's results."""
        channel = self.channel
        hearing, refused = self.measurement.hearing, dict(sorted(channel.dropped().items()))
        hearing.subtract_refused(refused)
        result = {
            **self.measurement.summary(),
            "unusable_messages": channel.intake.counts.total(),
            "not_taken_in": refused,
            "receptions": {"delivered": hearing.delivered, "taken_in": hearing.accepted},
            "unheard": hearing.problem(refused) or None,
        }
        if isinstance(channel, RealtimeChannel):
            result |= {
                "mode": self.run_config.mode,
                "returned_agents": sorted(channel.returned),
                **channel_summary(channel),
                **self._timing.summary(),
            }
            result["warning"] = warning(channel, self._timing.as_due_share, result)
        return result

    def write_results(self, pictures: bool = True, **more: Any) -> dict[str, Any]:
        """Writes ``summary.json`` and ``trajectories.png``; the channel is closed."""
        summary = {**self.summary(), **more}
        text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
        (self.directory / "summary.json").write_text(text, encoding="utf-8")
        path = self.measurement.positions.array()
        if len(path) and pictures:
            with optional_picture(self.directory / "trajectories.png") as picture:
                from dtsa_bench.drawing.flight_paths import draw_flight

                draw_flight(picture, self.scenario, path, summary)
        return summary


def declare_run(node: Node) -> RunConfig:
    """Declare all settings of a run as parameters and read them; ConfigError: they are not usable."""
    swarm = SwarmConfig.from_dict(declare_settings(node, SwarmConfig))
    channel = declare_settings(node, ChannelConfig, skip=FROM_SWARM, changeable=True)
    file = declare_setting(node, Setting("channel_file", "text", "", "YAML file with further settings of the channel"))
    derived = from_swarm(swarm)
    if file:
        defaults = {spec.name: spec.default for spec in settings_of(ChannelConfig)}
        given = {name: value for name, value in channel.items() if value != defaults[name]}
        air = ChannelConfig.from_yaml(file, **given, **derived)
    else:
        air = ChannelConfig.from_dict({**channel, **derived})
    limits = RunLimits(**declare_settings(node, RunLimits))
    clocks = ClockConfig(**declare_settings(node, ClockConfig, prefix="clocks."))
    own = {spec.name: declare_setting(node, spec) for spec in settings_of(RunConfig) if spec.name in ("mode", "align")}
    return RunConfig(swarm, air, limits, clocks=clocks, **own)


def _body(stop: Stop, supervised: bool) -> None:
    node, space = swarm_wide_node("channel")
    with ending(node):
        run = declare_run(node)
        check_key(run.swarm)
        directory = new_directory(declare_setting(node, Setting("out", "text", "flight", "directory for the results")))
        wait = AnswerLimits(**declare_settings(node, AnswerLimits))
        first = PrioritySettings(**declare_settings(node, PrioritySettings)).priority
        check_parameters(node)
        flight = RecordedFlight(node, run, directory, wait.startup_s, wait.answer_s, space=space)
        try:
            if run.mode != LOCKSTEP:
                set_realtime(first)
            flight.channel.run(stop)
        finally:
            flight.channel.close()
        summary = flight.write_results()
        node.get_logger().info(f"flight {summary['end']}; results in {directory}")
        if summary["unheard"] and not stop:
            raise DtsaError(summary["unheard"])


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node ``recorded_channel``."""
    return run_node("recorded_channel", _body, args)


if __name__ == "__main__":
    sys.exit(main())
