"""Crazyflies: the bridge alone, for other nodes to fly them; or a whole recorded mission. With simulated ones, too.

``ros2 launch dtsa_bench crazyflie_launch.py config:=swarm.yaml``
``ros2 launch dtsa_bench crazyflie_launch.py config:=swarm.yaml mission:=true out:=mission_1``
``ros2 launch dtsa_bench crazyflie_launch.py config:=swarm_simulated.yaml mission:=true simulated:=true``

The first Ctrl-C lands all, a second one stops all motors. A mission brings its own bridge, agents and channel.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, ExecuteProcess, OpaqueFunction, Shutdown
from launch.events import matches_action
from launch.events.process import SignalProcess
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.crazyflie.settings import load_swarm

LAND_S = "60.0"  # from Ctrl-C until SIGTERM: all land first
DTSA = [sys.executable, "-m", "dtsa_bench"]


def _processes(context: LaunchContext) -> list:
    config = LaunchConfiguration("config").perform(context)
    if not config:
        raise ConfigError("config", config, "the path of a swarm's YAML file")
    load_swarm(Path(config))  # what is wrong with it is said before anything starts
    actions = []
    over = [Shutdown(reason="the Crazyflies have landed")]
    if LaunchConfiguration("simulated").perform(context) == "true":
        words = [*DTSA, "fake-crazyflie", "--config", config, "--quiet", "--ignore-interrupt"]
        fleet = ExecuteProcess(cmd=words, output="screen", name="fake_crazyflie", sigterm_timeout=LAND_S)
        actions.append(fleet)
        end = SignalProcess(signal_number=signal.SIGTERM, process_matcher=matches_action(fleet))
        over.append(EmitEvent(event=end))
    if LaunchConfiguration("mission").perform(context) == "true":
        domain = os.environ.get("ROS_DOMAIN_ID", "0")
        out = LaunchConfiguration("out").perform(context)
        more = LaunchConfiguration("options").perform(context).split()
        fly = [*DTSA, "fly", "--backend", "cflib", "--config", config, "--domain", domain, "--out", out, *more]
        actions.append(ExecuteProcess(cmd=fly, output="screen", name="mission", sigterm_timeout=LAND_S, on_exit=over))
        return actions
    bridge = Node(
        package="dtsa_agent", executable="crazyflie_bridge", name="crazyflie_server", output="screen",
        parameters=[{"config": os.path.abspath(config)}], sigterm_timeout=LAND_S, on_exit=over,
    )  # fmt: skip
    return [*actions, bridge]


def generate_launch_description() -> LaunchDescription:
    """Arguments and processes, for ``ros2 launch``."""
    yes_no = ["true", "false"]
    arguments = [
        DeclareLaunchArgument(name, default_value=default, choices=choices, description=text)
        for name, default, choices, text in (
            ("config", "", None, "the swarm's YAML file"),
            ("mission", "false", yes_no, "fly a recorded mission"),
            ("simulated", "false", yes_no, "the Crazyflies are simulated ones"),
            ("out", "mission", None, "directory for a mission's bag and results"),
            ("options", "", None, "further options of a mission, as `fly` has them"),
        )
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_processes)])
