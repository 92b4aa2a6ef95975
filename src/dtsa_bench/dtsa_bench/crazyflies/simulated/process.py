"""Simulated Crazyflies in a process of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.process.node_process import SUPERVISOR
from dtsa_bench.runs.processes import end_process

_START_S = 60.0
_END_S = 10.0


class FleetError(DtsaError):
    """The simulated Crazyflies do not start.

    :param code: exit code of their process.
    """

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
