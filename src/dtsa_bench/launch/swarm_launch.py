"""A recorded flight: the channel with its recorder, and the agents, each in its namespace.

``ros2 launch dtsa_bench swarm_launch.py agents:=12 policy:=dtsa loss:=0.05 out:=flight_1``

Every setting of the swarm, the channel and the end of a run is a launch argument; ``--show-args`` lists them. When the
flight is over the agents end by themselves, and so does the launch; if the channel fails, the agents are ended.
"""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings import settings_of
from dtsa_bench.run_config import FROM_SWARM, RunLimits
from dtsa_channel_sim import ChannelConfig

UNSET = ""  # the node's own default


def _settings(cls: type) -> list:
    return [
        s
        for s in settings_of(cls)
        if s.kind != "structure" and s.name not in (FROM_SWARM if cls is ChannelConfig else ())
    ]


def _given(context: LaunchContext, cls: type) -> dict:
    """Parameters from the launch arguments that were given."""
    values = {}
    for setting in _settings(cls):
        text = LaunchConfiguration(setting.name).perform(context)
        if text != UNSET:
            values[setting.name] = text if setting.kind == "values" else setting.parse(text)
    return values


def _nodes(context: LaunchContext) -> list[Node]:
    swarm = _given(context, SwarmConfig)
    config = SwarmConfig.from_dict({key: value for key, value in swarm.items() if key != "options"})
    processes = LaunchConfiguration("processes").perform(context)
    run = {
        **swarm,
        **_given(context, ChannelConfig),
        **_given(context, RunLimits),
        "out": LaunchConfiguration("out").perform(context),
        "channel_file": LaunchConfiguration("channel_file").perform(context),
    }
    nodes = [
        Node(
            package="dtsa_bench",
            executable="recorded_channel",
            namespace="swarm",
            name="channel",
            parameters=[run],
            output="screen",
            on_exit=Shutdown(reason="the flight is over"),
        )
    ]
    if processes == "per-agent":
        nodes += [
            Node(
                package="dtsa_agent",
                executable="agent",
                namespace=f"cf{agent}",
                name="agent",
                parameters=[{**swarm, "id": agent}],
                output="screen",
            )
            for agent in range(1, config.agents + 1)
        ]
        return nodes
    if not processes.isdecimal() or not 1 <= int(processes) <= config.agents:
        raise ConfigError("processes", processes, f"per-agent, or 1 to {config.agents}, the number of agents")
    count = int(processes)
    bounds = [config.agents * index // count for index in range(count + 1)]
    nodes += [
        Node(
            package="dtsa_agent",
            executable="swarm_host",
            namespace="swarm",
            name=f"swarm_host_{index + 1}",
            parameters=[{**swarm, "ids": list(range(bounds[index] + 1, bounds[index + 1] + 1))}],
            output="screen",
        )
        for index in range(count)
    ]
    return nodes


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` asks for."""
    arguments = [
        DeclareLaunchArgument(
            setting.name, default_value=UNSET, description=f"{setting.description} [{setting.default}]"
        )
        for cls in (SwarmConfig, ChannelConfig, RunLimits)
        for setting in _settings(cls)
    ]
    arguments += [
        DeclareLaunchArgument(
            "processes", default_value="per-agent", description="per-agent, or a number of processes"
        ),
        DeclareLaunchArgument(
            "mode",
            default_value="lockstep",
            choices=["lockstep"],
            description="lockstep; for flights in real time: tools/dtsa fly --mode realtime",
        ),
        DeclareLaunchArgument("out", default_value="flight", description="new directory for the bag and the results"),
        DeclareLaunchArgument("channel_file", default_value="", description="YAML file with settings of the channel"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])
