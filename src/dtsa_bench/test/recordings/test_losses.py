"""Losses learnt from flights are those of the channel that they were flown in."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import air_helpers as helpers
import numpy as np
import pytest
from waiting import wait_for

from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.air.udp import UdpSettings
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_bench.commands.cli import main
from dtsa_bench.experiments.sweep.spec import make_sweep
from dtsa_bench.network.sniffer import FRAME_SCHEMA
from dtsa_bench.recordings.bag.run import load_run
from dtsa_bench.recordings.losses.chain_fit import bursts, fit, fit_pooled, wilson
from dtsa_bench.recordings.losses.learn import learn
from dtsa_bench.recordings.losses.observed import Observed, observe
from dtsa_bench.recordings.losses.sequences import sequences
from dtsa_bench.recordings.losses.sniffed import FRAME, METADATA
from dtsa_bench.recordings.merge.agent_bag import read
from dtsa_bench.recordings.merge.json_bag import JsonBag
from dtsa_bench.recordings.merge.merge import Merge
from dtsa_bench.recordings.merge.merged_run import lay
from dtsa_bench.recordings.merge.merged_writer import write
from dtsa_bench.recordings.verify import verify_bag
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import Channel, ChannelConfig, MeasuredLosses
from dtsa_channel_sim.model.gilbert import GilbertElliott
from dtsa_channel_sim.model.loss_record import HEARD, LOST, UNKNOWN
from dtsa_channel_sim.model.loss_table import LossTable

SLOT_NS = 10_000_000


def flown(agents, slots, seed, at_random=False, **channel):
    """The losses of a channel, in a round robin, or with senders drawn in each slot."""
    medium, draw = Channel(ChannelConfig(agents=agents, seed=seed, **channel)), np.random.default_rng(seed)
    senders = draw.integers(1, agents + 1, slots) if at_random else np.arange(slots) % agents + 1
    outcome = np.full((slots, agents + 1), UNKNOWN, np.uint8)
    for slot, sender in enumerate(senders.tolist()):
        heard = medium.arbitrate(slot, (sender,)).mask(agents)[0]
        outcome[slot, 1:] = np.where(heard, HEARD, LOST)
        outcome[slot, sender] = UNKNOWN
    return LossTable(np.arange(slots), senders, outcome)


def shifted(tables):
    """Flights of agents of whom each flies in one only."""
    agents = tables[0].agents
    result = []
    for k, table in enumerate(tables):
        outcome = np.full((len(table.slots), agents * len(tables) + 1), UNKNOWN, np.uint8)
        outcome[:, agents * k + 1 : agents * (k + 1) + 1] = table.outcome[:, 1:]
        result.append(LossTable(table.slots, table.senders + agents * k, outcome))
    return result


def observed(table, **more):
    return Observed("flight", "", "table", SLOT_NS, table.agents, table, **more)


def in_interval(interval, truth):
    return interval[0] - 1e-5 <= truth <= interval[1] + 1e-5


# -- the likelihood --------------------------------------------------------------------------------------------------
def test_the_likelihood_is_that_of_the_textbook():
    table = flown(3, 90, 1, at_random=True, loss=0.3)
    data = sequences([table])
    enter, leave, good, bad = np.random.default_rng(2).uniform(0.05, 0.4, (4, 5, len(data.sent)))
    bad += 0.5
    found = data.log_likelihood(enter, leave, good, bad)
    for k in range(5):
        for link, (sender, receiver) in enumerate(data.ids.tolist()):
            p, r = enter[k, link], leave[k, link]
            step = np.array([[1 - p, p], [r, 1 - r]])
            state, total, last = np.array([r, p]) / (p + r), 0.0, None
            for row in np.flatnonzero((table.senders == sender) & (table.outcome[:, receiver] != UNKNOWN)):
                if last is not None:
                    state = state @ np.linalg.matrix_power(step, int(table.slots[row]) - last)
                lost = np.array([good[k, link], bad[k, link]])
                state = state * (lost if table.outcome[row, receiver] == LOST else 1.0 - lost)
                total += math.log(state.sum())
                state, last = state / state.sum(), int(table.slots[row])
            assert found[k, link] == pytest.approx(total, abs=1e-9)
    some = np.array([4, 1])
    assert np.allclose(data.some(some).log_likelihood(*(n[:, some] for n in (enter, leave, good, bad))), found[:, some])


def test_long_sequences_are_cut_and_lose_next_to_nothing():
    data = sequences([flown(2, 5000, 3, loss=0.2, burst_length=10.0)])
    assert data.heard.shape == (400, 14)
    assert data.sent.tolist() == [2500, 2500]
    there = np.arange(14) < data.active[:, None]
    assert data.lost.sum() == np.count_nonzero(data.heard[there] == 0)


# -- learnt is what was flown ----------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("good", "bad", "length", "at_random"), [(0.0, 1.0, 10.0, False), (0.05, 0.8, 12.0, True), (0.0, 0.7, 20.0, False)]
)
def test_intervals_hold_the_chain_that_was_flown(good, bad, length, at_random):
    """Of 48 links 95 % should; a share below 83 % would come about once in 1000 times."""
    channel = {"loss": 0.2, "burst_length": length, "burst_scope": "link", "p_good": good, "p_bad": bad}
    data = sequences(shifted([flown(3, 7500, seed, at_random, **channel) for seed in range(8)]))
    chains = fit(data)
    truth = GilbertElliott.from_means(0.2, length, good, bad)
    for k, number in enumerate((truth.enter, truth.leave, good, bad)):
        inside = (chains.low[k] - 1e-5 <= number) & (number <= chains.high[k] + 1e-5)
        assert inside.mean() >= 0.83
        assert (chains.low[k] <= chains.numbers[k] + 1e-5).all()
        assert (chains.numbers[k] <= chains.high[k] + 1e-5).all()
    kept, pooled_good, pooled_bad, ratio, ends = fit_pooled(data)
    assert ratio > 100
    assert ends[0] < kept < ends[1]
    assert abs(kept - (1 - truth.enter - truth.leave)) < 3 * (ends[1] - ends[0])
    assert abs(pooled_good - good) < 0.03
    assert abs(pooled_bad - bad) < 0.06


def test_independent_losses_are_taken_for_bursts_as_rarely_as_said():
    data = sequences(shifted([flown(3, 3000, seed, loss=0.2) for seed in range(40)]))
    _, chance, _, of_all = bursts(data)
    assert np.count_nonzero(chance < 0.05) <= 24  # 12 of 240 are to be expected
    assert np.count_nonzero(chance < 0.01) <= 9
    assert of_all > 0.001


def test_the_interval_of_a_rate_knows_of_bursts():
    for more in ({}, {"burst_length": 30.0, "burst_scope": "link"}):
        flights = shifted([flown(3, 6000, seed, loss=0.2, **more) for seed in range(12)])
        links = learn([observed(flight) for flight in flights])["links"]
        assert sum(in_interval(link["loss_interval"], 0.2) for link in links) >= 62  # of 72
    low, high = wilson(np.array([0.0, 5.0]), np.array([10.0, 10.0]))
    assert low[0] == 0.0
    assert high == pytest.approx([0.27753, 0.76341], abs=1e-4)
    assert low[1] == pytest.approx(0.23659, abs=1e-4)


def test_a_file_that_was_learnt_is_a_channel_that_loses_as_much(tmp_path):
    """Links differ; what is learnt from the channel of the file is the file again."""
    matrix = [[0.0, 0.5, 0.1, 0.0], [0.1, 0.0, 0.1, 0.3], [0.2, 0.0, 0.0, 1.0], [0.0, 0.2, 0.4, 0.0]]
    first = learn([observed(flown(4, 12_000, 1, loss_matrix=matrix, loss=0.05, burst_length=8.0, burst_scope="link"))])
    path = tmp_path / "losses.json"
    path.write_text(json.dumps(first))
    again = learn([observed(flown(4, 12_000, 2, losses=str(path)))])
    for one, two in zip(first["links"], again["links"], strict=True):
        assert (one["sender"], one["receiver"]) == (two["sender"], two["receiver"])
        width = sum(end[1] - end[0] for end in (one["loss_interval"], two["loss_interval"]))
        assert abs(one["loss"] - two["loss"]) <= max(width, 0.02)
    assert {link["loss"] for link in again["links"] if (link["sender"], link["receiver"]) == (3, 4)} == {1.0}
    more = ChannelConfig(agents=9, losses=str(path))  # agents beyond those that were measured: as all others
    assert more.losses.agents == 4


@pytest.mark.parametrize("scope", ["receiver", "link"])
def test_what_disturbs_receivers_is_told_from_what_disturbs_links(scope):
    learnt = learn([observed(flown(5, 6000, 3, loss=0.2, burst_length=15.0, burst_scope=scope))])
    assert learnt["scope"] == scope
    assert ("receivers" in learnt) == (scope == "receiver")
    truth = GilbertElliott.from_means(0.2, 15.0)
    low, high = learnt["all"]["pooled"]["kept_interval"]
    assert abs(1 - truth.enter - truth.leave - (low + high) / 2) < 2 * (high - low)
    for receiver in learnt.get("receivers", ()):
        assert in_interval(
            [end * side for end, side in zip(receiver["leave_interval"], (0.8, 1.25), strict=True)], 1 / 15
        )
    again = learn([observed(flown(5, 6000, 4, losses=learnt))])
    assert again["scope"] == scope
    assert abs(again["all"]["loss"] - learnt["all"]["loss"]) < 0.03
    plain = learn([observed(flown(5, 6000, 3, loss_matrix=[[0.3 * (k > 2) for k in range(5)]] * 5))])
    assert plain["scope"] == "link"


def test_few_data_share_a_chain_and_none_share_nothing():
    links = learn([observed(flown(12, 1500, 1, loss=0.2, burst_length=60.0, burst_scope="link"))])
    assert links["all"]["pooled"] is not None
    assert "pooled" in {link["chain"] for link in links["links"]}
    plain = learn([observed(flown(12, 1500, 1, loss=0.2))])
    assert plain["all"]["pooled"] is None
    quiet = learn([observed(flown(3, 300, 1))])
    assert {link["chain"] for link in quiet["links"]} == {"independent"}
    assert {link["loss"] for link in quiet["links"]} == {0.0}
    assert MeasuredLosses.from_dict(quiet).fitted(3).loss_good.max() == 0.0


def test_losses_by_distance():
    draw = np.random.default_rng(1)
    slots = np.arange(20_000)
    distance = np.full((20_000, 3), np.nan, np.float32)
    distance[:, 2] = draw.uniform(0, 100, 20_000)
    outcome = np.full((20_000, 3), UNKNOWN, np.uint8)
    outcome[:, 2] = draw.random(20_000) < 1 / (1 + np.exp(-0.08 * (distance[:, 2] - 60)))
    found = learn([observed(LossTable(slots, slots * 0 + 1, outcome, distance))])
    curve, bins = found["distance"]["logistic"], found["distance"]["bins"]
    assert curve["slope_interval"][0] < 0.08 < curve["slope_interval"][1]
    assert curve["half_m"] == pytest.approx(60, abs=1.5)
    assert sum(part["sent"] for part in bins) == 20_000
    assert [part["loss"] for part in bins] == sorted(part["loss"] for part in bins)
    assert bins[0]["from_m"] == 0.0


def test_flights_that_do_not_go_together_are_refused():
    three, four = (observed(flown(n, 60, 1, loss=0.2)) for n in (3, 4))
    four = dataclasses.replace(four, kind="lockstep")
    with pytest.raises(ConfigError, match="agents"):
        learn([dataclasses.replace(three, kind="lockstep"), four])
    with pytest.raises(ConfigError, match="slot_ms"):
        learn([three, dataclasses.replace(three, slot_ns=1)])


# -- flights ---------------------------------------------------------------------------------------------------------
def fly(directory, *words):
    pytest.importorskip("rclpy")
    pytest.importorskip("dtsa_msgs")
    common = ("--processes", "1", "--no-picture", "--agents", "5", "--timeout-s", "6", "--tail-s", "5", "--seed", "3")
    assert main(["fly", "--out", str(directory), *common, *words]) == 0
    return directory


@pytest.mark.ros
def test_a_flight_in_lockstep_is_learnt_replayed_and_verified_without_its_files(tmp_path, capsys):
    noise = ("--loss", "0.25", "--burst-length", "15", "--burst-scope", "link", "--policy", "tdma")
    flight = fly(tmp_path / "flown", *noise)
    model, table = tmp_path / "losses.json", tmp_path / "table.csv"
    assert main(["losses", str(flight), "--out", str(model), "--csv", str(table)]) == 0
    learnt = json.loads(model.read_text())
    run = load_run(flight)
    assert learnt["all"]["sent"] == 4 * len(run.frames.slot)
    assert learnt["all"]["heard"] == run.frames.received.sum()
    assert learnt["made"]["from"][0]["kind"] == "lockstep"
    kept = 1 - 0.25 / 15 / 0.75 - 1 / 15
    low, high = learnt["all"]["pooled"]["kept_interval"]
    assert low - (high - low) < kept < high + (high - low)
    # Slot by slot the same flight, from a table alone.
    replayed = fly(tmp_path / "replayed", "--policy", "tdma", "--losses", str(table))
    again = load_run(replayed)
    assert np.array_equal(run.frames.received, again.frames.received)
    assert np.array_equal(run.motion.position, again.motion.position)
    # In the channel that was learnt: nodes and simulator alike, and the bag needs no file.
    flown_again = fly(tmp_path / "again", "--policy", "lease", "--losses", str(model))
    summary = json.loads((flown_again / "summary.json").read_text())
    capsys.readouterr()
    words = ("--agents", "5", "--timeout-s", "6", "--tail-s", "5", "--seed", "3", "--policy", "lease")
    assert main(["simulate", *words, "--losses", str(model), "--json"]) == 0
    simulated = json.loads(capsys.readouterr().out)
    timing = {"wall_time_s", "realtime_factor"}
    same = (simulated.keys() & summary.keys()) - timing
    assert len(same) > 30
    assert {key: simulated[key] for key in same} == {key: summary[key] for key in same}
    model.unlink()
    table.unlink()
    assert verify_bag(replayed).ok
    assert verify_bag(flown_again).ok
    assert load_run(flown_again).config["channel"]["losses"]["name"] == "losses.json"


@pytest.mark.ros
def test_what_is_out_of_reach_or_collides_is_no_loss(tmp_path):
    flight = fly(tmp_path / "flown", "--policy", "aloha", "--loss", "0.2", "--range-m", "2.5")
    run, found = load_run(flight), observe(flight)
    assert found.left_out["collided somewhere"] == np.count_nonzero(run.frames.collided)
    assert not found.left_out["not known who was in reach"]
    alone = run.frames.collided == 0
    assert np.count_nonzero(found.table.outcome == LOST) == run.frames.lost[alone].sum()
    assert np.count_nonzero(found.table.outcome == HEARD) == run.frames.received[alone].sum()
    assert np.nanmax(np.where(found.table.outcome == LOST, found.table.distance_m, np.nan)) <= 2.5
    assert found.table.distance_m is not None


def test_agents_over_udp(tmp_path):
    """A merged flight: frames that were taken from an agent's record are lost on that link."""
    helpers.need_multicast()
    config = SwarmConfig(agents=3, policy="lease", slot_ms=20.0)
    udp = UdpSettings(interface="lo", group=helpers.own_group())
    paths = [tmp_path / f"cf{agent}.mcap" for agent in (1, 2, 3)]
    flying = []
    try:
        for agent, path in enumerate(paths, 1):
            flying.append(helpers.Flying(AgentSettings(id=agent), config, udp, path))
        wait_for(lambda: all(len(one.heard) == 2 and min(one.heard.values()) > 60 for one in flying))
    finally:
        for one in flying:
            one.end()
    bags = [read(path) for path in paths]
    draw = np.random.default_rng(1)
    for record in bags[1].slots:
        record.heard[:] = [one for one in record.heard if one.sender != 1 or draw.random() > 0.4]
    together = Merge(bags)
    result = together.judge()
    write(tmp_path / "whole", lay(together, result), result)
    found = observe(tmp_path / "whole")
    assert found.kind == "merged"
    rates = {(link["sender"], link["receiver"]): link["loss"] for link in learn([found])["links"]}
    assert len(rates) == 6
    assert 0.2 < rates[1, 2] < 0.6
    assert all(rate < 0.2 for link, rate in rates.items() if link != (1, 2))


@pytest.mark.parametrize("policy", ["tdma", "lease"])
def test_a_listener_misses_what_was_due(tmp_path, policy):
    config = SwarmConfig(agents=3, policy=policy)
    draw, every = np.random.default_rng(1), 3 * config.main_every
    about = {"swarm": json.dumps(config.to_dict())}
    with JsonBag(tmp_path / "sniffed.mcap", {FRAME: FRAME_SCHEMA}, METADATA, about) as bag:
        for slot in range(3, 6000):
            if draw.random() > 0.3:
                said = {"arrival_ns": slot, "sender": slot % 3 + 1, "slot": slot, "data": "", "reason": ""}
                bag.write(FRAME, slot, said)
    learnt = learn([observe(tmp_path)])
    assert [(link["sender"], link["receiver"]) for link in learnt["links"]] == [(1, 0), (2, 0), (3, 0)]
    for link in learnt["links"]:
        assert abs(link["sent"] - 6000 / (3 if policy == "tdma" else every)) < 12
        assert in_interval(link["loss_interval"], 0.3) or abs(link["loss"] - 0.3) < 0.1
    # Who flies in it hears each sender as the listener did.
    losses = MeasuredLosses.from_dict(learnt).fitted(3).loss_good
    assert losses[0, 1] == losses[0, 2]


def test_a_listener_in_bursts_stands_for_all_receivers(tmp_path):
    draw, bad = np.random.default_rng(1), False
    about = {"swarm": json.dumps(SwarmConfig(agents=3, policy="tdma").to_dict())}
    with JsonBag(tmp_path / "sniffed.mcap", {FRAME: FRAME_SCHEMA}, METADATA, about) as bag:
        for slot in range(4000):
            bad = draw.random() < (0.95 if bad else 0.02)
            if not bad:
                said = {"arrival_ns": slot, "sender": slot % 3 + 1, "slot": slot, "data": "", "reason": ""}
                bag.write(FRAME, slot, said)
    learnt = learn([observe(tmp_path)])
    assert learnt["scope"] == "receiver"
    assert [(row["sender"], row["receiver"]) for row in learnt["receivers"]] == [(0, 0)]
    assert in_interval(learnt["receivers"][0]["leave_interval"], 0.05)
    assert ChannelConfig(agents=3, losses=learnt).losses.scope == "receiver"


def test_of_other_policies_a_listener_cannot_tell(tmp_path, capsys):
    about = {"swarm": json.dumps(SwarmConfig(agents=3, policy="aloha").to_dict())}
    with JsonBag(tmp_path / "sniffed.mcap", {FRAME: FRAME_SCHEMA}, METADATA, about) as bag:
        bag.write(FRAME, 1, {"arrival_ns": 1, "sender": 1, "slot": 1, "data": "", "reason": ""})
    assert main(["losses", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "policy" in said
    assert said.count("\n") == 1


# -- the command -----------------------------------------------------------------------------------------------------
@pytest.fixture
def table(tmp_path) -> Path:
    path = tmp_path / "table.csv"
    rows = "\n".join(f"{slot},{slot % 3 + 1},{(slot + 1) % 3 + 1},{int(slot % 7 != 0)}" for slot in range(400))
    path.write_text(f"slot,sender,receiver,heard\n{rows}\n")
    return path


def test_the_summary_is_short(table, capsys):
    assert main(["losses", str(table)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert len(said) <= 12
    assert said[0].startswith("3 agents, 3 links: 400 frames, 400 receptions looked at, 14.5 % lost (")


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (("none.csv",), "none.csv"),
        (("none",), "none"),
        (("TABLE", "--slot-ms", "0"), "slot_ms"),
        (("TABLE", "--out", "TABLE"), "out"),
        (("TABLE", "--out", "no/such/place.json"), "out"),
        (("TABLE", "--csv", "table.txt"), "csv"),
        (("TABLE", "TABLE", "--csv", "both.csv"), "csv"),
    ],
)
def test_bad_input_is_one_line(table, capsys, monkeypatch, words, field):
    monkeypatch.chdir(table.parent)
    assert main(["losses", *(str(table) if word == "TABLE" else word for word in words)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert field in said


def test_a_table_that_is_replayed_must_fit(table, capsys):
    assert main(["simulate", "--agents", "4", "--losses", str(table)]) == 2
    assert "a record of 3 agents" in capsys.readouterr().err
    assert main(["simulate", "--agents", "3", "--timeout-s", "1", "--losses", str(table)]) == 0


def test_a_sweep_carries_what_the_files_say(tmp_path, table):
    model = tmp_path / "losses.json"
    assert main(["losses", str(table), "--out", str(model)]) == 0
    content = {"base": {"agents": 3, "timeout_s": 1}, "axes": {"losses": ["", str(table), str(model)]}, "seeds": 1}
    sweep = make_sweep(content, "losses")
    table.unlink()
    model.unlink()
    told = [cell.settings["losses"] for cell in sweep.cells]
    assert told[0] == ""
    assert [losses["name"] for losses in told[1:]] == ["table.csv", "losses.json"]
    for cell in sweep.cells:
        flight = simulate(RunConfig.from_dict(cell.run(1).to_dict())).summary()
        assert flight["slots"]["total"] > 0
    assert len({task.key for task in sweep.tasks()}) == 3


def test_sweep_takes_a_file_as_an_option(tmp_path, table, capsys):
    plan = tmp_path / "plan.yaml"
    plan.write_text("base: {agents: 3, timeout_s: 1}\naxes: {policy: [tdma]}\nseeds: 1\n")
    words = ("--file", str(plan), "--jobs", "1", "--no-report", "--losses")
    assert main(["sweep", *words, str(table), "--out", str(tmp_path / "swept")]) == 0
    assert main(["sweep", *words, "none.csv", "--out", str(tmp_path / "none")]) == 2
    assert "none.csv" in capsys.readouterr().err
