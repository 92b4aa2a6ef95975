"""The Crazyflie bridge under full load: its process, the real cflib, real UDP, simulated Crazyflies at the far end."""

from __future__ import annotations

import importlib.util
import os
import re
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import DtsaError
from dtsa_agent.crazyflie.links.link import SIMULATED_RADIO

Row = dict[str, Any]
WHAT = "crazyflie bridge"
COUNT = 12
DONGLES = 3
RATE_HZ = 50.0
SETTLE_S = 2.0
MEASURE_S = 10.0
HEIGHT_M = 0.95
TAKEOFF_S = 2.5
PATIENCE_S = 60.0  # for each step of the preparations


class BenchmarkError(DtsaError):
    """The bridge did not do what it was asked to."""


def crazyflie(count: int = COUNT, measure_s: float = MEASURE_S) -> Iterator[Row]:
    """Connect, fly and close a swarm through the bridge, with commands and logs at 50 Hz for each.

    :param count: Crazyflies.
    :param measure_s: time for which rates, latency and load are measured, s.
    """
    for package, hint in (("cflib", "tools/dtsa setup --extra cflib"), ("rclpy", "tools/dtsa setup")):
        if importlib.util.find_spec(package) is None:
            yield {"what": WHAT, "left_out": f"{package} is not installed: {hint}"}
            return
    yield measure(count, measure_s)


def measure(
    count: int, measure_s: float, safety: Mapping[str, float] | None = None, *, loss: float | None = None
) -> Row:
    """One flight.

    Commands leave in bursts, one for each Crazyflie every 20 ms, as a swarm's agents send them. The latency is from
    just before the publication in this process to the arrival of the datagram, as the kernel notes it. The tables of
    variables are not cached; the time to close is that to the end of the bridge's process.

    Over the air the arrival is the end of the packet on the air.

    :param safety: the bridge's limits that are not the defaults.
    :param loss: share of packets lost on the air of three simulated dongles; None: over UDP.
    :raises BenchmarkError: the bridge, or somebody in its care, does not get as far as that.
    """
    from dtsa_bench.crazyflies.simulated.process import free_base_port
    from dtsa_bench.flights.children import Children
    from dtsa_bench.flights.domain import ros_domain

    from .crazyflie_pilot import Pilot
    from .stamped_fleet import READY

    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with tempfile.TemporaryDirectory() as place, ros_domain() as domain:
        folder = Path(place)
        environment = {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": place}
        base = free_base_port(count)
        arrivals = folder / "arrivals.npy"
        socket = folder / "radio"
        over = {} if loss is None else {SIMULATED_RADIO: str(socket)}
        far, near = Children(folder, environment), Children(folder, environment | over)
        pilot = Pilot(domain, count)
        try:
            config = _swarm_yaml(folder, count, base, safety or {}, air=loss is not None)
            words = [str(count), str(base), str(arrivals)]
            if loss is not None:
                words += [str(config), str(socket), str(loss)]
            far.start("fleet", [], "dtsa_dev.benchmark.stamped_fleet", words)
            _until("the simulated Crazyflies", lambda: READY in far.all[0].log.read_text(), far.check)
            near.start("bridge", [], "dtsa_agent.crazyflie.node.bridge_node", ["--ros-args", "-p", f"config:={config}"])
            bridge = near.all[0]

            def step(what: str, condition: Callable[[], object]) -> None:
                _until(what, condition, near.check, lambda: pilot.spin(0.05))

            step("the connections", pilot.ready)
            pilot.take_off(step, HEIGHT_M, TAKEOFF_S)
            pilot.stream(RATE_HZ, SETTLE_S)
            received, used = pilot.received(), [_cpu_s(child.process.pid) for child in (bridge, far.all[0])]
            begun = time.monotonic()
            published = pilot.stream(RATE_HZ, measure_s)
            lasted = time.monotonic() - begun
            used = [_cpu_s(child.process.pid) - s for child, s in zip((bridge, far.all[0]), used, strict=True)]
            logs = pilot.log_rates(received)
            pilot.land(step, TAKEOFF_S)
            closing = time.monotonic()
            bridge.process.send_signal(signal.SIGINT)
            bridge.process.wait(PATIENCE_S)
            close_s = time.monotonic() - closing
            far.all[0].process.send_signal(signal.SIGINT)
            far.all[0].process.wait(PATIENCE_S)
            connected = re.search(rf"{count} of {count} connected in ([\d.]+) s", bridge.log.read_text())
            assert connected is not None  # else it would not have offered its services: min_connected
            return {
                "what": WHAT,
                "crazyflies": count,
                "connect_s": float(connected[1]),
                "close_s": close_s,
                **commands(published, np.load(arrivals) - (0, pilot.first, 0), count),
                "logs_hz": min(logs),
                "bridge_cpu_percent": 100 * used[0] / lasted,
                "fleet_cpu_percent": 100 * used[1] / lasted,
            }
        finally:
            pilot.close()
            near.stop()
            far.stop()


def commands(published: NDArray[np.float64], arrivals: NDArray[np.float64], count: int) -> Row:
    """Rate and latency of the commands that were published in the time of the measurement.

    :param published: time of each command by Crazyflie and number less the first one's, s, shape (count, n).
    :param arrivals: Crazyflie (from 0), number of the command less the first one's, time (s); shape (m, 3).
    :raises BenchmarkError: none arrived.
    """
    number = published.shape[1]
    arrivals = arrivals[(arrivals[:, 1] >= 0) & (arrivals[:, 1] < number)]
    if not len(arrivals):
        raise BenchmarkError("no command has arrived")
    who, which = arrivals[:, 0].astype(int), arrivals[:, 1].astype(int)
    latency = 1e3 * (arrivals[:, 2] - published[who, which])
    lasted = (published[:, -1] - published[:, 0]).mean() * number / (number - 1)
    median, p99 = np.percentile(latency, (50, 99))
    return {
        "commands_hz": float(np.bincount(who, minlength=count).min() / lasted),
        "latency_median_ms": float(median),
        "latency_p99_ms": float(p99),
    }


def targets(row: Row) -> Iterator[tuple[str, float, float, bool]]:
    """What the bridge has to reach.

    :returns: what, value, limit, whether the limit is the least (else the most) that is allowed.
    """
    who = f"{row['crazyflies']} Crazyflies: "
    yield f"{who}commands reached by each, at least [Hz]", row["commands_hz"], 48.0, True
    yield f"{who}logs reached by each, at least [Hz]", row["logs_hz"], 48.0, True
    yield f"{who}command to datagram, 99th percentile [ms]", row["latency_p99_ms"], 10.0, False
    yield f"{who}bridge, of one core [%]", row["bridge_cpu_percent"], 60.0, False
    yield f"{who}connect [s]", row["connect_s"], 3.0, False
    yield f"{who}close [s]", row["close_s"], 3.0, False


def _swarm_yaml(folder: Path, count: int, base: int, safety: Mapping[str, float], *, air: bool) -> Path:
    import yaml

    robots = {
        f"cf{k + 1}": {"uri": _radio_uri(k, count) if air else f"udp://127.0.0.1:{base + k}"} for k in range(count)
    }
    path = folder / "swarm.yaml"
    common = {"command_rate_hz": RATE_HZ, "log_rate_hz": RATE_HZ}
    station = {"min_connected": count, "toc_cache": str(folder / "cache"), "safety": dict(safety)}
    path.write_text(yaml.safe_dump({"robots": robots, "all": common, "station": station}), encoding="utf-8")
    return path


def _radio_uri(index: int, count: int) -> str:
    dongle = index * DONGLES // count
    return f"radio://{dongle}/{20 + 30 * dongle}/2M/E7E7E7E7{index + 1:02X}"


def _until(
    what: str, condition: Callable[[], object], check: Callable[[], None], serve: Callable[[], None] | None = None
) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        check()
        if time.monotonic() > deadline:
            raise BenchmarkError(f"{what} took longer than {PATIENCE_S:g} s")
        if serve is None:
            time.sleep(0.02)
        else:
            serve()


def _cpu_s(process: int) -> float:
    """Processor time that a process has used, s."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
