"""Fast DDS on one machine: no socket beyond loopback, and no shared memory.

Upstream: rmw_fastrtps, pull request 653 (adds LOCALHOST, which listens on all interfaces); Fast DDS, issue 6535 (a
sender waits for an idle port in shared memory); Fast DDS, issues 2790, 5053 and 5469 (what killed processes leave
in shared memory, and that a process which is started again hears nothing).
Delete when: rmw_fastrtps binds LOCALHOST to loopback alone, and shared memory outlasts killed processes.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from pathlib import Path

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS = "ROS_STATIC_PEERS"
TRANSPORTS = "FASTDDS_BUILTIN_TRANSPORTS"
# Fast DDS 2 reads the first, Fast DDS 3 the second.
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROFILE = Path(__file__).with_name("loopback.xml")


def limit_to_machine(environment: MutableMapping[str, str]) -> None:
    """Make ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` mean the loopback interface alone; UDP in any case.

    rmw_fastrtps adds a UDP transport of its own under LOCALHOST, which listens on all interfaces. With SYSTEM_DEFAULT
    it takes the transports of our profile instead. Another range, peers elsewhere, another middleware, other transports
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
    environment[RANGE] = "SYSTEM_DEFAULT"
    for name in PROFILES:
        environment[name] = str(PROFILE)
