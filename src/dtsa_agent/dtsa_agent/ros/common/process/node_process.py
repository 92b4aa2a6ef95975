"""What all node processes have in common: start, exit codes, one clear line for what went wrong, and their parent."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable, MutableMapping, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.ros.common.graph import names
from dtsa_agent.ros.common.workarounds._endless import mend
from dtsa_agent.ros.common.workarounds.dds import by_udp, clean_shared_memory, limit_to_machine
from dtsa_agent.ros.common.workarounds.kept_nodes import leave_kept_nodes

from .loop import Stop

_PR_SET_PDEATHSIG = 1
_REALTIME = re.compile(rf"""^\s*["']?mode["']?\s*:\s*["']?{names.MODES[1]}\b""", re.MULTILINE)
SUPERVISOR = "DTSA_SUPERVISOR"  # process id of the supervisor that started this node, if one did
_MIDDLEWARE = "libfastrtps"  # Fast DDS 2


def follow_supervisor() -> bool:
    """Lets the kernel end this process when its supervisor ends, however that ends.

    :returns: whether a supervisor started this process; it then answers for names and parameters, too.
    """
    parent = os.environ.get(SUPERVISOR)
    if not parent:
        return False
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != int(parent):  # it was gone before we asked
        sys.exit(1)
    return True


def node_options(supervised: bool) -> dict[str, Any]:
    """Arguments for ``Node``: a supervised node goes without the services that nobody would ask, and starts faster.

    :param supervised: whether a supervisor started this process.
    """
    if not supervised:
        return {}
    silent = Parameter("start_type_description_service", value=False)
    return {"start_parameter_services": False, "enable_rosout": False, "parameter_overrides": [silent]}


def in_real_time(words: Sequence[str]) -> bool:
    """Whether a command line asks for ``mode:=realtime``: the middleware wants to know before there is a node.

    :param words: with ROS's arguments; parameter files are looked into.
    """
    for option, value in pairwise(words):
        if option in ("-p", "--param") and value == f"mode:={names.MODES[1]}":
            return True
        if option == "--params-file":
            with suppress(OSError, UnicodeError):  # rclpy says what is wrong with it
                if _REALTIME.search(Path(value).read_text(encoding="utf-8")):
                    return True
    return False


def init_ros(args: list[str] | None, context: Context | None = None, domain_id: int | None = None) -> None:
    """``rclpy.init`` without signal handlers of its own, and with a middleware that lets nodes be destroyed.

    :param args: command line; None: ``sys.argv``.
    :param context: what is initialized; None: the process's own.
    :param domain_id: ROS domain; None: the environment's.
    """
    log_where_possible(os.environ)
    rclpy.init(args=args, context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
    mend(_MIDDLEWARE)


def log_where_possible(environment: MutableMapping[str, str]) -> None:
    """Lets ROS write its logs to a temporary directory if its own cannot be made or written to, and says so."""
    home = environment.get("ROS_HOME") or os.path.join(os.path.expanduser("~"), ".ros")
    directory = Path(environment.get("ROS_LOG_DIR") or os.path.join(home, "log"))
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.W_OK):
            raise PermissionError(errno.EACCES, "it may not be written to")
    except OSError as error:
        environment["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="dtsa-log-")
        print(f"{directory}: {error.strerror}: logs are in {environment['ROS_LOG_DIR']}", file=sys.stderr, flush=True)


def run_node(
    name: str, body: Callable[[Stop, bool], int | None], args: Sequence[str] | None = None, real_time: bool = False
) -> int:
    """Runs a node until it ends by itself or by SIGINT or SIGTERM.

    :param name: what it calls itself in error messages.
    :param body: creates the node and runs it; gets the signal flag and whether a supervisor started this process.
    :param args: command line, default ``sys.argv``.
    :param real_time: whether it is in real time always; otherwise its command line says so.
    :returns: exit code: 0 for a clean end (by a signal, too), 2 for settings that are not usable, 1 for other errors.
    """
    supervised = follow_supervisor()
    real_time = real_time or in_real_time(sys.argv if args is None else args)
    limit_to_machine(os.environ, shared_memory=not (real_time or (supervised and by_udp(os.environ))))
    if not supervised:  # a supervisor does that for all of them
        clean_shared_memory()  # of the process, killed, whose place this one may take
    with Stop() as stop:
        code = _run(name, body, args, stop, supervised)
    leave_kept_nodes(code)
    return code


def _run(
    name: str, body: Callable[[Stop, bool], int | None], args: Sequence[str] | None, stop: Stop, supervised: bool
) -> int:
    """The node itself; its exit code."""
    try:
        init_ros(list(args) if args is not None else None)
    except Exception as error:  # rclpy's errors for a wrong command line have no common base
        print(f"{name}: {str(error).splitlines()[0]}", file=sys.stderr)
        return 2
    try:
        return body(stop, supervised) or 0
    except ConfigError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 2
    except DtsaError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 1
    except ExternalShutdownException:
        return 0
    finally:
        rclpy.try_shutdown()
