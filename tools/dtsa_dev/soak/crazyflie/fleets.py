"""Simulated Crazyflies as a process of their own, with the swarm's YAML that reaches them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dtsa_agent.ros.common.process.priority import take_priority
from dtsa_bench.crazyflies.simulated.process import FleetError, free_base_port, running_fleet, send_fault
from dtsa_bench.crazyflies.simulated.truth import read_truth
from dtsa_dev.soak.item import NotMet

CHANNELS = (20, 50, 80)  # one a dongle
STATION_PRIORITY = 20


@contextmanager
def station_priority() -> Iterator[None]:
    """This process is a ground station meanwhile: it runs before ordinary work, where that is allowed."""
    take_priority(STATION_PRIORITY)
    try:
        yield
    finally:
        take_priority(0)


@dataclass(frozen=True, slots=True)
class RunningFleet:
    """Simulated Crazyflies that run."""

    config: Path  # the swarm's YAML
    radio: Path | None  # socket of the simulated radios
    truth: Path
    control: int  # UDP port

    def fault(self, name: str, cf: object = "all", **numbers: Any) -> float:
        """Let one fail; the fleet's time, s."""
        return float(send_fault(("127.0.0.1", self.control), fault=name, cf=cf, **numbers)["t"])

    def events(self) -> list[dict[str, Any]]:
        """What has happened so far."""
        return read_truth(self.truth)[2]


def swarm(count: int, *, radio: bool, base_port: int, station: dict[str, Any]) -> dict[str, Any]:
    """A swarm's YAML, as data: everybody on the ellipse of the paper's room, over three dongles or UDP.

    :param count: Crazyflies.
    :param radio: over dongles.
    :param base_port: UDP port of the first.
    :param station: settings of the station.
    """
    robots = {}
    for k in range(count):
        dongle, angle = k * len(CHANNELS) // count, 2 * math.pi * k / count
        over = f"radio://{dongle}/{CHANNELS[dongle]}/2M/E7E7E7E7{k + 1:02X}"
        robots[f"cf{k + 1}"] = {
            "uri": over if radio else f"udp://127.0.0.1:{base_port + k}",
            "initial_position": [round(1.2 * math.cos(angle), 3), round(2.0 * math.sin(angle), 3), 0.0],
        }
    return {"robots": robots, "all": {"command_rate_hz": 50, "log_rate_hz": 50}, "station": station}


@contextmanager
def running(
    directory: Path, count: int, loss: float | None, options: list[str], station: dict[str, Any]
) -> Iterator[RunningFleet]:
    """Simulated Crazyflies that end with this.

    :param directory: for their files.
    :param loss: share of packets lost on the air; None: over UDP.
    :param options: more options of `fake-crazyflie`.
    :param station: settings of the station.
    :raises NotMet: they do not start.
    """
    import yaml

    base = free_base_port(count)
    data = swarm(count, radio=loss is not None, base_port=base, station=station)
    config, truth = directory / "swarm.yaml", directory / "truth.jsonl"
    config.write_text(yaml.safe_dump(data), encoding="utf-8")
    words = ["--config", str(config), "--base-port", str(base), "--truth", str(truth), *options]
    radio = None
    if loss is not None:
        radio = directory / "radio"
        words += ["--simulated-radio", str(radio), "--radio-loss", str(loss)]
    else:
        words = [word for word in words if word not in ("--base-port", str(base))]  # the URIs say it
    try:
        with running_fleet(words):
            yield RunningFleet(config, radio, truth, base - 1)
    except FleetError as error:
        raise NotMet(str(error)) from error
