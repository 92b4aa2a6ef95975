"""Simulated Crazyflies in a process of their own, and free UDP ports for them."""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.ros.common.process.node_process import SUPERVISOR
from dtsa_bench.runs.processes import end_process

FIRST = 19850  # where cflib's scan looks, too
LAST = 32000  # below Linux's ephemeral ports
_RANDOM = random.SystemRandom()
_START_S = 60.0
_END_S = 10.0


def free_base_port(count: int, first: int | None = None) -> int:
    """Base port of a fleet: it, the `count` - 1 after it, and the control port before it are free now.

    :param first: the lowest base port that will do; None: any, so that two who look at the same time seldom agree.
    :raises ConfigError: there are not so many free ports in a row.
    """
    low = FIRST if first is None else first
    bases = range(low, LAST - count, count + 1)
    offset = _RANDOM.randrange(len(bases)) if first is None else 0
    for base in (*bases[offset:], *bases[:offset]):
        if _are_free(base - 1, base + count):
            return base
    raise ConfigError("port", low, f"{count + 1} free UDP ports in a row between {low - 1} and {LAST}")


def _are_free(begin: int, end: int) -> bool:
    with ExitStack() as stack:
        try:
            for port in range(begin, end):
                stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)).bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


class FleetError(DtsaError):
    """The simulated Crazyflies do not start; `code` is the exit code of their process."""

    def __init__(self, code: int) -> None:
        super().__init__("the simulated Crazyflies do not start")
        self.code = code


@contextmanager
def running_fleet(words: Sequence[str]) -> Iterator[str]:
    """Simulated Crazyflies for as long as the context lasts; they end with this process, too, whatever ends it.

    They have a session of their own: Ctrl-C is for whoever flies them, and still has to land them.

    :param words: arguments of `fake-crazyflie`.
    :returns: the line with which they say that they are there.
    :raises FleetError: if they do not start.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", "dtsa_bench.crazyflies.simulated.cli", *words, "--quiet"],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {SUPERVISOR: str(os.getpid())},
    )
    assert process.stdout is not None
    patience = threading.Timer(_START_S, process.kill)
    patience.start()
    try:
        # The addresses, then one line that says that they are there.
        line = next((line for line in process.stdout if "Ctrl-C" in line), None)
        patience.cancel()
        if line is None:
            raise FleetError(process.wait())
        yield line
    finally:
        patience.cancel()
        end_process(process, _END_S)
        process.stdout.close()
