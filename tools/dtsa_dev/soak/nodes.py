"""How a node is started by hand, without `dtsa fly`."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def node_command(module: str, *words: str, logs: bool = False) -> list[str]:
    """Words that start a node in this environment.

    :param module: its module.
    :param words: its ROS arguments.
    :param logs: whether its log goes to standard error, beside its own last line.
    """
    quiet = [] if logs else ["--disable-stdout-logs"]
    return [sys.executable, "-m", module, "--ros-args", *quiet, *words]


def node_environment(domain: int, logs: Path) -> dict[str, str]:
    """Environment of nodes that hear nobody beyond this machine.

    :param domain: ROS domain.
    :param logs: directory of their log files.
    """
    here = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    return {**here, **os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(logs)}
