"""Losses learnt from flights are those of the channel that they were flown in."""

from __future__ import annotations

import json
from collections import Counter
from types import SimpleNamespace

import air_helpers as helpers
import numpy as np
import pytest

from dtsa_agent.air.settings import UdpSettings
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_bench.commands.cli import main
from dtsa_bench.experiments.sweep import make_sweep
from dtsa_bench.log.agent_bag import read
from dtsa_bench.log.arrays import FlightArrays, ReceivedFrames
from dtsa_bench.log.losses import HEARD, LOST, UNKNOWN, fit_links, learn, observe
from dtsa_bench.log.merge.merge import Merge
from dtsa_bench.log.merged_bag import write_merged
from dtsa_bench.log.record import load_log
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.simulate import simulate
from dtsa_channel_sim import Channel, ChannelConfig


def flown(agents, slots, seed, **channel):
    """The losses of a channel, senders drawn at random in each slot."""
    medium, draw = Channel(ChannelConfig(agents=agents, seed=seed, **channel)), np.random.default_rng(seed)
    senders = draw.integers(1, agents + 1, slots)
    outcome = np.full((slots, agents), UNKNOWN, np.uint8)
    for slot, sender in enumerate(senders.tolist()):
        outcome[slot] = np.where(medium.arbitrate(slot, (sender,)).mask(agents)[0], HEARD, LOST)
        outcome[slot, sender - 1] = UNKNOWN
    return np.arange(slots), senders, outcome


def off_diagonal(rows):
    matrix = np.array(rows)
    return matrix[~np.eye(len(matrix), dtype=bool)]


def test_rates_are_the_shares_that_were_lost_and_independent_losses_have_no_bursts():
    for seed in range(6):
        slots, senders, outcome = flown(3, 3000, seed, loss=0.2)
        found = fit_links([(slots, senders, outcome)], 3)
        assert found["memory_slots"] is None
        lost = np.array([(outcome[senders == sender] == LOST).sum(axis=0) for sender in (1, 2, 3)])
        assert np.array_equal(found["lost"], lost)
        assert off_diagonal(found["loss_good"]) == pytest.approx(
            off_diagonal(lost / np.maximum(found["sent"], 1)), rel=1e-5
        )
        assert not off_diagonal(found["enter"]).any()


@pytest.mark.parametrize(("length", "bad"), [(5.0, 1.0), (15.0, 1.0), (15.0, 0.6)])
def test_chains_of_links_are_found_again(length, bad):
    loss = 0.2 * bad
    more = {"loss": loss, "burst_length": length, "p_bad": bad, "burst_scope": "link"}
    found = fit_links([flown(4, 20_000, seed, **more) for seed in (1, 2)], 4)
    share = 0.2
    memory = 1.0 / (1.0 / length / (1.0 - share))
    assert found["memory_slots"] == pytest.approx(memory, rel=0.15)
    assert off_diagonal(found["loss_bad"]).mean() == pytest.approx(bad, abs=0.08)
    assert (1.0 / off_diagonal(found["leave"])).mean() == pytest.approx(length, rel=0.2)
    assert found["loss"] == pytest.approx(loss, abs=0.02)


def test_a_file_that_was_learnt_is_a_channel_that_loses_as_much():
    """Links differ; what is learnt from the channel of the file is the file again."""
    matrix = [[0.0, 0.5, 0.1, 0.0], [0.1, 0.0, 0.1, 0.3], [0.2, 0.0, 0.0, 1.0], [0.0, 0.2, 0.4, 0.0]]
    first = fit_links([flown(4, 16_000, 1, loss_matrix=matrix, loss=0.05, burst_length=8.0, burst_scope="link")], 4)
    again = fit_links([flown(4, 16_000, 2, losses={"slot_ns": 0, **first})], 4)
    for name in ("sent", "lost"):
        first[name], again[name] = off_diagonal(first[name]), off_diagonal(again[name])
    assert first["lost"] / first["sent"] == pytest.approx(again["lost"] / again["sent"], abs=0.05)
    assert again["lost"][8] == again["sent"][8]  # from 3 to 4
    assert again["memory_slots"] == pytest.approx(first["memory_slots"], rel=0.3)


def test_links_without_data_lose_as_all_do_and_of_merged_flights_what_was_told_counts() -> None:
    slots, senders, outcome = flown(4, 6000, 1, loss=0.3, burst_length=10.0, burst_scope="link")
    outcome[senders == 2, 2] = UNKNOWN
    found = fit_links([(slots, senders, outcome)], 4)
    assert found["sent"][1][2] == 0
    enter, leave, bad = (found[name][1][2] for name in ("enter", "leave", "loss_bad"))
    assert bad * enter / (enter + leave) == pytest.approx(found["loss"], rel=1e-4)
    with pytest.raises(ConfigError, match="one frame sent at least"):
        fit_links([(slots[:0], senders[:0], outcome[:0])], 4)
    rows = ([False, True, False], [True, False, True], [True, True, False], [False, True, False], [True, True, False])
    frames = SimpleNamespace(
        row=np.array([0, 1, 1, 2, 3]), sender=np.array([1, 2, 3, 1, 3]), received=np.array(rows),
        lost=np.zeros(5, int), collided=np.zeros(5, int),
    )  # fmt: skip
    told = np.array([[True, True, True], [True, True, True], [True, True, False], [True, True, False]])
    run, left_out = SimpleNamespace(sent_frames=frames, agents=3, known=told, merged={}), Counter()
    run.sender_known = FlightArrays.sender_known.func(run)
    slots, senders, outcome = observe(run, "flight", left_out)
    assert (slots.tolist(), senders.tolist()) == ([0, 2], [1, 1])
    assert outcome.tolist() == [[UNKNOWN, HEARD, LOST], [UNKNOWN, HEARD, UNKNOWN]]
    # A frame without a record of its sender is there because somebody heard it: of such ones none is lost by all.
    assert left_out == {"two senders in the slot": 2, "no record of the sender": 1}


def fly(directory, *words):
    pytest.importorskip("rclpy")
    pytest.importorskip("dtsa_msgs")
    common = ("--processes", "1", "--no-picture", "--agents", "5", "--timeout-s", "6", "--tail-s", "5", "--seed", "3")
    assert main(["fly", "--out", str(directory), *common, *words]) == 0
    return directory


@pytest.mark.ros
def test_a_flight_in_lockstep_is_learnt_and_flown_and_verified_without_the_file(tmp_path, capsys):
    noise = ("--loss", "0.25", "--burst-length", "15", "--burst-scope", "link", "--policy", "tdma")
    flight, model = fly(tmp_path / "flown", *noise), tmp_path / "losses.json"
    assert main(["losses", str(flight), "--out", str(model)]) == 0
    said = capsys.readouterr().out
    assert "5 agents, 20 links, slots of 10 ms: 820 frames, 3280 receptions, 24.1 % lost\nbursts: " in said
    learnt, run = json.loads(model.read_text()), load_log(flight)
    assert np.sum(learnt["sent"]) == 4 * len(run.sent_frames.row)
    assert np.sum(learnt["sent"]) - np.sum(learnt["lost"]) == run.received.sum()
    assert learnt["memory_slots"] == pytest.approx(15 * 0.75, rel=0.4)
    # In the channel that was learnt: nodes and simulator alike, and the bag needs no file.
    flown_again = fly(tmp_path / "again", "--policy", "lease", "--losses", str(model))
    summary = json.loads((flown_again / "summary.json").read_text())
    capsys.readouterr()
    words = ("--agents", "5", "--timeout-s", "6", "--tail-s", "5", "--seed", "3", "--policy", "lease")
    assert main(["simulate", *words, "--losses", str(model), "--json"]) == 0
    simulated = json.loads(capsys.readouterr().out)
    same = (simulated.keys() & summary.keys()) - {"wall_time_s", "realtime_factor"}
    assert len(same) > 30
    assert {key: simulated[key] for key in same} == {key: summary[key] for key in same}
    model.unlink()
    assert verify_bag(flown_again).ok
    assert load_log(flown_again).settings["channel"]["losses"]["name"] == "losses.json"


@pytest.mark.ros
def test_what_is_out_of_reach_or_collides_is_no_loss(tmp_path):
    flight = fly(tmp_path / "flown", "--policy", "aloha", "--loss", "0.2", "--range-m", "2.5")
    run, left_out = load_log(flight), Counter()
    _, _, outcome = observe(run, flight, left_out)
    assert left_out["collided somewhere"] == np.count_nonzero(run.sent_frames.collided)
    assert not left_out["receivers in reach not known"]
    alone = run.sent_frames.collided == 0
    assert np.count_nonzero(outcome == LOST) == run.sent_frames.lost[alone].sum()
    assert np.count_nonzero(outcome == HEARD) == run.sent_frames.received[alone].sum()


def test_agents_over_udp(tmp_path):
    """A merged flight: frames that were taken from an agent's record are lost on that link."""
    helpers.need_multicast()
    config = SwarmConfig(agents=3, policy="lease", slot_ms=20.0)
    udp = UdpSettings(interface="lo", group=helpers.own_group())
    with helpers.flying(config, [udp] * 3, tmp_path) as flying:
        helpers.hear_each_other(flying, 60)
    bags = [read(tmp_path / f"cf{agent}.mcap") for agent in (1, 2, 3)]
    *arrays, data = bags[1].log.heard
    kept = np.flatnonzero((arrays[1] != 1) | (np.random.default_rng(1).random(len(data)) > 0.4))
    bags[1].log.heard = ReceivedFrames(*(values[kept] for values in arrays), [data[k] for k in kept])
    together = Merge(bags)
    result = together.summary()
    write_merged(tmp_path / "whole", together.log, result)
    found = learn([str(tmp_path / "whole")])
    sent, lost = np.array(found["sent"]), np.array(found["lost"])
    rates = lost / np.maximum(sent, 1)
    assert np.count_nonzero(sent) == 6
    assert 0.2 < rates[0, 1] < 0.6
    rates[0, 1] = 0.0
    assert rates.max() < 0.2


@pytest.mark.parametrize(
    ("words", "field"),
    [(("none",), "none"), (("none", "--out", "no/such/place.json"), "out"), (("none", "--out", "there"), "out")],
)
def test_bad_input_is_one_line(tmp_path, capsys, monkeypatch, words, field):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").write_text("")
    assert main(["losses", *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert field in said


def test_a_sweep_carries_what_the_file_says(tmp_path, capsys):
    model = tmp_path / "losses.json"
    model.write_text(json.dumps({"slot_ns": 10_000_000, **fit_links([flown(3, 400, 1, loss=0.2)], 3)}))
    content = {"base": {"agents": 3, "timeout_s": 1}, "axes": {"losses": ["", str(model)]}, "seeds": 1}
    sweep = make_sweep(content, "losses")
    plan, words = tmp_path / "plan.yaml", ("--jobs", "1", "--no-report", "--losses")
    plan.write_text("base: {agents: 3, timeout_s: 1}\naxes: {policy: [tdma]}\nseeds: 1\n")
    assert main(["sweep", "--file", str(plan), *words, str(model), "--out", str(tmp_path / "swept")]) == 0
    model.unlink()
    assert main(["sweep", "--file", str(plan), *words, str(model), "--out", str(tmp_path / "none")]) == 2
    assert "losses.json" in capsys.readouterr().err
    told = [cell.settings["losses"] for cell in sweep.cells]
    assert (told[0], told[1]["name"]) == ("", "losses.json")
    for cell in sweep.cells:
        flight = simulate(RunConfig.from_dict(cell.run(1).to_dict())).summary()
        assert flight["slots"]["total"] > 0
    assert len({task.key for task in sweep.tasks}) == 2
