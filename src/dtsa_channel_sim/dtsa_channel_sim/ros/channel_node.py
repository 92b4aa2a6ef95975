"""``ros2 run dtsa_channel_sim channel``: the radio channel as a node, without a recorder.

It runs until SIGINT or SIGTERM, or for a given number of slots, in lockstep or in real time. `recorded_channel` of
dtsa_bench adds the recording, the metrics and the end of a flight.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import setting, settings_of
from dtsa_agent.priority import PrioritySettings, set_realtime
from dtsa_agent.ros.common.names import MODES
from dtsa_agent.ros.common.node_process import ending, run_node
from dtsa_agent.ros.common.parameters import check_parameters, declare_settings, from_parameter, swarm_wide_node
from dtsa_agent.stop import Stop
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.config import CHANGEABLE, AnswerLimits, ChannelConfig

from .lockstep import LockstepChannel
from .realtime_channel import RealtimeChannel
from .ros_channel import RosChannel
from .run_topics import Diagnostics, RunLog, RunTopics, Transforms


def declare_channel(node: Node, config: ChannelConfig | None = None) -> dict[str, Any]:
    """Declare the channel's settings as parameters, with those of ``config`` as defaults, and read them.

    :raises ConfigError: for values that are not allowed.
    """
    defaults = {}
    if config is not None:  # parameters are texts: the name of the losses, the groups as JSON
        groups = json.dumps(config.groups) if config.groups else ""
        defaults = {**config.to_dict(), "losses": str(config.losses), "partition": groups}
    return declare_settings(node, ChannelConfig, changeable=True, defaults=defaults)


def follow_parameters(node: Node, channel: RosChannel) -> None:
    """Let ``ros2 param set`` change the channel in flight, from the next slot on."""
    known = {setting.name: setting for setting in settings_of(ChannelConfig) if setting.name in CHANGEABLE}

    def apply(parameters: list[Parameter]) -> SetParametersResult:
        values = {p.name: from_parameter(known[p.name], p.value) for p in parameters if p.name in known}
        if values:
            try:
                channel.change_settings(**values)
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(apply)


@dataclass(frozen=True, slots=True)
class ChannelNodeSettings(AnswerLimits):
    """What the channel's node needs beside the channel's settings."""

    slots: int = setting(0, "the run ends after so many slots; 0: by a signal only", minimum=0, maximum=2**31)
    mode: str = setting(
        MODES[0], "in lockstep all wait for each other; in real time each agent has a clock of its own", choices=MODES
    )
    steps: int = setting(1, "control instants in a slot, as the agents have", minimum=1, maximum=255)


def watch(channel: RosChannel, node: Node, settings: Mapping[str, Any], space: str) -> None:
    """Tell the graph how a run is doing: topics in the swarm's namespace, diagnostics, transforms, the log."""
    channel.observe(
        RunLog(node, channel.run_id, isinstance(channel, LockstepChannel)),
        RunTopics(node, settings, channel, space),
        Diagnostics(node, channel),
    )
    try:
        channel.observe(Transforms(node, channel.agents, channel.slot_ns, space))
    except ImportError:
        node.get_logger().info("no transforms on /tf: tf2_msgs is not installed (apt: ros-jazzy-tf2-msgs)")


def _body(stop: Stop, supervised: bool) -> None:
    node, space = swarm_wide_node("channel")
    with ending(node):
        values = declare_channel(node, ChannelConfig(agents=12))
        run = ChannelNodeSettings(**declare_settings(node, ChannelNodeSettings))
        config = ChannelConfig.from_dict(values)
        first = PrioritySettings(**declare_settings(node, PrioritySettings)).priority
        check_parameters(node)
        medium = Channel(config)
        kind = LockstepChannel if run.mode == MODES[0] else RealtimeChannel
        channel = kind(
            node, medium, run.steps, run.answer_s, slots=run.slots, startup_s=run.startup_s, swarm_namespace=space
        )
        try:
            watch(channel, node, {"mode": run.mode, "channel": config.to_dict()}, space)
            follow_parameters(node, channel)
            if run.mode != MODES[0]:
                set_realtime(first)
            channel.run(stop)
        finally:
            channel.close()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node."""
    return run_node("channel", _body, args)


if __name__ == "__main__":
    sys.exit(main())
