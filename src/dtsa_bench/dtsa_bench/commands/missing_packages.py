"""Packages that an installation may lack: named in one line when they are needed, with the way to get them."""

from __future__ import annotations

import importlib.util
import sys

_WORKSPACE = "build the workspace and source it: colcon build && . install/setup.bash"
_ROS = "source an installation of ROS 2 Jazzy, or use tools/dtsa of a checkout on x86_64"
_HOW = {
    **dict.fromkeys(("dtsa_msgs", "dtsa_agent", "dtsa_channel_sim"), _WORKSPACE),
    **dict.fromkeys(("mcap", "rosbags", "lz4", "zstandard", "pyarrow", "pandas", "aiohttp", "shtab"), "pip install {}"),
    **dict.fromkeys(("cflib", "distributed"), "pip install {}"),
    **dict.fromkeys(
        ("rclpy", "ament_index_python", "builtin_interfaces", "geometry_msgs", "nav_msgs", "std_msgs"), _ROS
    ),
    **dict.fromkeys(("serial", "cobs"), "pip install pyserial cobs"),
    "yaml": "apt install python3-yaml, or pip install pyyaml",
    **dict.fromkeys(("numpy", "scipy", "matplotlib", "rich"), "apt install python3-{0}, or pip install {0}"),
}


def explained(error: ImportError) -> str:
    """What is missing and how to get it; empty if the error is not about a package that we use."""
    name = (error.name or "").split(".")[0]
    how = _HOW.get(name)
    if name == "dtsa_msgs" and not _found("rclpy"):
        how = _ROS  # there is nothing to build a workspace on
    return f"the Python package {name} is missing: {how.format(name)} (docs/how-to/install.md)" if how else ""


def _found(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):
        return False


def say_missing(program: str, error: ImportError) -> int:
    """Prints one line about a missing package.

    :raises ImportError: the error itself, if it is about something else.
    """
    text = explained(error)
    if not text:
        raise error
    print(f"{program}: error: {text}", file=sys.stderr)
    return 2
