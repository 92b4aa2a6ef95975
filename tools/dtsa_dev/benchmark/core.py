"""Kernels, whole slots and whole flights, beside NumPy and pyrvo.

pyrvo's ORCA step (RVO2, C++, two dimensions) is timed beside ours (three dimensions) on the very same states: those of
a flight of our own in which N agents exchange places across a circle and everyone knows everything. Every few control
instants position, velocity and preferred velocity of all agents are handed to pyrvo, and one `do_step` is timed
(neighbour search, half-planes, linear programs, moving). Its settings: neighbours within 3.336 m = R_c + 2 v_max T, at
most ten (RVO2's customary limit), horizon 1 s; radius (half of R_c), largest speed and time step are ours.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # pyrvo: one thread, as ours

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.core.frame import Frame, decode_frame, encode_frame
from dtsa_agent.core.kernel import lib, memory
from dtsa_agent.core.settings.flight_models import FLIGHT_MODELS
from dtsa_bench.experiments.sweep import run_config
from dtsa_bench.simulation.simulate import simulate

from . import Measurement

Array = NDArray[np.float64]
State = tuple[Array, Array, Array]  # position, velocity, preferred velocity, each (3, N)

SIZES = (18, 70, 200)
POLICIES = ("tdma", "age", "dtsa")
STEP_S = 0.01
MODEL = FLIGHT_MODELS["orca"]
REACH_M = MODEL.avoider.radius + 2 * MODEL.avoider.v_max * MODEL.avoider.horizon
#: Whole flights, and the time that they may take, s.
FLIGHTS: tuple[tuple[dict[str, Any], float], ...] = (
    ({"agents": 18, "policy": "tdma"}, 0.008),
    ({"agents": 18, "policy": "dtsa"}, 0.008),
    ({"agents": 18, "policy": "dtsa", "avoider": "potential"}, 0.008),
    ({"agents": 70, "policy": "tdma"}, 0.1),
    ({"agents": 70, "policy": "dtsa"}, 0.1),
    ({"agents": 70, "policy": "tdma", "loss": 0.1}, 5.0),
    ({"agents": 70, "policy": "dtsa", "loss": 0.1, "stop_on_crash": False, "timeout_s": 20.0}, 5.0),
)


def seconds(call: Callable[[], object], least_s: float = 0.1) -> float:
    """Median time of one call, s, of batches of about a hundredth of ``least_s`` each, for ``least_s`` in all."""
    start = time.perf_counter()
    call()
    batch = max(1, int(least_s / 100 / max(time.perf_counter() - start, 1e-8)))
    samples: list[float] = []
    end = time.perf_counter() + least_s
    while time.perf_counter() < end or len(samples) < 5:
        start = time.perf_counter()
        for _ in range(batch):
            call()
        samples.append((time.perf_counter() - start) / batch)
    return statistics.median(samples)


def kernels() -> Iterator[Measurement]:
    """The priorities g of all agents beside vectorised NumPy, the frame's codec, and avoidance beside pyrvo's."""
    for agents in SIZES:
        p, v = np.random.default_rng(1).normal(size=(2, agents, 3)) * np.array([[[5.0]], [[1.0]]])
        g, call = _priorities(p, v)
        call()
        assert np.allclose(g, _numpy_priority(p, v, STEP_S), rtol=1e-9)
        ours, plain = (1e6 * seconds(f) for f in (call, partial(_numpy_priority, p, v, STEP_S)))
        yield Measurement(f"priorities of all, N = {agents}", f"{ours:.3g} us", f"NumPy {plain:.3g} us", ours / plain)
    frame = Frame(7, 1234, 1, (1.0, -2.0, 0.5), (0.3, 0.2, -0.1))
    data = encode_frame(frame)
    yield Measurement("a frame encoded", f"{1e6 * seconds(lambda: encode_frame(frame)):.3g} us")
    yield Measurement("a frame decoded", f"{1e6 * seconds(lambda: decode_frame(data)):.3g} us")
    for agents in SIZES:
        ours, pyrvo = _avoidance_us(agents)
        other = {"other": f"pyrvo {pyrvo:.3g} us", "ratio": ours / pyrvo} if pyrvo else {"other": "pyrvo is missing"}
        yield Measurement(f"avoidance of all, N = {agents}", f"{ours:.3g} us", **other)


def _priorities(position: Array, velocity: Array) -> tuple[Array, Callable[[], object]]:
    """The array of the values g of all agents, and the call that fills it."""
    agents = len(position)
    p, v = np.ascontiguousarray(position.T), np.ascontiguousarray(velocity.T)
    g, scratch = np.zeros(agents), np.zeros(lib.priority_scratch_doubles(agents))
    arrays = [memory(array) for array in (p, v, g, scratch)]
    return g, lambda: lib.priority_values(agents, STEP_S, *arrays)


def _numpy_priority(position: Array, velocity: Array, slot_s: float) -> Array:
    """The same values in NumPy (eq:permission_d_p_ang)."""
    p, v = position[None] - position[:, None], velocity[:, None] - velocity[None]
    distance, speed = np.linalg.norm(p, axis=2), np.linalg.norm(v, axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.clip((p * v).sum(axis=2) / (distance * speed), -1.0, 1.0)
        eta = speed * slot_s / distance * (1.0 - np.arccos(cosine) / np.pi)
    return np.asarray(np.nan_to_num(eta).sum(axis=1))


def _knowing_swarm(agents: int) -> Swarm:
    """A swarm that knows everything; one control instant a slot."""
    config = SwarmConfig(agents=agents, avoider="orca", estimator="oracle", seed=1)
    assert config.slot_s / config.steps == STEP_S
    return Swarm(config, shared_table=True)


def _flight_states(agents: int, every: int = 10) -> tuple[list[State], Array]:
    """States of a whole flight with perfect knowledge, every so many control instants; and the goals."""
    swarm, params = _knowing_swarm(agents), MODEL.avoider
    position, velocity, goal = swarm.position, swarm.velocity, swarm.goal
    states: list[State] = []
    for step in range(100_000):
        if step % every == 0:
            away = params.gain * (goal - position)
            speed = np.maximum(np.linalg.norm(away, axis=0), 1e-9)
            states.append((position.copy(), velocity.copy(), away * np.minimum(1.0, params.v_max / speed)))
        swarm.fly(0)
        if np.all(np.linalg.norm(goal - position, axis=0) < 0.3):
            break
    return states, goal.copy()


@cache
def _avoidance_us(agents: int, repeats: int = 5) -> tuple[float, float | None]:
    """Time of the avoidance step and the motion of all agents, us: mean over a flight of the medians of each state.

    :returns: ours, pyrvo's (None: it is not installed).
    """
    states, goal = _flight_states(agents)
    swarm = _knowing_swarm(agents)
    swarm.goal[:] = goal

    def place_ours(state: State) -> None:
        swarm.position[:], swarm.velocity[:] = state[0], state[1]

    ours = _mean_of_medians(states, place_ours, lambda: swarm.fly(0), repeats)
    try:
        import pyrvo
    except ImportError:
        return ours, None
    radius, speed, horizon = MODEL.avoider.radius / 2, MODEL.avoider.v_max, MODEL.avoider.horizon
    simulator = pyrvo.RVOSimulator(STEP_S, REACH_M, 10, horizon, horizon, radius, speed)
    for x, y in states[0][0][:2].T:
        simulator.add_agent((float(x), float(y)))

    def place_pyrvo(state: State) -> None:
        position, velocity, wish = state
        for k in range(agents):
            simulator.set_agent_position(k, (float(position[0, k]), float(position[1, k])))
            simulator.set_agent_velocity(k, (float(velocity[0, k]), float(velocity[1, k])))
            simulator.set_agent_pref_velocity(k, (float(wish[0, k]), float(wish[1, k])))

    return ours, _mean_of_medians(states, place_pyrvo, simulator.do_step, repeats)


def _mean_of_medians(
    states: list[State], put: Callable[[State], None], step: Callable[[], object], repeats: int
) -> float:
    times = []
    for state in states:
        samples = []
        for _ in range(repeats):
            put(state)
            start = time.perf_counter()
            step()
            samples.append(time.perf_counter() - start)
        times.append(statistics.median(samples))
    return 1e6 * statistics.fmean(times)


def slots() -> Iterator[Measurement]:
    """A whole slot (policy, estimates, avoider, physics), averaged over a flight, beside pyrvo's avoidance alone."""
    for agents in SIZES:
        _, pyrvo = _avoidance_us(agents)
        for policy in POLICIES:
            ours = slot_us(agents, policy)
            row = Measurement(f"whole slot, {policy}, N = {agents}", f"{ours:.3g} us")
            if pyrvo:
                limit = 1.0 if policy == "dtsa" and agents > 70 else 0.5
                row = row._replace(
                    other=f"pyrvo's avoidance alone {pyrvo:.3g} us", ratio=ours / pyrvo, target=f"<= {limit:g}",
                    met=ours / pyrvo <= limit,
                )  # fmt: skip
            yield row


def slot_us(agents: int, policy: str, most_slots: int = 4000, least_s: float = 0.2) -> float:
    """Mean time of a whole slot over a flight with all agents moving, us; the policy lets all agents share a table.

    A flight is cut off after `most_slots`. Short ones are repeated for `least_s`: the fastest counts, others were
    disturbed.
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
        start = time.perf_counter()
        for slot in range(count):
            swarm.complete(slot, swarm.begin(slot))
        times.append(time.perf_counter() - start)
    return 1e6 * min(times) / count


def flights(repeats: int = 12) -> Iterator[Measurement]:
    """Whole flights as `simulate` flies them, metrics included: the fastest of each; and the time to set one up."""
    for settings, limit_s in FLIGHTS:
        best = _fastest(settings, repeats if limit_s < 1 else 2)
        what = ", ".join(f"{key} {value}" for key, value in settings.items() if key not in ("agents", "timeout_s"))
        target = f"<= {1e3 * limit_s:g} ms"
        yield Measurement(
            f"flight of {settings['agents']}, {what}", f"{1e3 * best:.3g} ms", target=target, met=best <= limit_s
        )
    for settings, _ in (FLIGHTS[0], FLIGHTS[3]):
        whole, setup = _fastest(settings, repeats), _fastest({**settings, "timeout_s": STEP_S}, repeats)
        what = f"set-up and one slot of a flight of {settings['agents']}"
        yield Measurement(what, f"{1e3 * setup:.3g} ms", f"whole flight {1e3 * whole:.3g} ms", setup / whole)


def _fastest(settings: dict[str, Any], repeats: int) -> float:
    """Time of the fastest of some flights, s; others were disturbed."""
    run = run_config({**settings, "seed": 1})
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        simulate(run)
        times.append(time.perf_counter() - start)
    return min(times)
