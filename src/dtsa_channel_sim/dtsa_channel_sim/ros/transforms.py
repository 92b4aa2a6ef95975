"""Transforms from the room to the agents' bodies on ``/tf``, for RViz and other tools that want a tree of frames."""

from __future__ import annotations

import time
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.node import Node

from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.wire.stamps import header_of
from dtsa_channel_sim.model.verdict import Verdict

from .answers import Answers
from .observer import ChannelObserver, ChannelStatus

_PERIOD_S = 0.02  # wall time from one message to the next at the least
_DEPTH = 100  # as tf2's own broadcasters


class Transforms(ChannelObserver):
    """Publishes ``map`` -> ``cfN/base_link`` of all agents in one message, while somebody subscribes.

    Needs tf2_msgs, which an installation from apt has and the wheels lack; without it, it says so once and does
    nothing. The attitude is not modelled: it is the identity.

    :param node: the channel's node.
    :param agents: number of agents.
    :param slot_ns: ns, length of a slot.
    :param swarm_namespace: namespace of the swarm's topics.
    """

    def __init__(self, node: Node, agents: int, slot_ns: int, swarm_namespace: str = names.SWARM) -> None:
        self._slot_ns = slot_ns
        spaces = [names.agent_namespace(agent, swarm_namespace) for agent in range(1, agents + 1)]
        self._bodies = [names.body_frame(space) for space in spaces]
        self._next_s = 0.0  # time.monotonic()
        self._watched = False
        self._publisher: Any = None
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            node.get_logger().info("no transforms on /tf: tf2_msgs is not installed (apt: ros-jazzy-tf2-msgs)")
            return
        self._kind = TFMessage
        self._publisher = node.create_publisher(TFMessage, "/tf", _DEPTH)

    def slot_over(self, slot: int, answers: Answers, verdict: Verdict) -> None:
        if not self._watched or time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + _PERIOD_S
        header = header_of(names.slot_time_ns(slot, self._slot_ns))
        transforms = []
        for body, (x, y, z) in zip(self._bodies, answers.position.T.tolist(), strict=True):
            transform = TransformStamped(header=header, child_frame_id=body)
            place = transform.transform.translation
            place.x, place.y, place.z = x, y, z
            transforms.append(transform)
        self._publisher.publish(self._kind(transforms=transforms))

    def idle(self, status: ChannelStatus) -> None:
        self._watched = self._publisher is not None and self._publisher.get_subscription_count() > 0
