"""Free UDP ports for a fleet on this machine."""

from __future__ import annotations

import socket
from contextlib import ExitStack

from dtsa_agent.core.errors import ConfigError

FIRST = 19850  # where cflib's scan looks, too
LAST = 32000  # below Linux's ephemeral ports


def free_base_port(count: int, first: int = FIRST) -> int:
    """Base port of a fleet: it, the `count` - 1 after it, and the control port before it are free.

    :param count: vehicles.
    :param first: the lowest base port that will do.
    :raises ConfigError: there are not so many free ports in a row.
    """
    for base in range(first, LAST - count, count + 1):
        with ExitStack() as stack:
            try:
                for port in range(base - 1, base + count):
                    stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("127.0.0.1", port))
            except OSError:
                continue
            return base
    raise ConfigError("port", first, f"{count + 1} free UDP ports in a row between {first - 1} and {LAST}")
