"""A flight in a process of its own, which an app that crashes ends alone."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.crazyflie.settings.on_board import key_of
from dtsa_bench.crazyflies.simulated.radio.settings import RadioSettings

from .app import read_app
from .compiling import CompileError, sanitizer_environment
from .engine import AppError
from .laboratory import Laboratory
from .live import Live
from .settings import LabSettings

_CRASHED = 70  # native/crash.c
_HEAD = "peer-lab: "


def fly(
    place: str,
    seconds: float,
    settings: LabSettings | None = None,
    *,
    sources: tuple[str, ...] = (),
    include: tuple[str, ...] = (),
    flags: tuple[str, ...] = (),
    parameters: Mapping[str, float] | None = None,
    out: Path | None = None,
    swarm: Mapping[str, Any] | None = None,
    live: RadioSettings | None = None,
    ground: bool = True,
) -> dict[str, Any]:
    """Fly an app; the summary, with `console` (what the apps printed), `warnings` (compiler, sanitizers), `logs`.

    :param place: directory of the app, or the name of one that comes with the laboratory.
    :param seconds: s, virtual time.
    :param settings: vehicles, air and ground; start positions must be the default.
    :param sources: further C files. :param include: further directories. :param flags: further ones of the compiler.
    :param parameters: values of the app's parameters, beside those of app.yaml.
    :param out: directory for files.
    :param swarm: settings of the swarm that flies the protocol on board; None: the app is another one.
    :param live: dongles for the ground's programs, and real time; None: virtual time.
    :param ground: with a swarm: it is played here; else one of those programs does that.
    :raises ConfigError: a setting is not usable. :raises CompileError: the app does not compile.
    :raises AppError: an app crashed, or did what no app may do.
    """
    app = read_app(place, sources=sources, include=include, flags=flags)  # mistakes are said before a process starts
    settings = settings or LabSettings()
    values = {name: value for name, value in settings.to_dict().items() if name != "start"}
    request = {
        "place": place, "seconds": seconds, "settings": values, "sources": sources, "include": include, "flags": flags,
        "parameters": dict(parameters or {}), "out": None if out is None else str(out),
        "swarm": None if swarm is None else dict(swarm),
        "live": None if live is None else {"path": str(live.path), "dongles": live.dongles},
        "ground": ground,
    }  # fmt: skip
    command = [sys.executable, "-m", "dtsa_bench.crazyflies.peer_lab.process"]
    environment = {**os.environ, **sanitizer_environment(app)}
    before = signal.signal(signal.SIGINT, signal.SIG_IGN) if live is not None else None  # the flight ends by it
    try:
        done = subprocess.run(
            command, input=json.dumps(request), capture_output=True, text=True, check=False, env=environment
        )
    finally:
        if before is not None:
            signal.signal(signal.SIGINT, before)
    lines = done.stderr.splitlines()
    said = next((line.removeprefix(_HEAD) for line in reversed(lines) if line.startswith(_HEAD)), None)
    if done.returncode == _CRASHED and said is not None:
        raise AppError(said)
    answer = json.loads(done.stdout) if done.returncode == 0 else None
    if answer is None:
        if done.returncode == -signal.SIGINT:
            raise KeyboardInterrupt
        found = [line for line in lines if "ERROR: " in line or "runtime error: " in line]  # a sanitizer's
        last = (found or lines or ["it said nothing"])[-1]
        raise AppError(f"the laboratory's process ended with {done.returncode}: {last}")
    if "error" not in answer:
        return {**answer, "warnings": answer["warnings"] + done.stderr}
    raise {"CompileError": CompileError, "AppError": AppError}.get(answer["kind"], DtsaError)(answer["error"])


def _serve(request: dict[str, Any]) -> dict[str, Any]:
    paths = {key: tuple(request[key]) for key in ("sources", "include", "flags")}
    app = read_app(request["place"], **paths)
    out = None if request["out"] is None else Path(request["out"])
    settings, seconds = LabSettings(**request["settings"]), request["seconds"]
    live = _live(request["live"], settings) if request["live"] is not None else None
    side = None if live is None else live.side
    finish: Callable[[], dict[str, Any]]
    if request["swarm"] is not None:
        from .onboard import OnBoard  # recordings: others do without

        swarm = SwarmConfig.from_dict(request["swarm"])
        flight = OnBoard(swarm, settings, out, key_of(swarm), radio=side, ground=request["ground"])
        lab, finish = flight.lab, flight.finish
    else:
        lab = Laboratory(app, settings, out, radio=side)
        finish = lab.summary
    try:
        for name, value in request["parameters"].items():
            for agent in range(1, lab.settings.agents + 1):
                lab.set_parameter(agent, name, value)
        if live is None:
            lab.run(seconds)
        else:
            live.attach(lab)
            live.run(seconds)
        late = {} if live is None else {"lost_s": round(live.lost_s, 3)}
        return {**finish(), **late, **_told(lab)}
    finally:
        lab.close()
        if live is not None:
            live.close()


def _live(request: dict[str, Any], settings: LabSettings) -> Live:
    live = Live(settings, RadioSettings(dongles=request["dongles"], path=Path(request["path"])))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: live.stop())
    return live


def _told(lab: Laboratory) -> dict[str, Any]:
    logs = {str(agent): dict(lab.logs(agent)) for agent in range(1, lab.settings.agents + 1)}
    return {"console": lab.record.console, "warnings": lab.warnings, "logs": logs}


def main() -> int:
    """The process: a request on standard input, the answer on standard output."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        answer = _serve(json.loads(sys.stdin.read()))
    except ConfigError as error:
        answer = {"kind": "ConfigError", "error": str(error)}
    except DtsaError as error:
        answer = {"kind": type(error).__name__, "error": str(error)}
    print(json.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main())
