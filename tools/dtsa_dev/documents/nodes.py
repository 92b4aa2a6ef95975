"""The tables of a node's topics, services and parameters in the documentation, made from the node itself.

Each node is started with a stop signal already given: it declares its parameters, makes its publishers, subscriptions
and services, and ends. The tables show what it had then.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import patch

from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.settings.declaration import settings_of
from dtsa_agent.crazyflie.node import agents_node
from dtsa_agent.ros import agent_node, swarm_host
from dtsa_agent.stop import Stop
from dtsa_bench.flights import recorded_channel
from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.flights.flight import run_environment
from dtsa_bench.runs.config import RunLimits
from dtsa_channel_sim import ChannelConfig, ClockConfig
from dtsa_channel_sim.ros import channel_node

from . import table

_EVERY_NODE = re.compile(r"/tf|/rosout|/parameter_events|.*/(\w*parameters?(_\w+)?|get_type_description)$")
_ELSEWHERE = (SwarmConfig, ChannelConfig, RunLimits, ClockConfig)  # settings that have tables of their own
_AGENT = re.compile(r"/cf\d+/")
NODES: dict[str, tuple[Callable[[Sequence[str]], int], tuple[str, ...]]] = {
    "agent": (agent_node.main, ("id:=1", "agents:=2")),
    "agent, real time": (agent_node.main, ("id:=1", "agents:=2", "mode:=realtime")),
    "swarm_host": (swarm_host.main, ("agents:=2",)),
    "crazyflie_agents": (agents_node.main, ("agents:=2",)),
    "channel": (channel_node.main, ("agents:=2",)),
    "recorded_channel": (recorded_channel.main, ("agents:=2", "out:=flight")),
}


def node_tables(name: str) -> str:
    """Topics, services and parameters of a node, as Markdown."""
    main, values = NODES[name]
    parts: list[str] = []
    destroy = Node.destroy_node

    def describe_and_destroy(node: Node) -> None:
        parts[:] = _tables(node)
        destroy(node)

    words = ["--ros-args", "--disable-stdout-logs", "--disable-external-lib-logs"]
    words += [word for value in values for word in ("-p", value)]
    before = Path.cwd()
    with (
        tempfile.TemporaryDirectory() as directory,
        ros_domain() as domain,
        redirect_stderr(StringIO()),
        patch.dict(os.environ),
        patch.object(Stop, "__bool__", lambda stop: True),
        patch.object(Node, "destroy_node", describe_and_destroy),
    ):
        run_environment(domain, Path(directory))
        os.environ["ROS_DOMAIN_ID"] = str(domain)
        os.chdir(directory)
        try:
            main(words)
        finally:
            os.chdir(before)
    return "\n".join(parts)


def _tables(node: Node) -> Iterator[str]:
    def shown(name: str) -> str:
        return f"`{_AGENT.sub('/cfN/', name)}`"

    ends = [(end, end.topic_name, "publishes") for end in node.publishers]
    ends += [(end, end.topic_name, "subscribes") for end in node.subscriptions]
    topics = {
        (shown(name), _type(end.msg_type), way, _quality(end.qos_profile))
        for end, name, way in ends
        if not _EVERY_NODE.fullmatch(name)
    }
    yield table(("topic", "type", "", "quality of service"), sorted(topics))
    names = [(end.srv_name, _type(end.srv_type)) for end in node.services if not _EVERY_NODE.fullmatch(end.srv_name)]
    if names:
        yield table(("service", "type"), sorted({(shown(name), kind) for name, kind in names}))
    known = {spec.name for cls in _ELSEWHERE for spec in settings_of(cls)}
    rows = []
    for name, parameter in sorted(node._parameters.items()):
        if name.rpartition(".")[2] not in known and not name.startswith(
            ("use_sim_time", "start_type", "qos_overrides")
        ):
            info = node.describe_parameter(name)
            rows.append((f"`{name}`", _value(parameter.value), _allowed(info), info.description))
    if rows:
        yield table(("parameter", "default", "allowed", "meaning"), rows)


def _type(kind: Any) -> str:
    return f"`{kind.__module__.split('.')[0]}/{kind.__name__}`"


def _quality(profile: QoSProfile) -> str:
    reliable = "reliable" if profile.reliability == ReliabilityPolicy.RELIABLE else "best effort"
    kept = ", transient local" if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL else ""
    return f"{reliable}{kept}, last {profile.depth}"


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None or value == "" else f"`{Parameter('x', value=value).value}`"


def _allowed(info: Any) -> str:
    for span in (*info.integer_range, *info.floating_point_range):
        return f"{span.from_value:g} to {span.to_value:g}"
    return str(info.additional_constraints)
