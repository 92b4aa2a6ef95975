"""Nodes that are not destroyed, because a process that they talked with may be dead.

A process that is killed may hold a lock in the shared memory of others. Fast DDS 2.14 gives such memory up in the
thread that receives; a thread that destroys the node waits for the lock meanwhile, and the process crashes.

Upstream: not reported as such; Fast DDS, issue 5469, is near (a killed process disturbs those that share its memory).
Delete when: nodes can be destroyed beside killed processes; `test_dds.py` and `tools/dtsa soak faults` kill them.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.node import Node

from dtsa_agent.core.errors import LocalProtocolError
from dtsa_agent.stop import in_time

_LONGEST_END_S = 20.0  # of a node; the middleware was seen to stand still when others left in the same moment
_KEPT: list[Node] = []  # nodes that last as long as their process


def keep_node(node: Node) -> None:
    """Lets a node last as long as its process, in place of destroying it: where one that it talked with may be dead.

    :param node: the node.
    """
    _KEPT.append(node)


@contextmanager
def ending(node: Node) -> Iterator[None]:
    """Destroys a node at the end of the context; keeps it when that ends because others are dead or hang.

    :param node: the node.
    """
    try:
        yield
    except LocalProtocolError:
        keep_node(node)
        raise
    except BaseException:
        _destroy(node)
        raise
    _destroy(node)


def _destroy(node: Node) -> None:
    with in_time(_LONGEST_END_S):
        node.destroy_node()


def leave_kept_nodes(code: int) -> None:
    """Ends the process at once where a node was kept: nor is the interpreter taken apart with it.

    :param code: exit code.
    """
    if _KEPT:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
