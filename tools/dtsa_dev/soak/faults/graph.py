"""Foreign publishers in a live flight: junk of every type of message, duplicates, other runs, replayed bags."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from dtsa_dev.soak.checks import flies_on, interrupted_well, met
from dtsa_dev.soak.flights import ENDLESS, PATIENCE_S, Running, command, dtsa, flying

from .fault import LOCKSTEP, REALTIME, Fault

_SLOT = ("/swarm/slot", "dtsa_msgs/msg/Slot")
_TRANSMISSION = ("/swarm/transmission", "dtsa_msgs/msg/Transmission")
_FRAME = ("/swarm/frame", "dtsa_msgs/msg/Frame")
_REPORT = ("/swarm/report", "dtsa_msgs/msg/Report")
_PROCESS = ("/swarm/process", "dtsa_msgs/msg/Process")
_ODOMETRY = ("/cf1/odom", "nav_msgs/msg/Odometry")
_CLOCK = ("/clock", "rosgraph_msgs/msg/Clock")
_OTHERS = (
    ("/swarm/reception", "dtsa_msgs/msg/Reception"),
    ("/swarm/decision", "dtsa_msgs/msg/Decision"),
    ("/swarm/status", "dtsa_msgs/msg/RunStatus"),
    ("/swarm/configuration", "dtsa_msgs/msg/Configuration"),
)


def _graph(flight: Running) -> dict[str, str]:
    """Environment of a process in the flight's domain."""
    found = flight.environment(flight.known[0])
    names = ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE", "RMW_IMPLEMENTATION")
    return {**os.environ, **{name: found[name] for name in names if name in found}}


def intrude(flight: Running, topic: tuple[str, str], *kinds: str) -> int:
    """Lets a foreign node publish on a topic of a flight; the number of its messages.

    :param flight: the flight.
    :param topic: name and type.
    :param kinds: of messages, see :mod:`dtsa_dev.soak.intruder`.
    """
    sent = 0
    for kind in kinds:
        done = subprocess.run(
            [sys.executable, "-m", "dtsa_dev.soak.intruder", *topic, kind, "1"],
            env=_graph(flight),
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
        )
        met(done.returncode == 0, f"the intruder failed: {done.stderr.strip()[-300:]}")
        sent += int(done.stdout)
    return sent


def _intruded(words: tuple[str, ...], *topics: tuple[str, str], kinds: tuple[str, ...]) -> Callable[[Path], None]:
    def run(directory: Path) -> None:
        with flying(directory, *words, *ENDLESS) as flight:
            for topic in topics:
                met(intrude(flight, topic, *kinds), f"nothing was published on {topic[0]}")
                met(flight.process.poll() is None, f"after {topic[0]}: {flight.said().strip()[-300:]}")
            flies_on(flight)
            interrupted_well(flight)

    return run


def _replayed(directory: Path) -> None:
    done = dtsa("fly", "--out", str(directory / "old"), *LOCKSTEP, "--timeout-s", "1", "--no-picture")
    met(done.returncode == 0, f"no flight: {done.stderr.strip()[-300:]}")
    with flying(directory / "live", *LOCKSTEP, *ENDLESS) as flight:
        played = subprocess.run(
            command("replay", str(directory / "old")), env=_graph(flight), capture_output=True, text=True,
            timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        met(played.returncode == 0, f"replay failed: {played.stderr.strip()[-300:]}")
        flies_on(flight)
        interrupted_well(flight)


_JUNK = ("bytes", "default", "random")
_UNHARMED = "dropped and counted; the flight goes on; the bag verifies"

FAULTS = (
    Fault("junk for the channel, lockstep", "junk on `/swarm/transmission`, lockstep: bytes, empty and random messages",
          _UNHARMED, _intruded(LOCKSTEP, _TRANSMISSION, kinds=_JUNK)),
    Fault("junk for the agents, lockstep", "junk on `/swarm/slot`, lockstep", _UNHARMED,
          _intruded(LOCKSTEP, _SLOT, kinds=_JUNK)),
    Fault("junk for the channel, real time", "junk on `/swarm/transmission`, real time", _UNHARMED,
          _intruded(REALTIME, _TRANSMISSION, kinds=_JUNK)),
    Fault("junk for the agents, real time", "junk on `/swarm/slot`, real time", _UNHARMED,
          _intruded(REALTIME, _SLOT, kinds=_JUNK)),
    Fault("junk frames, real time", "junk on `/swarm/frame`, real time", _UNHARMED,
          _intruded(REALTIME, _FRAME, kinds=_JUNK)),
    Fault("junk reports, real time", "junk on `/swarm/report`, real time", _UNHARMED,
          _intruded(REALTIME, _REPORT, kinds=_JUNK)),
    Fault("junk of processes", "junk on `/swarm/process`, by which nodes show each other what they fly with", _UNHARMED,
          _intruded(LOCKSTEP, _PROCESS, kinds=_JUNK)),
    Fault("junk on other topics of the swarm",
          "junk on `/swarm/reception`, `/swarm/decision`, `/swarm/status`, `/swarm/configuration`",
          "nobody in the flight believes it; the flight goes on; the bag verifies",
          _intruded(LOCKSTEP, *_OTHERS, kinds=("random",))),
    Fault("junk for odometry and clock", "junk on `/cf1/odom` and `/clock`",
          "nobody in the flight believes it; the flight goes on; the bag verifies",
          _intruded(LOCKSTEP, _ODOMETRY, _CLOCK, kinds=("random",))),
    Fault("duplicates, lockstep", "all answers and slot messages are published a second time, lockstep",
          "each counts once; the flight goes on; the bag verifies",
          _intruded(LOCKSTEP, _TRANSMISSION, _SLOT, kinds=("again",))),
    Fault("another run, lockstep", "answers and slot messages with the id of another run, lockstep", _UNHARMED,
          _intruded(LOCKSTEP, _TRANSMISSION, _SLOT, kinds=("foreign",))),
    Fault("another run, real time", "frames, reports and slot messages with the id of another run, real time",
          _UNHARMED, _intruded(REALTIME, _FRAME, _REPORT, _SLOT, kinds=("foreign",))),
    Fault("bag played into a flight", "`replay` of a bag into the domain of a live flight", _UNHARMED, _replayed),
)  # fmt: skip
