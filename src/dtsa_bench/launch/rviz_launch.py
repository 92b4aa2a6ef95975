"""RViz with a swarm in it: markers, frames, and a model of each quadcopter.

``ros2 launch dtsa_bench rviz_launch.py agents:=12``
"""

from __future__ import annotations

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dtsa_agent.ros.common import names


def _nodes(context: LaunchContext) -> list[Node]:
    share = Path(get_package_share_directory("dtsa_bench"))
    model = (share / "urdf/quadcopter.urdf").read_text(encoding="utf-8")
    space = "/" + LaunchConfiguration("swarm_namespace").perform(context).strip("/")
    spaces = [names.agent_namespace(k + 1, space) for k in range(int(LaunchConfiguration("agents").perform(context)))]
    clock = [("/clock", names.clock_topic(space))]
    described = {agent: model.replace("${PREFIX}", f"{agent.strip('/')}/") for agent in spaces}
    nodes = [
        Node(
            package="robot_state_publisher", executable="robot_state_publisher", namespace=agent, remappings=clock,
            parameters=[{"robot_description": text, "use_sim_time": True}],
        )
        for agent, text in described.items()
    ]  # fmt: skip
    rviz = Node(
        package="rviz2", executable="rviz2", arguments=["-d", str(share / "rviz/swarm.rviz")],
        parameters=[{"use_sim_time": True}],
        remappings=[*clock, (f"{names.SWARM}/{names.MARKERS}", f"{space}/{names.MARKERS}")],
    )  # fmt: skip
    return [*nodes, rviz]


def generate_launch_description() -> LaunchDescription:
    """Arguments and processes, for ``ros2 launch``."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("agents", default_value="12", description="number of agents"),
            DeclareLaunchArgument("swarm_namespace", default_value=names.SWARM, description="namespace of the swarm"),
            OpaqueFunction(function=_nodes),
        ]
    )
