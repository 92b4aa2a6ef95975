"""Which swarm a node belongs to: its namespace says so, or its parameter ``swarm_namespace``."""

from __future__ import annotations

import re
from typing import Any

from rclpy.exceptions import InvalidNamespaceException
from rclpy.node import Node
from rclpy.validate_namespace import validate_namespace

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting

from . import names
from .parameters import declare_setting

PARAMETER = "swarm_namespace"
_AGENT = re.compile(r"(?P<swarm>.*)/cf\d+")


def declare_swarm_namespace(node: Node) -> str:
    """Declares the parameter ``swarm_namespace`` and reads it.

    Default is the namespace that the node was started in, without the agent's own part: a node in ``/north`` or in
    ``/north/cf3`` belongs to swarm ``/north``, one in ``/swarm`` or ``/cf3`` to ``/swarm``.

    :param node: the node.
    :raises ConfigError: if the value is no namespace.
    """
    own = node.get_namespace()
    agent = _AGENT.fullmatch(own)
    default = (agent["swarm"] if agent else own.rstrip("/")) or names.SWARM
    text = "namespace of what the whole swarm shares; default: the node's own, without the agent's part"
    value = declare_setting(node, Setting(PARAMETER, "text", default, text))
    space = "/" + value.strip("/")
    try:
        validate_namespace(space)
    except InvalidNamespaceException as error:
        raise ConfigError(PARAMETER, value, "a namespace as /north") from error
    return names.SWARM if space == "/" else space


def swarm_wide_node(name: str, options: dict[str, Any] | None = None) -> tuple[Node, str]:
    """A node that belongs to a whole swarm, in that swarm's namespace; and the namespace.

    :param name: the node's name.
    :param options: further arguments for ``Node``.
    :raises ConfigError: if the parameter ``swarm_namespace`` is no namespace.
    """
    node = Node(name, namespace=names.SWARM, **(options or {}))
    try:
        space = declare_swarm_namespace(node)
        if space != node.get_namespace() == names.SWARM:  # the parameter names it, not the command line
            node.destroy_node()
            node = Node(name, namespace=space, **(options or {}))
            declare_swarm_namespace(node)
    except BaseException:
        node.destroy_node()
        raise
    return node, space
