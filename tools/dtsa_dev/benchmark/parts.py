"""What is measured:

kernels, whole slots, whole flights, environments for learning, nodes in lockstep, the growth with the number of agents,
the Crazyflie bridge.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from dtsa_agent.core import Swarm, SwarmConfig, _kernel
from dtsa_agent.core.frame import Frame, decode_frame, encode_frame
from dtsa_bench.experiments.sweep.spec import run_config
from dtsa_bench.simulation.simulate import simulate

from . import crazyflie as bridge
from . import environments as learning
from .baselines import NotHere, baseline
from .crazyflie import crazyflie as crazyflie
from .environments import environments as environments

Row = dict[str, Any]
SIZES = (18, 70, 200)
POLICIES = ("tdma", "age", "dtsa")
NODES = "nodes in lockstep"
NODE_TARGETS = ((4, 4, None), (12, 12, 200.0), (18, 1, 500.0), (70, 2, 200.0))  # agents, processes, slots/s
NODE_SLOTS, NODE_REPEATS = 1000, 3
COST_SIZES = (10, 20, 40, 70, 100, 140, 200, 280, 400)


def seconds(call: Callable[[], object], least_s: float = 0.1) -> float:
    """Median time of one call, s:

    batches of about a hundredth of ``least_s`` each, for ``least_s`` in all.
    """
    begun = time.perf_counter()
    call()
    once = max(time.perf_counter() - begun, 1e-8)
    batch = max(1, int(least_s / 100 / once))
    samples = []
    end = time.perf_counter() + least_s
    while time.perf_counter() < end or len(samples) < 5:
        begun = time.perf_counter()
        for _ in range(batch):
            call()
        samples.append((time.perf_counter() - begun) / batch)
    return statistics.median(samples)


def kernels() -> Iterator[Row]:
    """The priorities g of all agents, and the frame's codec."""
    yield from map(_priorities, SIZES)
    frame = Frame(7, 1234, 1, (1.0, -2.0, 0.5), (0.3, 0.2, -0.1))
    data = encode_frame(frame)
    yield {"what": "frame encoded", "ours_us": 1e6 * seconds(lambda: encode_frame(frame))}
    yield {"what": "frame decoded", "ours_us": 1e6 * seconds(lambda: decode_frame(data))}


def _priorities(agents: int) -> Row:
    random = np.random.default_rng(1)
    p, v = random.normal(size=(2, 3, agents)) * np.array([[[5.0]], [[1.0]]])
    row: Row = {"what": "priorities of all", "agents": agents}
    row["ours_us"] = 1e6 * seconds(lambda: _kernel.priority(p.tobytes(), v.tobytes(), 0.01))
    return row


def avoidance() -> Iterator[Row]:
    """The avoidance step of all agents alone, and the motion step, against pyrvo and RotorPy."""
    try:
        measure = baseline("pyrvo_step").measure
        for agents in SIZES:
            row: Row = {"what": "avoidance of all", **measure(agents)}
            yield {**row, "ratio": row["pyrvo_ten_us"] / row["ours_us"]}
    except NotHere as missing:
        yield {"what": "avoidance of all", "left_out": str(missing)}
    try:
        module = baseline("rotorpy_step")
        one = module.time_rotorpy()
        for agents in SIZES:
            yield {"what": "motion of all", **module.measure(agents, one)}
    except NotHere as missing:
        yield {"what": "motion of all", "left_out": str(missing)}


def slots(avoided: list[Row]) -> Iterator[Row]:
    """A whole slot, averaged over a flight, against pyrvo's avoidance alone.

    :param avoided: rows of :func:`avoidance`.
    """
    pyrvo = {row["agents"]: row for row in avoided if "pyrvo_ten_us" in row}
    for agents in SIZES:
        for policy in POLICIES:
            mean, count = slot_us(agents, policy)
            row: Row = {"what": "whole slot", "agents": agents, "policy": policy, "core_us": mean, "slots": count}
            for setting in ("ten", "customary"):
                if agents in pyrvo:
                    row[f"pyrvo_{setting}_us"] = pyrvo[agents][f"pyrvo_{setting}_us"]
            if agents in pyrvo:
                row["pyrvo_ratio"] = row["pyrvo_ten_us"] / row["core_us"]
                row["share_of_pyrvo"] = row["core_us"] / row["pyrvo_ten_us"]
            yield row


def slot_us(agents: int, policy: str, most_slots: int = 4000, least_s: float = 0.2) -> tuple[float, int]:
    """Mean time of a whole slot over a flight with all agents moving, us, and the number of slots flown.

    :param agents: N.
    :param policy: a policy that lets all agents share a table.
    :param most_slots: slots after which the flight is cut off.
    :param least_s: short flights are repeated for so long; the fastest counts, others were disturbed.
    """
    config = SwarmConfig(agents=agents, moving=agents - agents % 2, policy=policy)
    swarm = Swarm(config, shared_table=True)
    scenario = swarm.scenario
    way = float(np.linalg.norm(scenario.target - scenario.start, axis=0).max())
    count = min(most_slots, int((way / 1.5 + 2.0) / config.slot_s))
    times: list[float] = []
    while not times or sum(times) < least_s:
        swarm.reset()
        scenario.advance(0, swarm)
        begun = time.perf_counter()
        for slot in range(count):
            frames = [swarm.frame(index) for index in swarm.begin(slot)]
            swarm.fly(slot)
            for data in frames:
                swarm.hear(slot, data)
            swarm.end(slot)
        times.append(time.perf_counter() - begun)
    return 1e6 * min(times) / count, count


def cost() -> Iterator[Row]:
    """The cost of a slot against the number of agents."""
    for agents in COST_SIZES:
        for policy in POLICIES:
            mean, count = slot_us(agents, policy)
            yield {"what": "cost", "agents": agents, "policy": policy, "core_us": mean, "slots": count}


FLIGHTS: tuple[tuple[dict[str, Any], float], ...] = (
    ({"agents": 18, "policy": "tdma"}, 0.008),
    ({"agents": 18, "policy": "dtsa"}, 0.008),
    ({"agents": 18, "policy": "dtsa", "avoider": "potential"}, 0.008),
    ({"agents": 70, "policy": "tdma"}, 0.1),
    ({"agents": 70, "policy": "dtsa"}, 0.1),
    ({"agents": 70, "policy": "tdma", "loss": 0.1}, 5.0),
    ({"agents": 70, "policy": "dtsa", "loss": 0.1, "stop_on_crash": False, "timeout_s": 20.0}, 5.0),
)


def flights(repeats: int = 12) -> Iterator[Row]:
    """Whole flights as `simulate` flies them, metrics included; the limit is what the project asks of itself.

    :param repeats: flights of each kind, of which the fastest counts (others were disturbed).
    """
    for settings, limit in FLIGHTS:
        run = run_config({**settings, "seed": 1})
        times, flight = [], None
        for _ in range(repeats if limit < 1 else 2):
            begun = time.perf_counter()
            flight = simulate(run)
            times.append(time.perf_counter() - begun)
        assert flight is not None
        summary = flight.summary()
        yield {
            "what": "flight",
            **settings,
            "end": summary["end"],
            "slots": summary["slots"]["total"],
            "best_ms": 1e3 * min(times),
            "median_ms": 1e3 * statistics.median(times),
            "limit_ms": 1e3 * limit,
            "realtime_factor": summary["flight_time_s"] / min(times),
        }


def nodes() -> Iterator[Row]:
    """Real nodes in lockstep, recorded, and beside one process an agent the same round of messages without protocol."""
    try:
        import rclpy  # noqa: F401

        from dtsa_bench.flights.flight import fly
        from dtsa_bench.flights.options import FlightOptions

        from .bare_round import rounds_per_s
    except ImportError as error:
        yield {"what": NODES, "left_out": f"{error}"}
        return
    for agents, processes, limit in NODE_TARGETS:
        run = run_config({"agents": agents, "timeout_s": NODE_SLOTS / 100, "stop_on_crash": False})
        rates, bare = [], []
        for _ in range(NODE_REPEATS):
            with tempfile.TemporaryDirectory() as place:
                options = FlightOptions(processes=processes, pictures=False)
                summary = fly(run, Path(place) / "flight", options, label="benchmark").summary
            rates.append(summary["slots"]["total"] / summary["wall_time_s"])
            if processes == agents:  # in turn: what else the machine does changes from minute to minute
                bare.append(rounds_per_s(processes, NODE_SLOTS, 2)[-1])  # the first ones are slower
        row = {
            "what": NODES,
            "agents": agents,
            "processes": processes,
            "slots": summary["slots"]["total"],
            "slots_per_s": max(rates),
            "median_per_s": statistics.median(rates),
            "limit_per_s": limit,
        }
        if bare:
            row["bare_rounds_per_s"] = statistics.median(bare)
            row["ratios"] = [round(rounds / slots, 3) for rounds, slots in zip(bare, rates, strict=True)]
            row["ratio"] = statistics.median(row["ratios"])
        yield row


def targets(rows: list[Row]) -> list[Row]:
    """What the project asks of itself, and whether this run met it.

    :param rows: of all parts.
    """
    found = []
    for row in rows:
        if row["what"] == "flight":
            names = [f"{key} {value}" for key, value in row.items() if key in ("policy", "avoider", "loss")]
            what = f"flight of {row['agents']}, {', '.join(names)} [ms]"
            found.append(_target(what, row["best_ms"], row["limit_ms"]))
        elif row["what"] == "whole slot" and "share_of_pyrvo" in row:
            what = f"whole slot of {row['agents']}, {row['policy']}, over pyrvo's avoidance alone"
            many = row["policy"] == "dtsa" and row["agents"] > 70
            found.append(_target(what, row["share_of_pyrvo"], 1.0 if many else 0.5))
        elif row["what"] == NODES and row.get("limit_per_s"):
            what = f"nodes in lockstep, {row['agents']} agents, processes: {row['processes']} [slots/s]"
            found.append(_target(what, row["slots_per_s"], row["limit_per_s"], least=True))
            if "ratio" in row:
                found.append(_target(f"bare rounds over slots, {row['agents']} processes", row["ratio"], 2.5))
        elif row["what"] == bridge.WHAT and "left_out" not in row:
            found += [_target(*target) for target in bridge.targets(row)]
        elif row["what"] == learning.WHAT:
            found += [_target(*target) for target in learning.targets(row)]
    return found


def _target(what: str, value: float, limit: float, least: bool = False) -> Row:
    return {"target": what, "value": value, "limit": limit, "met": value >= limit if least else value <= limit}
