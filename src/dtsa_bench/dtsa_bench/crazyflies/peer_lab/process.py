"""A flight in a process of its own, which an app that crashes ends alone."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_agent.crazyflie.onboard import key_of

from .app import App, LabSettings
from .compiling import sanitizer_environment
from .engine import AppError
from .laboratory import Laboratory

_CRASHED = 70  # native/crash.c
_HEAD = "peer-lab: "


def fly(
    app: App,
    seconds: float,
    settings: LabSettings | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    out: Path | None = None,
    swarm: SwarmConfig | None = None,
) -> dict[str, Any]:
    """Fly an app; the summary, with `console` (what the apps printed), `warnings` (compiler, sanitizers), `logs`.

    :param seconds: s, virtual time.
    :param parameters: values of the app's parameters, beside its own.
    :param out: directory for files.
    :param swarm: flies the protocol on board; None: the app is another one.
    :raises CompileError: the app does not compile.
    :raises AppError: an app crashed, or did what no app may do.
    """
    request = pickle.dumps((app, seconds, settings or LabSettings(), dict(parameters or {}), out, swarm))
    command = [sys.executable, "-m", "dtsa_bench.crazyflies.peer_lab.process"]
    environment = {**os.environ, **sanitizer_environment(app)}
    done = subprocess.run(command, input=request, capture_output=True, check=False, env=environment)
    errors = done.stderr.decode(errors="replace")
    lines = errors.splitlines()
    crash = next((line.removeprefix(_HEAD) for line in reversed(lines) if line.startswith(_HEAD)), None)
    if done.returncode == _CRASHED and crash is not None:
        raise AppError(crash)
    if done.returncode == -signal.SIGINT:
        raise KeyboardInterrupt
    if done.returncode != 0:
        faults = [line for line in lines if "ERROR: " in line or "runtime error: " in line]  # a sanitizer's
        last = (faults or lines or ["it printed nothing"])[-1]
        raise AppError(f"the laboratory's process ended with {done.returncode}: {last}")
    answer = pickle.loads(done.stdout)
    if isinstance(answer, DtsaError):
        raise answer
    return {**answer, "warnings": answer["warnings"] + errors}


def _fly(
    app: App, seconds: float, settings: LabSettings, parameters: Mapping[str, float], out: Path | None,
    swarm: SwarmConfig | None,
) -> dict[str, Any]:  # fmt: skip
    flight: Any
    if swarm is None:
        flight = lab = Laboratory(app, settings, out)
    else:
        from .onboard import OnboardSwarm  # the log: others do without

        flight = OnboardSwarm(swarm, settings, out, key_of(swarm), app=app)
        lab = flight.lab
    with lab:
        agents = range(1, lab.settings.agents + 1)
        for name, value in parameters.items():
            for agent in agents:
                lab.set_parameter(agent, name, value)
        lab.run(seconds)
        logs = {str(agent): lab.logs(agent) for agent in agents}
        return {**flight.summary(), "console": lab.record.console, "warnings": lab.warnings, "logs": logs}


def main() -> int:
    """The process: a request on standard input, the answer on standard output."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    answer: dict[str, Any] | DtsaError
    try:
        answer = _fly(*pickle.loads(sys.stdin.buffer.read()))
    except DtsaError as error:
        answer = error
    sys.stdout.buffer.write(pickle.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
