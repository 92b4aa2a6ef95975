"""The tables of a node's topics, services and parameters in the documentation, made from the node itself.

Each node is started with a stop signal already given: it declares its parameters, makes its publishers, subscriptions
and services, and ends. What it had then is what the tables show.
"""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from dataclasses import dataclass, field
from functools import cache
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
from dtsa_agent.ros.common.process.loop import Stop
from dtsa_bench.flights import recorded_channel
from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.flights.flight import run_environment
from dtsa_bench.runs.config import RunLimits
from dtsa_channel_sim import ChannelConfig, ClockConfig
from dtsa_channel_sim.ros import channel_node

from .markdown import table

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


@dataclass
class Interface:
    """What a node shows to others."""

    topics: set[tuple[str, str, str, str]] = field(default_factory=set)  # topic, type, way, quality of service
    services: set[tuple[str, str]] = field(default_factory=set)
    parameters: dict[str, tuple[Any, Any]] = field(default_factory=dict)  # name: value, descriptor


def node_tables(name: str) -> str:
    """Topics, services and parameters of a node, as Markdown.

    :param name: one of :data:`NODES`.
    """
    found = _interface(name)
    parts = [table(("topic", "type", "", "quality of service"), sorted(found.topics))]
    if found.services:
        parts.append(table(("service", "type"), sorted(found.services)))
    known = {spec.name for cls in _ELSEWHERE for spec in settings_of(cls)}
    rows = [
        (f"`{key}`", _shown(value), _allowed(info), info.description)
        for key, (value, info) in sorted(found.parameters.items())
        if key.rpartition(".")[2] not in known and not key.startswith(("use_sim_time", "start_type", "qos_overrides"))
    ]
    if rows:
        parts.append(table(("parameter", "default", "allowed", "meaning"), rows))
    return "\n".join(parts)


@cache
def _interface(name: str) -> Interface:
    main, values = NODES[name]
    found = Interface()
    keep = Node.destroy_node

    def look(node: Node) -> None:
        _read(node, found)
        keep(node)

    arguments = ["--ros-args", "--disable-stdout-logs", "--disable-external-lib-logs"]
    for value in values:
        arguments += ["-p", value]
    with (
        _quiet_place() as domain,
        patch.object(Stop, "__bool__", lambda stop: True),
        patch.object(Node, "destroy_node", look),
        patch.dict(os.environ, {"ROS_DOMAIN_ID": str(domain)}),
    ):
        main(arguments)
    return found


@contextmanager
def _quiet_place() -> Iterator[int]:
    """A domain and a directory of its own, and nothing on the terminal; gives the domain."""
    before = Path.cwd()
    with (
        tempfile.TemporaryDirectory() as directory,
        ros_domain() as domain,
        redirect_stderr(StringIO()),
        patch.dict(os.environ),
    ):
        run_environment(domain, Path(directory))
        os.chdir(directory)
        try:
            yield domain
        finally:
            os.chdir(before)


def _read(node: Node, found: Interface) -> None:
    ends = [(entry, "publishes") for entry in node.publishers]
    ends += [(entry, "subscribes") for entry in node.subscriptions]
    found.topics = {
        (f"`{_AGENT.sub('/cfN/', entry.topic_name)}`", _type(entry.msg_type), way, _quality(entry.qos_profile))
        for entry, way in ends
        if not _EVERY_NODE.fullmatch(entry.topic_name)
    }
    found.services = {
        (f"`{_AGENT.sub('/cfN/', entry.srv_name)}`", _type(entry.srv_type))
        for entry in node.services
        if not _EVERY_NODE.fullmatch(entry.srv_name)
    }
    found.parameters = {
        name: (parameter.value, node.describe_parameter(name)) for name, parameter in node._parameters.items()
    }


def _type(kind: Any) -> str:
    return f"`{kind.__module__.split('.')[0]}/{kind.__name__}`"


def _quality(profile: QoSProfile) -> str:
    reliable = "reliable" if profile.reliability == ReliabilityPolicy.RELIABLE else "best effort"
    kept = ", transient local" if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL else ""
    return f"{reliable}{kept}, last {profile.depth}"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None or value == "" else f"`{Parameter('x', value=value).value}`"


def _allowed(info: Any) -> str:
    for span in (*info.integer_range, *info.floating_point_range):
        return f"{span.from_value:g} to {span.to_value:g}"
    return str(info.additional_constraints)
