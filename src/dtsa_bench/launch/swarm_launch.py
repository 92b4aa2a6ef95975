"""A recorded flight: the channel with its recorder, and the agents, each in its namespace.

``ros2 launch dtsa_bench swarm_launch.py agents:=12 policy:=dtsa loss:=0.05 out:=flight_1``
``ros2 launch dtsa_bench swarm_launch.py mode:=realtime policy:=lease swarm_namespace:=/north out:=flight_2``

Every setting of the swarm, the channel, the clocks and the end of a run is a launch argument; ``--show-args`` lists
them. When the flight is over the agents end by themselves, and so does the launch; if the channel fails, the agents are
ended.
"""

from __future__ import annotations

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_agent.ros.common import names
from dtsa_bench.flights.options import FlightOptions, agent_processes, process_count
from dtsa_bench.runs.config import FROM_SWARM, MODES, RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.options import whole_number
from dtsa_channel_sim import ChannelConfig, ClockConfig

UNSET = ""  # the node's own default
CLOCKS = "clocks."  # stands before the names of the clocks' settings


def _settings(cls: type) -> list:
    return [
        s
        for s in settings_of(cls)
        if s.kind != "structure" and s.name not in (FROM_SWARM if cls is ChannelConfig else ())
    ]


def _given_arguments(context: LaunchContext, cls: type, prefix: str = "") -> dict:
    """Settings from the launch arguments that were given."""
    values = {}
    for setting in _settings(cls):
        text = LaunchConfiguration(prefix + setting.name).perform(context)
        if text != UNSET:
            values[setting.name] = text if setting.kind == "values" else setting.parse(text)
    return values


def _run_config(context: LaunchContext, swarm: SwarmConfig, channel: dict) -> RunConfig:
    """The run as far as the agents' parameters depend on it.

    :raises ConfigError: for settings that are not usable.
    """
    file = LaunchConfiguration("channel_file").perform(context)
    values = {**channel, **from_swarm(swarm)}
    air = ChannelConfig.from_yaml(file, **values) if file else ChannelConfig.from_dict(values)
    mode = LaunchConfiguration("mode").perform(context)
    align = LaunchConfiguration("align").perform(context) == "true"
    return RunConfig(
        swarm, air, mode=mode, clocks=ClockConfig(**_given_arguments(context, ClockConfig, CLOCKS)), align=align
    )


def _nodes(context: LaunchContext) -> list[Node]:
    swarm, channel = _given_arguments(context, SwarmConfig), _given_arguments(context, ChannelConfig)
    config = SwarmConfig.from_dict({key: value for key, value in swarm.items() if key != "options"})
    run = _run_config(context, config, channel)
    space = "/" + LaunchConfiguration("swarm_namespace").perform(context).strip("/")
    processes = LaunchConfiguration("processes").perform(context)
    priority = whole_number(LaunchConfiguration("priority").perform(context), "priority", 0, 90)
    recorded = {
        **swarm,
        **channel,
        **_given_arguments(context, RunLimits),
        **{CLOCKS + name: value for name, value in _given_arguments(context, ClockConfig, CLOCKS).items()},
        "mode": run.mode,
        "align": run.align,
        "priority": priority and priority + 1,
        "out": LaunchConfiguration("out").perform(context),
        "channel_file": LaunchConfiguration("channel_file").perform(context),
    }
    if "partition" in recorded:  # JSON: launch would make a list of lists of it, which no parameter can be
        recorded["partition"] = ParameterValue(recorded["partition"], value_type=str)
    nodes = [
        Node(
            package="dtsa_bench",
            executable="recorded_channel",
            namespace=space,
            name="channel",
            parameters=[recorded],
            output="screen",
            on_exit=Shutdown(reason="the flight is over"),
        )
    ]
    nodes += [
        Node(
            package="dtsa_agent",
            executable=process.executable,
            namespace=process.namespace,
            name=process.node,
            parameters=[{**swarm, "mode": run.mode, "swarm_namespace": space, **process.parameters}],
            output="screen",
        )
        for process in agent_processes(run, process_count(processes, config.agents), priority, space)
    ]
    return nodes


def generate_launch_description() -> LaunchDescription:
    """What ``ros2 launch`` asks for."""
    arguments = [
        DeclareLaunchArgument(
            prefix + setting.name, default_value=UNSET, description=f"{setting.description} [{setting.default}]"
        )
        for cls, prefix in ((SwarmConfig, ""), (ChannelConfig, ""), (RunLimits, ""), (ClockConfig, CLOCKS))
        for setting in _settings(cls)
    ]
    arguments += [
        DeclareLaunchArgument(
            "processes", default_value="per-agent", description="per-agent, or a number of processes"
        ),
        DeclareLaunchArgument(
            "mode",
            default_value=MODES[0],
            choices=MODES,
            description="lockstep: all wait for each other; realtime: each agent has a clock of its own",
        ),
        DeclareLaunchArgument(
            "align", default_value="true", choices=["true", "false"], description="real time: agents align their clocks"
        ),
        DeclareLaunchArgument(
            "swarm_namespace",
            default_value=names.SWARM,
            description="namespace of the swarm's topics; agents are in it unless it is the default",
        ),
        DeclareLaunchArgument(
            "priority",
            default_value=str(FlightOptions().priority),
            description="real time: real-time priority of the agents, one more for the channel, where allowed; 0: none",
        ),
        DeclareLaunchArgument("out", default_value="flight", description="new directory for the bag and the results"),
        DeclareLaunchArgument("channel_file", default_value="", description="YAML file with settings of the channel"),
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])
