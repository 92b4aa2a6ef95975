"""Free UDP ports for a fleet on this machine."""

from __future__ import annotations

import random
import socket
from contextlib import ExitStack

from dtsa_agent.core.errors import ConfigError

FIRST = 19850  # where cflib's scan looks, too
LAST = 32000  # below Linux's ephemeral ports
_RANDOM = random.SystemRandom()


def free_port() -> int:
    """One UDP port that is free now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port: int = sock.getsockname()[1]
        return port


def free_base_port(count: int, first: int | None = None) -> int:
    """Base port of a fleet: it, the `count` - 1 after it, and the control port before it are free now.

    :param count: number of vehicles.
    :param first: the lowest base port that will do; None: any, so that two who look at the same time seldom agree.
    :raises ConfigError: there are not so many free ports in a row.
    """
    low = FIRST if first is None else first
    bases = range(low, LAST - count, count + 1)
    offset = _RANDOM.randrange(len(bases)) if first is None else 0
    for base in (*bases[offset:], *bases[:offset]):
        if _free(base - 1, base + count):
            return base
    raise ConfigError("port", low, f"{count + 1} free UDP ports in a row between {low - 1} and {LAST}")


def _free(begin: int, end: int) -> bool:
    with ExitStack() as stack:
        try:
            for port in range(begin, end):
                stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
