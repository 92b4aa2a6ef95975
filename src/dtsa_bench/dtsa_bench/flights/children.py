"""The processes of a flight: started together, watched, ended together."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.ros.common.node_process import SUPERVISOR

# A process group of its own; Python 3.10 cannot say so without a function that runs in the child.
_OWN_GROUP: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"preexec_fn": os.setpgrp}
# As `-m`, which would put the current folder first where modules are looked for: a numpy.py there is not NumPy.
_RUN = """import sys; sys.path[:] = [place for place in sys.path if place]; import runpy; del sys.argv[0]
runpy.run_module(sys.argv[0], run_name="__main__", alter_sys=True)"""
_LEAVE_S = 3.0  # to end by themselves once the run is over; many on few cores take their time
_TERM_S = 1.0  # and then after SIGTERM
_HURRY_S = 0.3  # both, when the user has ended it


class NodeError(DtsaError):
    """A node of the flight ended when it should not have."""


@dataclass(slots=True)
class Child:
    """One process."""

    name: str  # as the user knows it, e.g. "cf3"
    agents: Sequence[int]  # ids of the agents in it
    process: subprocess.Popen[bytes]
    log: Path
    module: str
    arguments: Sequence[str]

    @property
    def has_ended(self) -> bool:
        """Whether the process has ended."""
        return self.process.poll() is not None


class Children:
    """The processes that one supervisor started, with these environment variables on top of its own."""

    def __init__(self, logs: Path, environment: Mapping[str, str]) -> None:
        self._logs = logs
        self._environment = {**os.environ, **environment, SUPERVISOR: str(os.getpid())}
        self.all: list[Child] = []
        self._reported: list[Child] = []  # that have ended

    def start(self, name: str, agents: Sequence[int], module: str, arguments: Sequence[str]) -> None:
        """Starts a module with arguments, as `python -m` does.

        It becomes a process group of its own, so that Ctrl-C in the terminal reaches the supervisor alone, which then
        ends all in good order. It stays in the supervisor's session: Linux gives each session as much of the processor
        as any other one, and a session an agent would leave next to nothing for the channel.
        """
        log = self._logs / f"{name.replace(' ', '')}.log"
        with log.open("ab") as output:
            process = subprocess.Popen(
                [sys.executable, "-c", _RUN, module, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env=self._environment,
                **_OWN_GROUP,
            )
        self.all.append(Child(name, agents, process, log, module, arguments))

    def restart(self, child: Child, more: Sequence[str] = ()) -> None:
        """Start a process that has ended another time; the new one takes its place."""
        self.all.remove(child)
        self.start(child.name, child.agents, child.module, [*child.arguments, *more])
        self.all[-1].arguments = child.arguments

    def ended(self) -> list[Child]:
        """Processes that have ended since this was asked last."""
        fresh = [child for child in self.all if child.has_ended and child not in self._reported]
        self._reported += fresh
        return fresh

    def check(self) -> None:
        """NodeError: some have ended; it names them, and why."""
        if ended := [child for child in self.all if child.has_ended]:
            raise NodeError("; ".join(describe_end(child) for child in ended))

    def stop(self, hurry: bool = False) -> None:
        """Wait until all have ended, and help those that do not."""
        leave_s, term_s = (_HURRY_S, _HURRY_S) if hurry else (_LEAVE_S, _TERM_S)
        # 0 is no signal: at first they are given time to end by themselves.
        for number, patience in ((0, leave_s), (signal.SIGTERM, term_s), (signal.SIGKILL, 10.0)):
            alive = [child for child in self.all if not child.has_ended]
            for child in alive:
                child.process.send_signal(number)
            deadline = time.monotonic() + patience
            while time.monotonic() < deadline and not all(child.has_ended for child in alive):
                time.sleep(0.01)


def describe_end(child: Child) -> str:
    """Why a process ended, in one line."""
    code = child.process.returncode
    who = f"{child.name} (process {child.process.pid})"
    if code < 0:
        return f"{who} was killed by {signal.Signals(-code).name}"
    lines = child.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    last = f": {lines[-1]}" if lines else ""
    return f"{who} ended with code {code}{last}"
