"""Agents over UDP that fly RotorPy's Crazyflies, in another process, by odometry and velocities."""

from __future__ import annotations

import importlib.util
import json
import os
import random
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dtsa_bench.runs.config import RunLimits
from dtsa_dev.soak.checks import met
from dtsa_dev.soak.faults.by_hand import AGENT, nodes
from dtsa_dev.soak.item import Item, NotMet
from dtsa_dev.soak.nodes import node_environment

_FLY_S = 40.0  # at most
_PATIENCE_S = 300.0


def missing() -> str:
    """Why it cannot be flown here; empty: it can."""
    return "" if importlib.util.find_spec("rotorpy") else "RotorPy is not installed (extra `benchmark`)"


def items() -> Iterator[Item]:
    """Twelve vehicles."""
    yield Item("12 multirotors of RotorPy", {"agents": 12, "rotorpy": True}, 1, 90.0)


def run(item: Item, directory: Path) -> dict[str, Any]:
    """Flies until all have arrived.

    :param item: one of this module's.
    :param directory: an empty one.
    :raises NotMet: if one does not arrive, or two meet.
    """
    if why := missing():
        return {"not_flown": why}
    agents = item.settings["agents"]
    found = fly(agents, directory)
    met(found["arrived"] == agents, f"only {found['arrived']} of {agents} arrived: {found}")
    met(
        found["min_distance_m"] > RunLimits().collision_m,
        f"two vehicles came as close as {found['min_distance_m']:.2f} m",
    )
    return found


def fly(agents: int, directory: Path) -> dict[str, Any]:
    """One flight; what the vehicles did.

    :param agents: how many.
    :param directory: for what they say.
    :raises NotMet: if a process ends before it should.
    """
    draw = random.Random(os.getpid())
    group = f"239.255.{draw.randrange(256)}.{draw.randrange(1, 255)}:{draw.randrange(20_000, 30_000)}"
    result = directory / "world.json"
    shared = {"agents": agents, "air": "udp", "interface": "lo", "group": group, "auth": "false", "slot_ms": "20.0",
              "vehicle": "odometry"}  # fmt: skip
    with nodes(directory) as graph:
        for agent in range(1, agents + 1):
            own = {"id": agent, "odometry_topic": f"/uav{agent}/odom", "command_topic": f"/uav{agent}/cmd_vel"}
            graph.start(
                AGENT, *(word for key, value in {**shared, **own}.items() for word in ("-p", f"{key}:={value}"))
            )
        words = [sys.executable, "-m", "dtsa_dev.soak.air.multirotors", str(agents), str(_FLY_S), str(result)]
        with (directory / "world.txt").open("wb") as said:
            world = subprocess.Popen(words, env=node_environment(graph.domain, directory), stderr=said)
        try:
            world.wait(_PATIENCE_S)
        except subprocess.TimeoutExpired:
            raise NotMet(f"the vehicles still fly after {_PATIENCE_S:g} s") from None
        finally:
            world.kill()
            world.wait()
        met(result.is_file(), f"the vehicles' process has ended: {(directory / 'world.txt').read_text()[-300:]}")
        for process in graph.all:
            met(process.poll() is None, f"an agent has ended: {graph.said(process)[-300:]}")
            process.send_signal(signal.SIGTERM)
        for process in graph.all:
            graph.end(process, 0)
    return dict(json.loads(result.read_text(encoding="utf-8")))
