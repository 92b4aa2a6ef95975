"""``ros2 run dtsa_channel_sim channel``: the radio channel as a node, without a recorder.

It runs until SIGINT or SIGTERM, or for a given number of slots, in lockstep or in real time. `recorded_channel` of
dtsa_bench adds the recording, the metrics and the end of a flight.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import setting, settings_of
from dtsa_agent.ros.common.graph.names import MODES
from dtsa_agent.ros.common.graph.namespaces import swarm_wide_node
from dtsa_agent.ros.common.graph.parameters import declare_settings, from_parameter
from dtsa_agent.ros.common.process.loop import Stop
from dtsa_agent.ros.common.process.node_process import run_node
from dtsa_agent.ros.common.process.priority import PrioritySettings, take_priority
from dtsa_agent.ros.common.workarounds.kept_nodes import ending
from dtsa_channel_sim.model.channel import Channel
from dtsa_channel_sim.model.config import CHANGEABLE, ChannelConfig
from dtsa_channel_sim.model.schedule import Change

from .answer_limits import AnswerLimits
from .diagnostics import Diagnostics
from .lockstep import LockstepChannel
from .observer import SlotLimit
from .realtime_channel import RealtimeChannel
from .ros_channel import RosChannel
from .run_log import RunLog
from .run_topics import RunTopics
from .transforms import Transforms


def declare_channel(node: Node, config: ChannelConfig | None = None) -> dict[str, Any]:
    """Declares the channel's settings as parameters and reads them.

    :param node: the node.
    :param config: settings that are the parameters' defaults.
    :raises ConfigError: for values that are not allowed.
    """
    defaults = {} if config is None else {**config.to_dict(), "losses": str(config.losses)}  # their name
    return declare_settings(node, ChannelConfig, changeable=True, defaults=defaults)


def follow_parameters(node: Node, channel: Channel, changed: Callable[[Change], None] | None = None) -> None:
    """Lets ``ros2 param set`` change the channel in flight, from the next slot on.

    :param node: the node, with the parameters of :func:`declare_channel`.
    :param channel: the channel.
    :param changed: is told each change.
    """
    known = {setting.name: setting for setting in settings_of(ChannelConfig) if setting.name in CHANGEABLE}

    def apply(parameters: list[Parameter]) -> SetParametersResult:
        values = {p.name: from_parameter(known[p.name], p.value) for p in parameters if p.name in known}
        if values:
            try:
                change = channel.set(**values)
            except ConfigError as error:
                return SetParametersResult(successful=False, reason=str(error))
            if changed:
                changed(change)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(apply)


@dataclass(frozen=True, slots=True)
class ChannelNodeSettings(AnswerLimits):
    """What the channel's node needs beside the channel's settings.

    :raises ConfigError: for values that are not allowed.
    """

    slots: int = setting(0, "the run ends after so many slots; 0: by a signal only", minimum=0, maximum=2**31)
    mode: str = setting(
        MODES[0],
        "in lockstep all wait for each other; in real time each agent has a clock of its own",
        choices=MODES,
    )
    steps: int = setting(1, "control instants in a slot, as the agents have", minimum=1, maximum=255)


def watch(channel: RosChannel, node: Node, settings: Mapping[str, Any], space: str) -> None:
    """Lets everybody on the graph know how a run is doing: topics, diagnostics, transforms, the log.

    :param channel: the channel.
    :param node: its node.
    :param settings: the settings of the run by section.
    :param space: namespace of the swarm's topics.
    """
    lockstep = isinstance(channel, LockstepChannel)
    channel.observe(
        RunLog(node, channel.run_id, lockstep),
        RunTopics(node, settings, channel.run_id, channel.slot_ns, space),
        Diagnostics(node, channel.slot_ns),
        Transforms(node, channel.agents, channel.slot_ns, space),
    )


def _body(stop: Stop, supervised: bool) -> None:
    node, space = swarm_wide_node("channel")
    with ending(node):
        values = declare_channel(node, ChannelConfig(agents=12))
        run = ChannelNodeSettings(**declare_settings(node, ChannelNodeSettings))
        config = ChannelConfig.from_dict(values)
        first = PrioritySettings(**declare_settings(node, PrioritySettings)).priority
        medium, referee = Channel(config), SlotLimit(run.slots)
        kind = LockstepChannel if run.mode == MODES[0] else RealtimeChannel
        channel = kind(
            node, medium, run.steps, run.answer_s, referee=referee, startup_s=run.startup_s, swarm_namespace=space
        )
        try:
            watch(channel, node, {"mode": run.mode, "channel": config.to_dict()}, space)
            follow_parameters(node, medium, channel.change_settings)
            if run.mode != MODES[0]:
                take_priority(first)
            channel.run(stop)
        finally:
            channel.close()


def main(args: Sequence[str] | None = None) -> int:
    """Runs the node."""
    return run_node("channel", _body, args)


if __name__ == "__main__":
    sys.exit(main())
