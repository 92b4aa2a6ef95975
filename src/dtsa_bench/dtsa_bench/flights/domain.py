"""A ROS domain for one run alone: two runs on one machine never hear each other, whatever the user's shell says."""

from __future__ import annotations

import fcntl
import os
import socket
import sys
import tempfile
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager, suppress
from pathlib import Path

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.ros.common.node_process import RANGE

# Ports of RTPS: 7400 + 250 domain + 10 + 2 participant (+ 1). Beyond domain 101 they meet Linux's ephemeral ports.
LAST_FREE_DOMAIN = 101
LAST_DOMAIN = 232
_PARTICIPANTS = 4
_SPREAD = 37  # runs that start at the same time look at different domains first

_FAST_DDS = "rmw_fastrtps_cpp"


def clear_hindrances(environment: MutableMapping[str, str]) -> None:
    """Changes variables of a user's shell that keep the processes of a flight from each other, and says which."""
    for name, wrong, value in (
        ("RMW_IMPLEMENTATION", environment.get("RMW_IMPLEMENTATION", _FAST_DDS) != _FAST_DDS, _FAST_DDS),
        ("ROS_DISCOVERY_SERVER", "ROS_DISCOVERY_SERVER" in environment, ""),
        (RANGE, environment.get(RANGE) == "OFF", "LOCALHOST"),
    ):
        if wrong:
            instead = f"{value} is taken" if value else "none is asked"
            text = f"{name}={environment.pop(name)} does not count in a flight on this machine alone: {instead}"
            print(f"dtsa: {text}", file=sys.stderr, flush=True)
            environment |= {name: value} if value else {}


@contextmanager
def ros_domain(wanted: int | None = None, *, shared: bool = False) -> Iterator[int]:
    """Take a domain for as long as the context lasts.

    :param wanted: number of the domain, 0 to 232; None: any that is free.
    :raises DtsaError: it, or all are in use.
    """
    if wanted is not None and not 0 <= wanted <= LAST_DOMAIN:
        raise ConfigError("domain", wanted, f"0 to {LAST_DOMAIN}")
    candidates = [1 + (os.getpid() * _SPREAD + i) % LAST_FREE_DOMAIN for i in range(LAST_FREE_DOMAIN)]
    for domain in candidates if wanted is None else [wanted]:
        lock = _lock(domain)
        if lock is None:
            continue
        try:
            if shared or _ports_free(domain):
                yield domain
                return
        finally:
            os.close(lock)
    if wanted is not None:
        raise ConfigError("domain", wanted, "a ROS domain that no process on this machine uses (it is in use)")
    raise DtsaError(f"all ROS domains from 1 to {LAST_FREE_DOMAIN} are in use on this machine")


def _lock(domain: int) -> int | None:
    """A lock that lasts until its file descriptor is closed, or its process ends however it ends."""
    directory = Path(tempfile.gettempdir()) / f"dtsa-domains-{os.getuid()}"
    with suppress(FileExistsError):
        directory.mkdir(mode=0o700)
    descriptor = os.open(directory / str(domain), os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(descriptor)
        return None
    return descriptor


def _ports_free(domain: int) -> bool:
    """Whether the ports that a domain's first participants would have are free."""
    for port in range(7400 + 250 * domain + 10, 7400 + 250 * domain + 10 + 2 * _PARTICIPANTS):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            try:
                probe.bind(("", port))
            except OSError:
                return False
    return True
