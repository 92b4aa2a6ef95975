"""What all node processes have in common: start, exit codes, one clear line for what went wrong, and their parent."""

from __future__ import annotations

import ctypes
import errno
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.stop import Stop, in_time

from ._endless import mend

_PR_SET_PDEATHSIG = 1
SUPERVISOR = "DTSA_SUPERVISOR"  # process id of the supervisor that started this node, if one did
_MIDDLEWARE = "libfastrtps"  # Fast DDS 2
_LONGEST_END_S = 20.0  # of a node; the middleware was seen to stand still when others left in the same moment

# Fast DDS on one machine: no socket beyond loopback, and no shared memory.
# Upstream: rmw_fastrtps, pull request 653 (adds LOCALHOST, which listens on all interfaces); Fast DDS, issue 6535 (a
# sender waits for an idle port in shared memory); Fast DDS, issues 2790, 5053 and 5469 (what killed processes leave
# in shared memory, and that a process which is started again hears nothing).
# Delete when: rmw_fastrtps binds LOCALHOST to loopback alone, and shared memory outlasts killed processes.
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS = "ROS_STATIC_PEERS"
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
# Fast DDS 2 reads the first, Fast DDS 3 the second.
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROFILE = Path(__file__).with_name("loopback.xml")


def limit_to_machine(environment: MutableMapping[str, str]) -> None:
    """Make ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` mean the loopback interface alone; UDP in any case.

    rmw_fastrtps adds a UDP transport of its own under LOCALHOST, which listens on all interfaces. With SYSTEM_DEFAULT
    it uses the transports of our profile instead. Another range, peers elsewhere, another middleware, other transports
    or a profile of the user stay. Call it before the process uses the middleware.
    """
    if not environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp").startswith("rmw_fastrtps"):
        return
    ours = all(environment.get(name) == str(PROFILE) for name in PROFILES)  # of the process that started this one
    if not ours and any(name in environment for name in PROFILES):
        return
    if not (ours or environment.get(RANGE) == "LOCALHOST") or environment.get(PEERS):
        environment.setdefault(TRANSPORTS, "UDPv4")
        return
    environment.update({RANGE: "SYSTEM_DEFAULT", **dict.fromkeys(PROFILES, str(PROFILE))})


def follow_supervisor() -> bool:
    """Let the kernel end this process when its supervisor ends, however that ends; return whether there is one."""
    parent = os.environ.get(SUPERVISOR)
    if not parent:
        return False
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != int(parent):  # it was gone before we asked
        sys.exit(1)
    return True


def node_options(supervised: bool) -> dict[str, Any]:
    """Return arguments for ``Node``: a supervised node goes without services that nothing asks, and starts faster."""
    silent = Parameter("start_type_description_service", value=False)
    without = {"start_parameter_services": False, "enable_rosout": False, "parameter_overrides": [silent]}
    return without if supervised else {}


def init_ros(args: list[str] | None, context: Context | None = None, domain_id: int | None = None) -> None:
    """``rclpy.init`` without signal handlers of its own, and with a middleware that lets nodes be destroyed."""
    log_where_possible(os.environ)
    rclpy.init(args=args, context=context, domain_id=domain_id, signal_handler_options=SignalHandlerOptions.NO)
    mend(_MIDDLEWARE)


def log_where_possible(environment: MutableMapping[str, str]) -> None:
    """Let ROS write its logs to a temporary directory if its own cannot be made or written to, and print that."""
    home = environment.get("ROS_HOME") or os.path.join(os.path.expanduser("~"), ".ros")
    directory = Path(environment.get("ROS_LOG_DIR") or os.path.join(home, "log"))
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.W_OK):
            raise PermissionError(errno.EACCES, "it may not be written to")
    except OSError as error:
        environment["ROS_LOG_DIR"] = tempfile.mkdtemp(prefix="dtsa-log-")
        print(f"{directory}: {error.strerror}: logs are in {environment['ROS_LOG_DIR']}", file=sys.stderr, flush=True)


@contextmanager
def ending(node: Node) -> Iterator[None]:
    """Destroy a node at the end of the context; a process whose middleware hangs then says where, and ends."""
    try:
        yield
    finally:
        with in_time(_LONGEST_END_S):
            node.destroy_node()


def run_node(name: str, body: Callable[[Stop, bool], int | None], args: Sequence[str] | None = None) -> int:
    """Run a node until it ends by itself or by SIGINT or SIGTERM; return its exit code.

    0: a clean end (by a signal, too); 2: settings that are not usable; 1: other errors. ``body`` creates the node and
    runs it; it gets the signal flag and whether a supervisor started this process.
    """
    supervised = follow_supervisor()
    limit_to_machine(os.environ)
    with Stop() as stop:
        try:
            init_ros(list(args) if args is not None else None)
        except Exception as error:  # rclpy's errors for a wrong command line have no common base
            print(f"{name}: {str(error).splitlines()[0]}", file=sys.stderr)
            return 2
        try:
            return body(stop, supervised) or 0
        except DtsaError as error:
            print(f"{name}: error: {error}", file=sys.stderr)
            return 2 if isinstance(error, ConfigError) else 1
        except ExternalShutdownException:
            return 0
        finally:
            rclpy.try_shutdown()
