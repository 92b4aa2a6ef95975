"""The Monte Carlo engine: one table or many, with and without loss, and the same flights as with real nodes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dtsa_agent.core import REASONS
from dtsa_agent.core.frame import decode_frame
from dtsa_bench.experiments.sweep import run_config
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.runs.metrics import may_share
from dtsa_bench.simulation.simulate import SimulatedFlight, simulate
from dtsa_channel_sim import Channel


def run(**settings: Any) -> RunConfig:
    return run_config({"seed": 7, "timeout_s": 4.0, **settings})


def fly(**settings: Any) -> SimulatedFlight:
    return simulate(run(**settings), log=True, observer=1)


def plain(flight: SimulatedFlight) -> dict[str, Any]:
    return {key: value for key, value in flight.summary().items() if key not in ("wall_time_s", "realtime_factor")}


@pytest.mark.parametrize("policy", ["tdma", "dtsa", "age"])
@pytest.mark.parametrize(
    "more",
    [
        {"estimator": "linear"}, {"estimator": "hold", "avoider": "potential"},
        {"estimator": "intent", "slot_ms": 25.0}, {"frame": "extended", "moving": 6},
        {"scenario": "stop-and-go", "pause_slots": 10}, {"scenario": "staggered", "stagger_slots": 30, "moving": 6},
    ],
    ids=["linear", "hold", "intent", "extended", "stop-and-go", "staggered"],
)  # fmt: skip
def test_without_loss_one_table_for_all_makes_no_difference(policy: str, more: dict[str, Any]) -> None:
    config = run(agents=9, policy=policy, timeout_s=2.0, **{"moving": 8, **more})
    assert may_share(config)
    one, many = (simulate(config, shared_table=shared, log=True, observer=1) for shared in (True, False))
    assert one.swarm.sent_slot.shape[0] == 1
    assert many.swarm.sent_slot.shape[0] == 9
    assert one.log.senders() == many.log.senders()
    assert np.array_equal(one.log.reason, many.log.reason)
    assert np.array_equal(one.log.positions(), many.log.positions())
    assert np.array_equal(one.log.estimate, many.log.estimate)
    first, second = plain(one), plain(many)
    error = [first.pop("estimate_error_mean_m"), second.pop("estimate_error_mean_m")]
    assert first == second
    assert error[0] == pytest.approx(error[1], rel=1e-9)


@pytest.mark.parametrize("more", [
    {"loss": 0.1}, {"policy": "aloha"}, {"jam": True}, {"range_m": 3.0}, {"partition": [[1, 2, 3], [4, 5, 6]]},
    {"burst_length": 3.0, "loss": 0.1},
])  # fmt: skip
def test_where_views_may_differ_everyone_has_a_table(more: dict[str, Any]) -> None:
    config = run(agents=6, timeout_s=0.5, **more)
    assert not may_share(config)
    assert simulate(config).swarm.sent_slot.shape == (6, 6)


def test_slots_that_a_long_frame_would_outlast_are_flown_with_a_table_each() -> None:
    """The channel names the receivers of each frame there, for which one table has no room."""
    config = run(agents=4, policy="tdma", slot_ms=0.5, timeout_s=1.0)
    assert not may_share(config)
    assert simulate(config).summary()["age_mean_slots"] == pytest.approx(1.5, abs=0.01)


def test_the_summary_says_what_the_tracks_say() -> None:
    flight = fly(agents=8, moving=4, avoider="potential", slot_ms=30.0, timeout_s=20.0)
    summary, positions = flight.summary(), flight.log.positions()
    assert json.loads(json.dumps(summary)) == summary
    assert summary["end"] == "completed"
    assert len(positions) == 3 * summary["slots"]["total"]
    pairs = [(i, j) for i in range(8) for j in range(i)]
    distance = min(np.linalg.norm(positions[:, :, i] - positions[:, :, j], axis=1).min() for i, j in pairs)
    assert summary["min_distance_m"] == pytest.approx(distance, abs=1e-12)
    moving = flight.scenario.moving
    legs = np.diff(np.concatenate((flight.scenario.start[None], positions)), axis=0)
    flown = np.linalg.norm(legs, axis=1).sum(axis=0)[moving]
    direct = np.linalg.norm(positions[-1] - flight.scenario.start, axis=0)[moving]
    assert summary["efficiency_mean"] == pytest.approx((direct / flown).mean(), rel=1e-9)
    near = (np.linalg.norm(positions[2::3] - flight.scenario.target, axis=1)[:, moving] <= 0.3).all(axis=1)
    assert summary["completion_time_s"] == pytest.approx((np.argmax(near) + 1) * 0.03)
    assert summary["flight_time_s"] == pytest.approx(summary["completion_time_s"] + 1.0, abs=0.03)
    assert (positions[:, :, ~moving] == flight.scenario.start[:, ~moving]).all()


LINKS = [[0.0, 0.5, 0.1, 0.0], [0.1, 0.0, 0.1, 0.3], [0.2, 0.0, 0.0, 1.0], [0.0, 0.2, 0.4, 0.0]]
MEASURED = {
    "slot_ns": 0, "enter": [[0.1] * 4] * 4, "leave": [[0.2, 0.3, 0.4, 0.5]] * 4, "loss_good": LINKS,
    "loss_bad": [[0.9] * 4] * 4,
}  # fmt: skip
BURSTS = {"loss": 0.2, "burst_length": 4.0}


@pytest.mark.parametrize("more", [
    {}, {"loss": 0.2, "slot_ms": 30.0}, BURSTS, {**BURSTS, "burst_scope": "link"},
    {**BURSTS, "p_good": 0.05, "p_bad": 0.8}, {**BURSTS, "loss_matrix": LINKS}, {"losses": MEASURED},
    {"link_loss": [{"from": 1, "to": 2, "loss": 0.7}], "estimator": "oracle"}, {"jam": True}, {"range_m": 3.0},
    {"scenario": "waypoints", "r_min": 1.5, "loss": 0.1}, {"scenario": "staggered", "stagger_slots": 20},
    {"schedule": [{"slot": 50, "loss": 0.4}, {"slot": 90, "jam": True, "until": 110}], **BURSTS},
    {**BURSTS, "burst_scope": "link", "agents": 12, "timeout_s": 60.0, "tail_s": 57.0},
], ids=str)  # fmt: skip
@pytest.mark.parametrize("policy", ["dtsa", "aloha", "lease"])
def test_flights_that_c_flies_are_those_that_python_steps_through(
    policy: str, more: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The losses of whole flights are stated in C beside the channel's; the last is longer than a block of these."""
    config = run(**{"agents": 4, "policy": policy, "timeout_s": 2.0, "stop_on_crash": False, **more})
    whole = simulate(config, log=True, frames=True, observer=2)
    monkeypatch.setattr(Channel, "fill_losses", lambda *_: 0)
    stepped = simulate(config, log=True, frames=True, observer=2)
    assert plain(whole) == plain(stepped) == plain(simulate(config))
    for name, array in vars(whole.log).items():
        assert array.tobytes() == getattr(stepped.log, name).tobytes(), name
    log, slots = whole.log, len(whole.log)
    assert slots == whole.metrics.slots == whole.summary()["slots"]["total"]
    assert len(log.data) == len(log.received) == log.sent.sum()
    slot, sender = np.nonzero(log.sent)
    assert ((log.lost + log.collided)[slot, sender] <= config.swarm.agents - 1).all()
    if not more.keys() & {"range_m"}:
        reached = log.received.sum(axis=1) + log.lost[slot, sender] + log.collided[slot, sender]
        assert (reached == config.swarm.agents - 1).all()
    for data, at, agent in zip(log.data, slot.tolist(), sender.tolist(), strict=True):
        frame = decode_frame(data.tobytes(), config.swarm.extent_m)
        assert (frame.sender, frame.slot) == (agent + 1, at)
        before = whole.scenario.start if not at else log.position[at - 1, -1]
        assert np.abs(np.array(frame.position) - before[:, agent]).max() <= 0.0011


def test_frames_in_a_log_are_signed_where_the_flight_has_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", "00112233445566778899aabbccddeeff0123456789abcdef0123456789abcdef")
    config = run(agents=4, policy="aloha", auth=True, auth_session=7, timeout_s=0.5)
    flight = simulate(config, log=True, frames=True)
    authenticator = flight.swarm.authenticator
    for slot, data in zip(np.nonzero(flight.log.sent)[0].tolist(), flight.log.data, strict=True):
        assert authenticator.open(data.tobytes(), slot)
    without = simulate(run(agents=4, policy="aloha", timeout_s=0.5), log=True, frames=True)
    assert np.array_equal(without.log.position, flight.log.position)
    assert (flight.log.length.max(), without.log.length.max()) == (23, 19)


def test_crashes_and_timeouts_end_flights_and_one_lost_frame_splits_the_views_of_dtsa() -> None:
    crash = simulate(run(agents=24, estimator="hold", policy="tdma", slot_ms=20.0, timeout_s=20)).summary()
    assert crash["end"] == "crashed"
    assert crash["collided"]
    assert crash["min_distance_m"] < 0.2
    late = simulate(run(agents=8, timeout_s=0.5)).summary()
    assert late["end"] == "timed out"
    assert late["slots"]["total"] == 50
    assert late["completion_time_s"] is None
    cases = (("dtsa", 0.0), ("dtsa", 0.01), ("tdma", 0.01))
    whole, torn, tdma = (fly(agents=12, loss=p, policy=name) for name, p in cases)
    assert len(set(whole.swarm.digest.tolist())) == 1 < len(set(torn.swarm.digest.tolist()))
    assert whole.summary()["slots"]["collision"] == 0 < torn.summary()["slots"]["collision"]
    assert whole.summary()["first_divergence_slot"] is None
    assert whole.summary()["agreement_share"] == whole.summary()["equal_tables_share"] == 1.0
    assert 0 < torn.summary()["first_divergence_slot"] < 100
    assert torn.summary()["agreement_share"] < 0.6
    assert tdma.summary()["equal_tables_share"] < 1.0 == tdma.summary()["agreement_share"]


def test_agents_say_a_new_goal_before_they_fly_and_dtsa_chooses_for_its_reasons() -> None:
    for announce in (True, False):
        flight = fly(agents=6, scenario="staggered", stagger_slots=40, policy="dtsa", announce=announce, timeout_s=6.0)
        path = np.concatenate((flight.scenario.start[None], flight.log.positions()))
        moved = (np.abs(np.diff(path, axis=0)).max(axis=1) > 0).argmax(axis=0)  # first slot in which each moves
        waited = 0
        for k in range(6):
            begin = flight.scenario.plan.begin[k]
            said = next(slot for slot, ids in enumerate(flight.log.senders()) if slot >= begin and k + 1 in ids)
            if begin:
                assert moved[k] == (said + 1 if announce else begin)
                waited += said > begin
        assert waited
    flight = fly(agents=12, moving=6, timeout_s=20.0)
    seen = {REASONS[code] for code in flight.log.reason[:, 0]}
    assert {"boot", "priority", "tie", "return"} <= seen
    assert flight.log.senders()[:12] == [(i,) for i in range(1, 13)]


@pytest.mark.ros
@pytest.mark.parametrize(
    ("agents", "processes", "loss"), [(4, None, 0.0), (4, None, 0.25), (12, 2, 0.0), (12, 3, 0.1), (18, 2, 0.15)]
)
def test_simulate_and_fly_agree_bit_for_bit(tmp_path: Path, agents: int, processes: int | None, loss: float) -> None:
    pytest.importorskip("rclpy")
    from fly_helpers import frames

    from dtsa_bench.flights.flight import fly as fly_nodes
    from dtsa_bench.flights.options import FlightOptions

    moving = 2 if agents == 12 else agents
    config = run(agents=agents, moving=moving, loss=loss, timeout_s=1.5, stop_on_crash=False, seed=agents)
    real = fly_nodes(config, tmp_path / "flight", FlightOptions(processes=processes, pictures=False))
    ours = simulate(config, log=True)
    ours_at_start = np.concatenate((ours.scenario.start[None], ours.log.position[:, -1]))
    count = min(len(real.positions), len(ours_at_start))
    assert count >= 150
    assert np.array_equal(real.positions[:count], ours_at_start[:count])
    sent = [(slot, agent) for slot, agent, _ in frames(tmp_path / "flight") if slot < len(ours.log)]
    assert sent == [(slot, agent) for slot, ids in enumerate(ours.log.senders()) for agent in ids]
    assert verify_bag(tmp_path / "flight").ok  # frames are those of the protocol, to the byte
    same = {key: value for key, value in plain(ours).items() if key in real.summary}
    # One table is summed up as often as many tables are: the mean's last digit differs.
    error = same.pop("estimate_error_mean_m")
    assert real.summary["estimate_error_mean_m"] == pytest.approx(error, rel=1e-9)
    assert {key: real.summary[key] for key in same} == same
    assert len(same) > 20
