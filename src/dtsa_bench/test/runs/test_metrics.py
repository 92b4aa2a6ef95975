"""FlightMetrics against hand-made flights and against plain NumPy."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dtsa_agent.core import ConfigError, Scenario, Swarm, SwarmConfig, make_scenario
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_bench.runs.metrics import COMPLETED, CRASHED, TIMED_OUT, FlightMetrics, metrics_tables
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import Channel, ChannelConfig
from dtsa_channel_sim.model.airtime import RADIOS
from dtsa_channel_sim.model.verdict import COLLISION, IDLE, SUCCESS


def pair_on_a_line(**limits: float) -> tuple[FlightMetrics, Scenario]:
    """Agents 1 and 2 change places on the x axis, 4 m apart; agent 3 hovers beside."""
    start = np.array([[-2.0, 2.0, 0.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    target = start[:, [1, 0, 2]].copy()
    scenario = Scenario(start, target, np.array([True, True, False]))
    run = RunConfig(SwarmConfig(agents=3, moving=2, slot_ms=100.0), limits=RunLimits(**limits))
    return FlightMetrics(run, scenario), scenario


def along(scenario: Scenario, share: float, bulge: float = 0.0) -> np.ndarray:
    """Positions (3, N) when a share of the way is done, agents 1 and 2 passing at 2 * bulge."""
    now = scenario.start + share * (scenario.target - scenario.start)
    now[1, 0] += bulge * np.sin(np.pi * share)
    now[1, 1] -= bulge * np.sin(np.pi * share)
    return now


def test_completion_is_when_all_are_near_and_one_that_has_not_arrived_is_enough_to_time_out() -> None:
    metrics, scenario = pair_on_a_line(tail_s=0.5)
    ends = []
    for slot in range(40):
        share = min(1.0, (slot + 1) / 20)
        ends.append(metrics.update(slot, along(scenario, share, 1.0)[None], None, SUCCESS))
        if ends[-1]:
            break
    # 0.3 m of 4 m are left at share 0.925: true from slot 18's end (0.95) on, 19 slots flown; 5 more are the tail.
    summary = metrics.summary(2.4)
    assert ends[:-1] == [""] * (len(ends) - 1)
    assert ends[-1] == COMPLETED
    assert metrics.kernel.completion_slot == 19
    assert summary["completion_time_s"] == pytest.approx(1.9)
    assert summary["flight_time_s"] == pytest.approx(2.4)
    assert summary["slots"] == {"total": 24, "success": 24, "collision": 0, "idle": 0}
    assert summary["realtime_factor"] == pytest.approx(1.0)
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    metrics, scenario = pair_on_a_line(timeout_s=3.0)
    end, slot = "", -1
    while not end:
        slot += 1
        now = along(scenario, min(1.0, (slot + 1) / 20), 1.0)
        now[:, 1] = scenario.start[:, 1] + [0.0, 2.0, 0.0]
        end = metrics.update(slot, now[None], None, IDLE)
    summary = metrics.summary()
    assert (end, slot) == (TIMED_OUT, 29)
    assert summary["completed"] is False
    assert summary["timed_out"] is True
    assert summary["completion_time_s"] is None
    assert summary["realtime_factor"] is None


@pytest.mark.parametrize(("bulge", "crashes"), [(0.099, True), (0.101, False)])
def test_a_crash_is_any_distance_below_the_limit_at_any_instant(bulge: float, crashes: bool) -> None:
    metrics, scenario = pair_on_a_line()
    # One slot, eleven control instants; only the middle one is close.
    track = np.stack([along(scenario, 0.45 + 0.01 * step, bulge) for step in range(11)])
    end = metrics.update(0, track, None, COLLISION)
    summary = metrics.summary()
    assert (end == CRASHED) is crashes
    assert summary["collided"] is crashes
    assert summary["collided_pair"] == ([1, 2] if crashes else None)
    assert summary["min_distance_m"] == pytest.approx(2 * bulge)
    assert summary["min_distance_pair"] == [1, 2]
    assert summary["slots"]["collision"] == 1


def test_of_several_crashes_in_one_slot_the_first_counts() -> None:
    metrics, scenario = pair_on_a_line()
    track = np.stack([scenario.start] * 3)
    track[1, :, 2] = scenario.start[:, 0] + [0.15, 0.0, 0.0]
    track[2, :, 1] = scenario.start[:, 0] + [0.05, 0.0, 0.0]
    assert metrics.update(0, track, None, SUCCESS) == CRASHED
    assert metrics.summary()["collided_pair"] == [1, 3]
    assert metrics.summary()["min_distance_pair"] == [1, 2]


def test_a_crash_need_not_end_the_run_and_nothing_to_measure_is_none() -> None:
    metrics, scenario = pair_on_a_line(stop_on_crash=False)
    assert not metrics.update(0, along(scenario, 0.5)[None], None, SUCCESS)
    assert not metrics.update(1, along(scenario, 0.6)[None], None, SUCCESS)
    assert metrics.crash_slot == 1
    assert metrics.summary()["collided"] is True
    run = RunConfig(SwarmConfig(agents=1, moving=0), limits=RunLimits(tail_s=0.02))
    scenario = make_scenario(run.swarm)
    metrics = FlightMetrics(run, scenario)
    ends = [metrics.update(slot, scenario.start[None].copy(), None, SUCCESS) for slot in range(3)]
    summary = metrics.summary()
    assert ends == ["", "", COMPLETED]
    assert {
        summary[key] for key in ("min_distance_m", "efficiency_mean", "age_mean_slots", "estimate_error_mean_m")
    } == {None}


def test_efficiency_is_displacement_over_path_of_movers_only() -> None:
    metrics, scenario = pair_on_a_line()
    corner = scenario.start.copy()
    corner[:, 0] = [-2.0, 3.0, 0.0]
    corner[:, 1] = [0.0, 0.0, 0.0]
    end = corner.copy()
    end[:, 0] = [2.0, 3.0, 0.0]
    metrics.update(0, np.stack([corner, end]), None, SUCCESS)
    assert metrics.efficiencies() == pytest.approx({1: 5.0 / 7.0, 2: 1.0})
    assert metrics.summary()["efficiency_mean"] == pytest.approx((5.0 / 7.0 + 1.0) / 2)


def flown(swarm: Swarm, air: ChannelConfig, slots: int, *listeners: Swarm) -> Iterator[tuple[int, int]]:
    """Fly slot by slot; yields each when it is over, and its outcome."""
    channel = Channel(air)
    for slot in range(slots):
        swarm.scenario.advance(slot, swarm)
        senders = swarm.begin(slot)
        swarm.fly(slot)
        verdict = channel.arbitrate(slot, [swarm.ids[index] for index in senders])
        for tables in (swarm, *listeners):
            for index, mask in zip(senders, verdict.mask(len(swarm.ids)), strict=True):
                tables.hear(slot, swarm.frame(index), mask)
            tables.end(slot)
        yield slot, verdict.outcome


def fly(run: RunConfig, slots: int) -> tuple[FlightMetrics, FlightMetrics, dict[str, list[float]]]:
    """Flies a lossy swarm; measures from the agents' own tables, from a listener's, and with plain NumPy."""
    config = run.swarm
    scenario = make_scenario(config)
    swarm, tables = Swarm(config, scenario), metrics_tables(run, scenario, everyone=True)
    own, listener = FlightMetrics(run, scenario), FlightMetrics(run, scenario)
    plain: dict[str, list[float]] = {"age": [], "error": []}
    for slot, outcome in flown(swarm, run.air, slots, tables):
        own.update(slot, swarm.track, swarm, outcome)
        listener.update(slot, swarm.track, tables, outcome)
        if slot + 1 < config.agents:
            continue
        for observer in range(config.agents):
            for mover in np.flatnonzero(scenario.moving):
                sent = swarm.sent_slot[observer, mover]
                if mover == observer or not swarm.in_ap[observer, mover] or sent < 0:
                    continue
                plain["age"].append(slot - sent)
                state = swarm.sent_position[observer, :, mover], swarm.sent_velocity[observer, :, mover]
                guess = state[0] + state[1] * (slot + 1 - sent) * config.slot_s
                plain["error"].append(float(np.linalg.norm(guess - swarm.position[:, mover])))
    return own, listener, plain


@pytest.mark.parametrize("policy", ["tdma", "dtsa"])
def test_ages_and_errors_are_those_of_numpy_and_of_a_listener(policy: str) -> None:
    swarm = SwarmConfig(agents=7, moving=4, policy=policy, seed=3)
    air = ChannelConfig(agents=7, slot_ns=swarm.slot_ns, seed=3, loss=0.3)
    own, listener, plain = fly(RunConfig(swarm, air, RunLimits(tail_s=100.0)), 250)
    summary = own.summary()
    assert summary == listener.summary()
    assert summary["age_mean_slots"] == pytest.approx(np.mean(plain["age"]), rel=1e-12)
    assert summary["age_max_slots"] == max(plain["age"])
    assert summary["estimate_error_mean_m"] == pytest.approx(np.mean(plain["error"]), rel=1e-12)
    assert summary["estimate_error_max_m"] == pytest.approx(max(plain["error"]), rel=1e-12)
    assert len(plain["age"]) > 1000


@pytest.mark.parametrize(("policy", "task"), [("lease", "staggered"), ("tdma", "staggered"), ("tdma", "exchange")])
def test_ages_from_waking_on_count_every_receiver_heard_or_not(policy: str, task: str) -> None:
    config = SwarmConfig(agents=6, policy=policy, scenario=task, slot_ms=50.0, seed=2)
    air = ChannelConfig(agents=6, slot_ns=config.slot_ns, seed=3, loss=0.3)
    run, scenario = RunConfig(config, air, RunLimits(tail_s=100.0)), make_scenario(config)
    swarm, metrics = Swarm(config, scenario), FlightMetrics(run, scenario)
    begin = scenario.plan.begin if scenario.plan else np.zeros(6, dtype=np.int64)
    arrived, first, ages = np.zeros(6, dtype=bool), np.full(6, -1), []
    for slot, outcome in flown(swarm, air, 400):
        metrics.update(slot, swarm.track, swarm, outcome)
        for mover in np.flatnonzero((begin <= slot) & ~arrived):
            told = [int(swarm.sent_slot[other, mover]) for other in range(6) if other != mover]
            ages += [slot - max(sent, begin[mover] - 1) for sent in told]
            if first[mover] < 0 and max(told) >= begin[mover]:
                first[mover] = slot - begin[mover]
        away = np.linalg.norm(swarm.position - scenario.target, axis=0)
        arrived |= (begin <= slot) & (away <= config.r_min)
    summary = metrics.summary()
    assert summary["waking_age_mean_slots"] == pytest.approx(np.mean(ages), rel=1e-12)
    assert summary["waking_age_max_slots"] == max(ages)
    assert summary["waking_age_mean_ms"] == pytest.approx(50.0 * np.mean(ages))
    assert (summary["wakings"], summary["wakings_unheard"]) == (6, 0)
    assert first.min() >= 0
    assert summary["first_heard_max_slots"] == first.max()
    assert summary["first_heard_median_slots"] == sorted(first)[2]


def test_a_mover_that_nobody_hears_is_in_no_age_but_in_those_from_waking_on() -> None:
    """Stop and go: every goal after a rest is a waking; a channel that loses all says how long nobody has heard."""
    config = SwarmConfig(agents=4, policy="tdma", scenario="waypoints", pause_slots=10, slot_ms=50.0, seed=2)
    scenario = make_scenario(config)
    swarm, metrics = Swarm(config, scenario), FlightMetrics(RunConfig(config, limits=RunLimits(tail_s=100.0)), scenario)
    changes, legs = 0, [-1] * 4
    for slot, outcome in flown(swarm, ChannelConfig(agents=4, slot_ns=config.slot_ns, jam=True), 300):
        changes += sum(int(leg) != old for leg, old in zip(swarm.course.leg, legs, strict=True))
        legs = swarm.course.leg.tolist()
        metrics.update(slot, swarm.track, swarm, outcome)
    summary = metrics.summary()
    assert summary["age_mean_slots"] is None
    assert changes > 4
    assert summary["wakings"] == summary["wakings_unheard"] == changes
    assert summary["waking_age_max_slots"] > 20
    assert summary["first_heard_max_slots"] is None or summary["first_heard_max_slots"] > 20


def test_a_first_frame_counts_with_all_the_slots_that_it_took() -> None:
    config = SwarmConfig(agents=300, policy="tdma")
    summary = simulate(RunConfig(config, limits=RunLimits(timeout_s=3.5))).summary()
    assert [summary[f"first_heard_{name}_slots"] for name in ("median", "95", "max")] == [149, 284, 299]
    alone = simulate(RunConfig(SwarmConfig(agents=1, moving=1), limits=RunLimits(timeout_s=0.5))).summary()
    assert (alone["wakings_unheard"], alone["first_heard_max_slots"]) == (1, 50)


def run(radio: str, loss: float = 0.0, **swarm: Any) -> RunConfig:
    config = SwarmConfig(**{"agents": 4, **swarm})
    return RunConfig(config, ChannelConfig(radio=radio, loss=loss, **from_swarm(config)))


@pytest.mark.parametrize(
    ("policy", "shortest_ms"), [("tdma", 0.5205), ("lease", 1.0385), ("dtsa", 0.7805), ("age", 0.7805)]
)
def test_slots_that_no_clock_and_no_processor_could_keep_are_refused(policy: str, shortest_ms: float) -> None:
    """Turn-round, frame, and the line: to the receiver, and back for those that need the frame."""
    run("crazyflie", policy=policy, slot_ms=shortest_ms)
    run("plain", policy=policy, slot_ms=0.3)
    with pytest.raises(ConfigError, match=f"slot_ms: got 0.5; allowed: at least {shortest_ms} with radio crazyflie"):
        run("crazyflie", policy=policy, slot_ms=0.5)


def test_frames_that_the_radio_does_not_take_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    row = RADIOS["crazyflie"]
    monkeypatch.setitem(RADIOS, "crazyflie", replace(row, airtime=replace(row.airtime, longest=32)))
    run("crazyflie", policy="tdma")
    allowed = "channel.radio: got 'crazyflie'; allowed: a radio that takes frames of 56 bytes, not 32 at most"
    with pytest.raises(ConfigError, match=allowed):
        run("crazyflie", policy="lease")


@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("policy", ["tdma", "lease", "dtsa"])
def test_in_slots_that_are_long_enough_the_radio_changes_no_flight(policy: str, loss: float) -> None:
    flown = []
    for radio in ("plain", "crazyflie"):
        flight = simulate(run(radio, loss, policy=policy, slot_ms=2, seed=3, agents=6), log=True)
        flown.append((flight.log.senders(), flight.log.outcome.tobytes(), flight.log.position.tobytes()))
    assert flown[0] == flown[1]
