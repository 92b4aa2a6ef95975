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
SECTIONS = ((SwarmConfig, ""), (ChannelConfig, ""), (RunLimits, ""), (ClockConfig, CLOCKS))
MORE = {  # default, choices, description
    "processes": ("per-agent", None, "per-agent, or a number of processes"),
    "mode": (MODES[0], MODES, "lockstep: all wait for each other; realtime: each agent has a clock of its own"),
    "align": ("true", ["true", "false"], "real time: agents align their clocks"),
    "swarm_namespace": (
        names.SWARM, None, "namespace of the swarm's topics; agents are in it unless it is the default",
    ),
    "priority": (
        str(FlightOptions().priority), None,
        "real time: real-time priority of the agents, one more for the channel, where allowed; 0: none",
    ),
    "out": ("flight", None, "new directory for the bag and the results"),
    "channel_file": ("", None, "YAML file with settings of the channel"),
}  # fmt: skip


def _settings(cls: type) -> list:
    left_out = FROM_SWARM if cls is ChannelConfig else ()
    return [s for s in settings_of(cls) if s.kind != "structure" and s.name not in left_out]


def _given(context: LaunchContext, cls: type, prefix: str = "") -> dict:
    """Settings from the launch arguments that were given."""
    given = ((s, LaunchConfiguration(prefix + s.name).perform(context)) for s in _settings(cls))
    return {s.name: text if s.kind == "values" else s.parse(text) for s, text in given if text != UNSET}


def _run_config(swarm: SwarmConfig, channel: dict, clocks: dict, more: dict) -> RunConfig:
    """The run as far as the agents' parameters depend on it.

    :raises ConfigError: for settings that are not usable.
    """
    file, values = more["channel_file"], {**channel, **from_swarm(swarm)}
    air = ChannelConfig.from_yaml(file, **values) if file else ChannelConfig.from_dict(values)
    return RunConfig(swarm, air, mode=more["mode"], clocks=ClockConfig(**clocks), align=more["align"] == "true")


def _nodes(context: LaunchContext) -> list[Node]:
    swarm, channel, limits, clocks = (_given(context, cls, prefix) for cls, prefix in SECTIONS)
    more = {name: LaunchConfiguration(name).perform(context) for name in MORE}
    config = SwarmConfig.from_dict({key: value for key, value in swarm.items() if key != "options"})
    run = _run_config(config, channel, clocks, more)
    space = "/" + more["swarm_namespace"].strip("/")
    priority = whole_number(more["priority"], "priority", 0, 90)
    recorded = {
        **swarm, **channel, **limits, **{CLOCKS + name: value for name, value in clocks.items()},
        "mode": run.mode, "align": run.align, "priority": priority and priority + 1, "out": more["out"],
        "channel_file": more["channel_file"],
    }  # fmt: skip
    if "partition" in recorded:  # JSON: launch would make a list of lists of it, which no parameter can be
        recorded["partition"] = ParameterValue(recorded["partition"], value_type=str)
    over = Shutdown(reason="the flight is over")
    channel_node = Node(
        package="dtsa_bench", executable="recorded_channel", namespace=space, name="channel", parameters=[recorded],
        output="screen", on_exit=over,
    )  # fmt: skip
    processes = agent_processes(run, process_count(more["processes"], config.agents), priority, space)
    return [channel_node, *(
        Node(
            package="dtsa_agent", executable=process.executable, namespace=process.namespace, name=process.node,
            parameters=[{**swarm, "mode": run.mode, "swarm_namespace": space, **process.parameters}], output="screen",
        )
        for process in processes
    )]  # fmt: skip


def generate_launch_description() -> LaunchDescription:
    """Arguments and processes, for ``ros2 launch``."""
    described = [
        DeclareLaunchArgument(prefix + s.name, default_value=UNSET, description=f"{s.description} [{s.default}]")
        for cls, prefix in SECTIONS
        for s in _settings(cls)
    ]
    described += [
        DeclareLaunchArgument(name, default_value=default, choices=choices, description=text)
        for name, (default, choices, text) in MORE.items()
    ]
    return LaunchDescription([*described, OpaqueFunction(function=_nodes)])
