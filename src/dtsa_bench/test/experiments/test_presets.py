"""Integration: the sweeps that come with the package, and their reports."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
from page_helpers import check_loads_nothing

from dtsa_agent.core.registry import POLICIES
from dtsa_bench.commands import cli
from dtsa_bench.experiments import sweep as spec
from dtsa_bench.experiments.tables import SweepTable
from dtsa_bench.pages.report.tables import write_report

NAMED = (
    *("paper-12", "paper-18", "limits", "grid", "idle", "epsilon", "loss", "loss-idle"),
    *("estimate", "trajectories", "scenarios", "access", "bounds", "waking"),
)

VOCABULARIES = {"http://www.w3.org", "http://creativecommons.org", "http://purl.org", "https://matplotlib.org"}


def invented(sweep: spec.Sweep) -> SweepTable:
    finished = {}
    for task in sweep.tasks:
        collided, slots = task.seed % 2 == 0, {"total": 100, "success": 90, "collision": 0, "idle": 10}
        summary = {"collided": collided, "min_distance_m": 0.3 + 0.001 * (task.seed % 7), "efficiency_mean": 0.9,
                   "completion_time_s": 5.0, "age_mean_slots": 4.0 + task.seed % 3, "estimate_error_mean_m": 0.01,
                   "slots": slots}  # fmt: skip
        finished[task.key] = {"status": "crashed" if collided else "completed", "reason": "", "summary": summary}
    return SweepTable(sweep, finished)


def test_all_presets_are_there_and_every_run_of_them_is_possible() -> None:
    assert set(NAMED) <= set(spec.preset_names())
    for name in spec.preset_names():
        sweep = spec.load_preset(name)
        assert len(sweep.seeds) >= 3
        assert min(sweep.seeds) >= 1001  # never those of tuning
        assert sweep.title
        assert sweep.figures
        assert len({task.key for task in sweep.tasks}) == len(sweep.cells) * len(sweep.seeds)
        for cell in sweep.cells:
            cell.run(sweep.seeds[-1])


def test_slots_of_slow_radios_hold_their_frames() -> None:
    """As docs/reference/channel.md computes them: the air time and 5 ms, rounded up."""

    def lora_ms(length: int, bandwidth_khz: float) -> float:
        return float((8 + 4.25 + 8 + 5 * math.ceil((8 * length - 4 * 7 + 44) / (4 * 7))) * 2**7 / bandwidth_khz)

    times = {
        "LoRa 250 kHz": [lora_ms(length, 250.0) for length in (19, 56)],
        "LoRa 500 kHz": [lora_ms(length, 500.0) for length in (19, 56)],
        "SiK 64 kbit/s": [8 * (length + 12) / 64.0 for length in (19, 56)],
        "SiK 250 kbit/s": [8 * (length + 12) / 250.0 for length in (19, 56)],
        "ESP-NOW long range": [8 * (length + 43) / 250.0 for length in (19, 56)],
    }
    for cell in spec.load_preset("slow-radio").cells:
        swarm = cell.run(1001).swarm
        radio = next(name for name in times if cell.labels["radio and scheme"].startswith(name))
        assert swarm.slot_ms == math.ceil(times[radio][swarm.extended] + 5.0)


def test_slots_of_a_crazyflies_radio_are_the_shortest_that_fit() -> None:
    """Rounded up to 0.01 ms; those called constant with 0.3 ms each way.

    Clocks that agents align differ by 70 us; 780 us are the most that `dtsa` takes at N = 18 on a Cortex-M4.
    """
    for cell in spec.load_preset("crazyflie-radio").cells:
        run = cell.run(1001)
        assert (run.air.radio == "plain") == ("constant" in cell.labels["scheme and radio"])
        policy = run.swarm.policy
        shortest_ns = run.air.airtime.shortest_slot_ns(
            run.swarm.frame_length, guard_ns=70_000, decide_ns=780_000 if policy == "dtsa" else 0,
            needs_frame=POLICIES.row(policy).needs_frame,
        )  # fmt: skip
        assert run.swarm.slot_ms == math.ceil(round(shortest_ns / 1e4, 6)) / 100


def test_the_papers_figures_have_its_settings() -> None:
    for name, agents, movers in (("paper-12", 12, [2, 6, 12]), ("paper-18", 18, [2, 10, 18])):
        sweep = spec.load_preset(name)
        assert len(sweep.cells) * len(sweep.seeds) == 270
        runs = [cell.run(1001).swarm for cell in sweep.cells]
        assert {run.agents for run in runs} == {agents}
        assert sorted({run.movers for run in runs}) == movers
        assert {(run.policy, run.estimator) for run in runs} == {
            ("tdma", "hold"), ("tdma", "linear"), ("dtsa", "linear"),
        }  # fmt: skip
        assert {(run.epsilon, run.r_min, run.slot_ms) for run in runs} == {(0.5, 0.3, 10.0)}


@pytest.mark.parametrize("name", ["limits", "idle", "loss", "grid"])
def test_gossip_and_genies_fly_in_the_settings_of_the_preset_beside_which_they_stand(name: str) -> None:
    plain, bounds = spec.load_preset(name), spec.load_preset(f"{name}-bounds")

    def flown(sweep: spec.Sweep) -> set[str]:
        runs = [cell.run(1001).swarm for cell in sweep.cells]
        tdma = [repr(replace(run, frame="auto")) for run in runs if run.policy == "tdma"]
        return {text for text in tdma if name in ("grid", "idle") or "estimator='linear'" in text}

    channels = [{repr(cell.run(1001).air) for cell in sweep.cells} for sweep in (plain, bounds)]
    assert flown(plain) == flown(bounds)
    assert channels[0] == channels[1]
    assert set(bounds.seeds) <= set(plain.seeds)
    assert {cell.labels["scheme"] for cell in bounds.cells} == {"TDMA + gossip", "genie (age)", "genie (error)"}


@pytest.mark.parametrize("name", NAMED)
def test_every_preset_ends_in_a_report_that_needs_no_network(name: str, tmp_path: Path) -> None:
    sweep = spec.load_preset(name, seeds=3)
    path = write_report(invented(sweep), tmp_path, "code", "tools/dtsa sweep")
    page = path.read_text(encoding="utf-8")
    assert page.count("<svg") == len(sweep.figures)
    # Names of XML vocabularies are no addresses that anything is loaded from.
    assert set(re.findall(r"https?://[^\"'/ <]+", page)) <= VOCABULARIES
    check_loads_nothing(page)
    for kind in ("png", "svg"):
        assert len(list((tmp_path / "figures").glob(f"*.{kind}"))) == len(sweep.figures)
    assert f"{3 * len(sweep.cells)} of {3 * len(sweep.cells)} flights" in page


@pytest.mark.parametrize("names", ["paper-12,nope", "protocol,paper-12"])
def test_presets_that_cannot_be_swept_are_refused_before_anything_is_flown(names, tmp_path, capsys):
    assert cli.main(["sweep", "--preset", names, "--out", str(tmp_path)]) == 2
    assert "paper-12, paper-18" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
