"""The channel with a recorder and the metrics in one process: what makes a run of nodes a recorded flight."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dtsa_msgs.msg import Decision, Reception, Transmission
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from dtsa_agent.core import Scenario, SwarmConfig, make_scenario
from dtsa_agent.core.settings import settings_of
from dtsa_agent.ros.common import names
from dtsa_agent.ros.common.loop import Stop
from dtsa_agent.ros.common.parameters import declare_from_dataclass
from dtsa_agent.ros.common.process import run_node
from dtsa_bench.bag.cdr import (
    COLLIDED,
    QUIET,
    SENDING,
    WAITING,
    MarkerPacker,
)
from dtsa_bench.clock_statistics import ClockStatistics
from dtsa_bench.flight_recorder import FlightRecorder
from dtsa_bench.metrics import FlightMetrics, metrics_tables
from dtsa_bench.options import FROM_SWARM, new_directory
from dtsa_bench.run_config import LOCKSTEP, RunConfig, RunLimits
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.verdict import COLLISION, Verdict
from dtsa_channel_sim.ros.answers import Answers
from dtsa_channel_sim.ros.channel_node import ChannelStatus, declare_limits, follow_parameters
from dtsa_channel_sim.ros.lockstep import LockstepChannel
from dtsa_channel_sim.ros.realtime_channel import RealtimeChannel

BAG = "bag"  # the bag's directory within a flight's directory
_MARKER_PERIOD_S = 0.04  # wall time, where somebody watches
_MARKER_RECORD_NS = 100_000_000  # simulated time, in the bag


class RecordedFlight:
    """What makes a channel record the flight, measure it and know when it is over; mixed into a channel's class.

    :param node: the ROS node.
    :param run: the run.
    :param directory: the flight's directory; the bag becomes a directory in it.
    :param more: passed on to the channel.
    """

    # What the channel's class has.
    agents: int
    slot: int
    slot_ns: int
    unusable: int
    channel: Channel
    answers: Answers

    def __init__(self, node: Node, run: RunConfig, directory: Path, **more: Any) -> None:
        self.run_config = run
        self.scenario: Scenario = make_scenario(run.swarm)
        self.metrics = FlightMetrics(run, self.scenario)
        self.positions: list[NDArray[np.float64]] = []  # (3, N) m, at each slot's start
        self.begin_s = self.end_s = 0.0  # wall clock: slot 0 answered by all, flight over
        self._tables = metrics_tables(run, self.scenario, everyone=True)
        self._oracle = run.swarm.estimator == "oracle"
        self._outcome = 0
        self._views = self._tables.digest, self._tables.chosen  # of the slot that is being flown
        self._next_markers = 0.0
        self._marker_slots = max(1, round(_MARKER_RECORD_NS / run.swarm.slot_ns))
        super().__init__(node, Channel(run.air), run.swarm.steps, **more)  # type: ignore[call-arg]
        self._status = ChannelStatus(node)
        self._watching = [
            node.create_publisher(kind, f"{names.SWARM}/{topic}", 10)
            for kind, topic in ((Decision, names.DECISION), (Reception, names.RECEPTION), (MarkerArray, names.MARKERS))
        ]
        self._watched = [False, False, False]
        self._markers = MarkerPacker([f"cf{agent}" for agent in range(1, self.agents + 1)])
        self.recorder = FlightRecorder(directory / BAG, run)
        follow_parameters(node, self.channel, self.recorder.channel_changed)

    @property
    def wall_time_s(self) -> float:
        """Wall-clock time of the flight so far, s."""
        return (self.end_s or time.monotonic()) - self.begin_s if self.begin_s else 0.0

    def published(self, slot: int, data: bytes, time_ns: int) -> None:
        self.recorder.opened(slot, data, time_ns)

    def received(self, slot: int, ids: bytes, data: bytes) -> None:
        self.recorder.answer(slot, ids, data)

    def answered(self, slot: int, answers: Answers) -> bool:
        self.recorder.complete(slot)
        self.positions.append(answers.position.copy())
        if not slot:
            self.begin_s = time.monotonic()
            return True
        self.metrics.compare_views(slot - 1, *self._views)
        if self._oracle:
            self._tables.estimate_position[:] = answers.position
        if not self.metrics.update(slot - 1, answers.track, self._tables, self._outcome):
            return True
        self.end_s = time.monotonic()
        return False

    def judged(self, slot: int, frames: dict[int, bytes], verdict: Verdict) -> None:
        self._outcome = verdict.outcome
        self._views = self.answers.digest.copy(), self.answers.chosen.copy()
        self._status.counts[verdict.outcome] += 1
        self.scenario.advance(slot, self._tables)  # what all know about each other's goals
        if verdict.senders:
            mask = verdict.mask(self.agents)
            for row, sender in enumerate(verdict.senders):
                if mask[row].any():
                    self._tables.hear(slot, frames[sender], mask[row])
        self._tables.end(slot)

    def recorded(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        recorder = self.recorder
        recorder.write(slot, answers, verdict)
        if self._watched[0]:
            self._watching[0].publish(recorder.decision)
        if self._watched[1]:
            self._watching[1].publish(recorder.reception)
        kept = slot % self._marker_slots == 0
        watched = self._watched[2] and time.monotonic() >= self._next_markers
        if not kept and not watched:
            return
        state = np.where(self.scenario.moving, WAITING, QUIET).astype(np.uint8)
        state[[sender - 1 for sender in verdict.senders]] = COLLIDED if verdict.outcome == COLLISION else SENDING
        data = self._markers.pack(recorder.time_ns(slot), answers.position, state, answers.goal)
        if kept:
            recorder.show(slot, data)
        if watched:
            self._next_markers = time.monotonic() + _MARKER_PERIOD_S
            self._watching[2].publish(data)

    def idle(self) -> None:
        self._watched = [publisher.get_subscription_count() > 0 for publisher in self._watching]
        self._status.tick(self.slot, self.unusable, self.answers.silent if self.answers.missing else [])

    def close(self) -> None:
        """Finishes the bag first, whatever the rest does."""
        self.end_s = self.end_s or (time.monotonic() if self.begin_s else 0.0)
        try:
            self.recorder.close()
        finally:
            super().close()  # type: ignore[misc]

    def summary(self) -> dict[str, Any]:
        """The flight's results."""
        result = self.metrics.summary(self.wall_time_s)
        result["unusable_messages"] = self.unusable
        return result


class RecordedChannel(RecordedFlight, LockstepChannel):
    """A lockstep channel with a recorder."""


class RealtimeRecordedChannel(RecordedFlight, RealtimeChannel):
    """A channel in real time with a recorder."""

    def __init__(self, node: Node, run: RunConfig, directory: Path, **more: Any) -> None:
        super().__init__(node, run, directory, **more)
        self.clocks = ClockStatistics(self.agents)

    def reported(self, message: Transmission) -> None:
        self.clocks.report(message.slot, message.agent, message.offset_ns, message.length)

    def silent(self, agent: int) -> None:
        self.metrics.lose(agent)

    def back(self, agents: list[int]) -> None:
        for agent in agents:
            self.metrics.regain(agent)

    def summary(self) -> dict[str, Any]:
        """The flight's results."""
        counts = {
            "late_frames": self.arbiter.late,
            "missed_reports": self.missed,
            "returned_agents": sorted(self.returned),
        }
        return {**super().summary(), "mode": "realtime", **counts, **self.clocks.summary()}


def recorded_channel_class(run: RunConfig) -> type[RecordedFlight]:
    """The class of channel that a run needs."""
    return RecordedChannel if run.mode == LOCKSTEP else RealtimeRecordedChannel


def write_results(channel: RecordedFlight, directory: Path, pictures: bool = True) -> dict[str, Any]:
    """Writes ``summary.json`` and ``trajectories.png`` of a flight.

    :param channel: the channel, closed.
    :param directory: the flight's directory.
    :param pictures: whether the picture is drawn.
    :returns: the summary.
    """
    summary = channel.summary()
    text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
    (directory / "summary.json").write_text(text, encoding="utf-8")
    if channel.positions and pictures:
        from dtsa_bench.trajectories import draw_flight

        draw_flight(
            directory / "trajectories.png", channel.run_config, channel.scenario, np.array(channel.positions), summary
        )
    return summary


def declare_run(node: Node) -> RunConfig:
    """Declares all settings of a run as parameters and reads them.

    :raises ConfigError: for settings that are not usable.
    """
    swarm = SwarmConfig.from_dict(declare_from_dataclass(node, SwarmConfig))
    channel = declare_from_dataclass(node, ChannelConfig, skip=FROM_SWARM, changeable=True)
    described = ParameterDescriptor(description="YAML file with further settings of the channel", read_only=True)
    file = node.declare_parameter("channel_file", "", described).value
    derived = {"agents": swarm.agents, "slot_ns": swarm.slot_ns, "seed": swarm.seed}
    if file:
        defaults = {spec.name: spec.default for spec in settings_of(ChannelConfig)}
        given = {name: value for name, value in channel.items() if value != defaults[name]}
        air = ChannelConfig.from_yaml(file, **given, **derived)
    else:
        air = ChannelConfig.from_dict({**channel, **derived})
    return RunConfig(swarm, air, RunLimits(**declare_from_dataclass(node, RunLimits)))


def _body(stop: Stop, supervised: bool) -> None:
    node = Node("channel", namespace=names.SWARM)
    try:
        run = declare_run(node)
        where = ParameterDescriptor(description="directory for the bag and the results", read_only=True)
        directory = new_directory(node.declare_parameter("out", "flight", where).value)
        startup_s, answer_s = declare_limits(node)
        channel = RecordedChannel(node, run, directory, startup_s=startup_s, answer_s=answer_s)
        try:
            channel.run(stop)
        finally:
            channel.close()
        node.get_logger().info(f"flight {write_results(channel, directory)['end']}; results in {directory}")
    finally:
        node.destroy_node()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node ``recorded_channel``."""
    return run_node("recorded_channel", _body, args)


if __name__ == "__main__":
    sys.exit(main())
