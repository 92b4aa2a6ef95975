"""The public package `dtsa`: what it exports, what it costs, what it gives, and that its document is true."""

from __future__ import annotations

import doctest
import importlib
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_helpers import flight_bag

import dtsa
from dtsa_bench.runs.config import RunConfig
from dtsa_bench.simulation.simulate import simulate

ROOT = Path(__file__).resolve().parents[4]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
HEAVY = ("numpy", "matplotlib", "pandas", "rclpy", "pyarrow", "yaml")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("runs") / "a"
    flight_bag(directory / "bag", slots=200, loss=0.1, agents=6, policy="lease", seed=3)
    return directory


@pytest.fixture(scope="module")
def flight() -> dtsa.FlightLog:
    return dtsa.simulate(agents=6, policy="lease", loss=0.1, seed=3)


@pytest.fixture(scope="module")
def swept() -> dtsa.SweepResult:
    return dtsa.sweep(axes={"loss": [0.0, 0.2], "scheme": {"a": {"policy": "tdma"}, "b": {"policy": "lease"}}},
                      base={"agents": 6, "timeout_s": 1.0}, seeds=3)  # fmt: skip


def in_a_new_process(program: str) -> str:
    result = subprocess.run([sys.executable, "-c", program], env=ENVIRONMENT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_every_public_name_is_there_and_importing_it_loads_nothing_heavy() -> None:
    assert len(set(dtsa.__all__)) == len(dtsa.__all__)
    for name in dtsa.__all__:
        assert getattr(dtsa, name) is not None
    assert dir(dtsa) == sorted(dtsa.__all__)
    stub = Path(dtsa.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    assert sorted("".join(found) for found in re.findall(r" as (\w+)$|^(\w+) = ", stub, re.MULTILINE)) == dir(dtsa)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        dtsa.nothing  # noqa: B018
    program = f"import sys, dtsa; print([name for name in {HEAVY} if name in sys.modules])"
    assert in_a_new_process(program).strip() == "[]"
    program = "import sys, dtsa; dtsa.simulate; dtsa.sweep; dtsa.Agent; dtsa.Channel"
    program += f"\nprint([name for name in {HEAVY[1:4]} if name in sys.modules])"
    assert in_a_new_process(program).strip() == "[]"


def test_simulate_is_the_flight_of_the_command(flight: dtsa.FlightLog) -> None:
    config = dtsa.run_config(agents=6, policy="lease", loss=0.1, seed=3)
    assert isinstance(config, RunConfig)
    assert (config.swarm.policy, config.air.loss, config.air.seed) == ("lease", 0.1, 3)
    same = simulate(config, log=True)
    assert np.array_equal(flight.path[1:], same.log.positions())
    assert np.array_equal(np.concatenate(flight.position), same.log.positions())
    timeless = dict.fromkeys(("wall_time_s", "realtime_factor"))
    assert flight.summary | timeless == same.summary() | timeless
    bare = dtsa.simulate(config, trace=False)
    assert bare.summary["min_distance_m"] == flight.summary["min_distance_m"]
    with pytest.raises(dtsa.ConfigError, match="trace: got False"):
        bare.path  # noqa: B018


def test_tables_of_a_flight_have_a_row_a_slot_and_a_row_an_agent_and_instant(flight: dtsa.FlightLog) -> None:
    slots, positions = flight.slots, flight.states
    assert len(slots) == flight.summary["slots"]["total"]
    assert slots["outcome"].value_counts().to_dict() == {
        name: count for name, count in flight.summary["slots"].items() if name != "total" and count
    }
    assert len(positions) == 6 * len(flight.path)
    last = positions[positions["agent"] == 4].iloc[-1]
    assert last["time_s"] == pytest.approx(flight.summary["flight_time_s"])
    assert last["position_y_m"] == flight.path[-1, 1, 3]


def test_a_recording_has_its_configuration_and_tables(run: Path) -> None:
    recording = dtsa.open(run)
    assert (recording.name, recording.config.swarm.policy, recording.config.swarm.seed) == ("a", "lease", 3)
    assert len(recording.slots) == 200
    assert len(recording.decisions) == 200 * 6
    assert len(recording.frames) == recording.slots["senders"].sum()
    assert len(recording.receptions) == 5 * len(recording.frames)
    assert recording.receptions["received"].sum() == recording.frames["received"].sum()
    assert set(recording.states["agent"]) == {1, 2, 3, 4, 5, 6}
    assert recording.path.shape == (len(recording.instants_s), 3, 6)
    assert len(recording.states) == 6 * len(recording.instants_s)
    counted = recording.ages.dropna()
    assert counted["age_slots"].mean() == pytest.approx(recording.summary["age_mean_slots"], rel=0.1)
    assert recording.summary["slots"]["total"] == 200
    assert dtsa.verify(run).mode == "lockstep"
    with pytest.raises(dtsa.UnusableBag, match="no such file"):
        dtsa.open(run / "nothing")


def test_what_one_agent_knew_is_the_same_simulated_and_recorded(run: Path) -> None:
    """Losses are drawn otherwise in the recorded one: the first round alone is the same."""
    recording = dtsa.open(run)
    flight = dtsa.simulate(recording.config)
    pairs = recording.ages_by_observer, flight.ages_by_observer
    for observer in (1, 4):
        recorded, simulated = (known[known.observer == observer] for known in pairs)
        chosen, decisions = (table[table.agent == observer] for table in (recording.decisions, flight.decisions))
        assert simulated.columns.tolist() == recorded.columns.tolist()
        assert decisions.columns.tolist() == chosen.columns.tolist()
        for table in (simulated, recorded):
            assert (table["agent"] != observer).all()
            assert (table["age_slots"] >= 0).all()
            assert (table["error_m"] >= 0).all()
        assert decisions["chosen"].head(6).tolist() == chosen["chosen"].head(6).tolist()
        assert decisions["reason"].head(6).tolist() == chosen["reason"].head(6).tolist()
        assert set(decisions["reason"]) <= set(dtsa.REASONS)


def test_ages_of_a_simulated_flight_sum_up_to_its_results() -> None:
    agents = 6
    config = dtsa.run_config(agents=agents, policy="lease", loss=0.1, seed=3)
    flight = dtsa.simulate(config)
    known = flight.ages_by_observer
    counted = known[known["counted"] & (known["slot"] >= agents - 1)]
    summary = flight.summary
    assert counted["age_slots"].mean() == pytest.approx(summary["age_mean_slots"], rel=1e-12)
    assert counted["age_slots"].max() == summary["age_max_slots"]
    assert counted["error_m"].mean() == pytest.approx(summary["estimate_error_mean_m"], rel=1e-9)


class Backwards:
    def __init__(self, config: dtsa.SwarmConfig, agent: int) -> None:
        self.agents = config.agents

    def choose(self, table: dtsa.Table, slot: int) -> int:
        return self.agents - slot % self.agents


def test_a_registered_policy_flies_in_this_process_and_is_refused_elsewhere(tmp_path: Path) -> None:
    dtsa.register("policy", "backwards", Backwards)
    flight = dtsa.simulate(agents=4, policy="backwards", timeout_s=0.2)
    assert flight.slots["sender"].head(5).tolist() == [4, 3, 2, 1, 4]
    axes, base = {"policy": ["backwards"]}, {"agents": 4, "timeout_s": 0.2}
    assert len(dtsa.sweep(axes=axes, base=base, seeds=2).runs()) == 2
    for more, field in (({"jobs": 2}, "jobs"), ({"out": tmp_path / "s"}, "out")):
        with pytest.raises(dtsa.ConfigError, match="registered policy backwards") as caught:
            dtsa.sweep(axes=axes, base=base, seeds=2, **more)  # type: ignore[arg-type]
        assert caught.value.field == field
    for words in (("policy", "tdma", Backwards), ("colour", "x", Backwards), ("policy", "x", 3)):
        with pytest.raises(dtsa.ConfigError):
            dtsa.register(*words)


def test_a_sweep_has_a_row_a_combination_and_a_row_a_flight(swept: dtsa.SweepResult, tmp_path: Path) -> None:
    table, runs = swept.table(), swept.runs()
    assert table[["loss", "scheme"]].to_numpy().tolist() == [[0.0, "a"], [0.0, "b"], [0.2, "a"], [0.2, "b"]]
    assert table["runs"].tolist() == [3] * 4
    assert table["timed_out"].tolist() == [3] * 4
    assert len(runs) == 12
    first = runs[(runs["loss"] == 0.2) & (runs["scheme"] == "b")]
    assert table["age_mean_slots"][3] == pytest.approx(first["age_mean_slots"].mean())
    alone = dtsa.simulate(agents=6, timeout_s=1.0, loss=0.2, policy="lease", seed=int(first["seed"].iloc[0]))
    assert alone.summary["age_mean_slots"] == first["age_mean_slots"].iloc[0]

    done: list[int] = []
    axes = {"loss": [0.0, 0.2]}
    for _ in range(2):  # the second time everything is there
        dtsa.sweep(axes=axes, base={"agents": 4, "timeout_s": 0.5}, seeds=2, out=tmp_path / "s", progress=done.append)
    assert sum(done) == 4
    assert (tmp_path / "s" / "results.csv").read_text().count("\n") == 5


@pytest.mark.parametrize(("use", "arguments", "field"), [
    (dtsa.simulate, {"agents": -1}, "agents"), (dtsa.simulate, {"color": "red"}, "color"),
    (dtsa.simulate, {"loss": 2.0}, "loss"), (dtsa.simulate, {"config": 12}, "config"), (dtsa.sweep, {}, "sweep"),
    (dtsa.sweep, {"preset": "loss", "axes": {"loss": [0]}}, "sweep"), (dtsa.sweep, {"preset": "nothing"}, "preset"),
    (dtsa.sweep, {"axes": {"cell": [0]}}, "axes.cell"), (dtsa.sweep, {"axes": {"loss": [0]}, "seeds": 0}, "seeds"),
    (dtsa.sweep, {"axes": {"loss": [0]}, "seeds": []}, "seeds"),
    (dtsa.sweep, {"axes": {"loss": [0]}, "jobs": 0}, "jobs"),
])  # fmt: skip
def test_wrong_settings_are_named_before_anything_flies(use: Any, arguments: dict[str, object], field: str) -> None:
    with pytest.raises(dtsa.ConfigError) as caught:
        use(**arguments)
    assert caught.value.field == field


def test_the_nearest_name_is_asked_for() -> None:
    for settings, name in (
        ({"agnets": 3}, "agents"),
        ({"policy": "dsta"}, "dtsa"),
        ({"options": {"v_mx": 1}}, "v_max"),
    ):
        with pytest.raises(dtsa.ConfigError, match=f"; did you mean {name}\\?$"):
            dtsa.simulate(**settings)  # type: ignore[arg-type]


def test_plots_are_figures_of_what_they_are_given(flight: dtsa.FlightLog, swept: dtsa.SweepResult, run: Path) -> None:
    from matplotlib.figure import Figure

    recording = dtsa.open(run)
    paths = dtsa.plot_trajectories(flight, recording, titles=["simulated", "recorded"])
    assert [axis.get_title(loc="left") for axis in paths.axes] == ["simulated", "recorded"]
    distances = dtsa.plot_distances(flight).axes[0].lines[0]
    assert min(distances.get_ydata()) == pytest.approx(flight.summary["min_distance_m"], abs=0.01)
    near = dtsa.simulate(agents=2, collision_m=9.0, stop_on_crash=False)
    assert dtsa.plot_distances(near).axes[0].get_ylim()[1] > 9.0  # the line of a crash is in sight
    ages = dtsa.plot_ages(recording)
    assert isinstance(ages, Figure)
    assert ages.axes[0].lines
    lines = dtsa.plot_lines(swept, x="loss", y=["age_mean_slots", "crashed"], series="scheme")
    assert all(len(line.get_ydata()) == 2 for axis in lines.axes for line in axis.lines)
    pooled = swept.runs().groupby("scheme", sort=False)["age_mean_slots"].mean().tolist()  # over all levels of `loss`
    bars = dtsa.plot_bars(swept, x="scheme", y="age_mean_slots").axes[0].patches
    assert [bar.get_height() for bar in bars] == pytest.approx(pooled)
    both = dtsa.plot_matrix(swept, rows="scheme", columns="loss", y=["crashed", "age_mean_slots"]).axes
    assert [len(axis.texts) for axis in both] == [len(swept.table())] * 2
    assert (both[0].get_ylabel(), both[0].get_xlabel()) == ("scheme", "loss")
    close = dtsa.sweep(axes={"policy": ["tdma"]}, base={"agents": 2, "collision_m": 0.5, "timeout_s": 0.2}, seeds=1)
    distances = dtsa.plot_bars(close, x="policy", y="min_distance_m").axes[0]
    assert 0.5 in [line.get_ydata()[0] for line in distances.lines]  # where two have crashed
    own = Figure().subplots(2, 2).ravel()
    assert dtsa.plot_ages(flight, ax=own[0]) is own[0].figure
    assert (
        dtsa.plot_bars(swept, x="scheme", y=["crashed", "age_mean_slots"], series="loss", ax=own[2:]) is own[0].figure
    )
    assert [bool(axis.lines or axis.patches) for axis in own] == [True, False, True, True]
    with pytest.raises(dtsa.ConfigError, match="ax: got '2 axes'; allowed: 1"):
        dtsa.plot_distances(flight, ax=own[:2])
    with pytest.raises(dtsa.ConfigError, match="x: got 'moving'; allowed: one of the axes loss, scheme"):
        dtsa.plot_bars(swept, x="moving", y="crashed")


def test_missing_pandas_is_one_line(flight: dtsa.FlightLog, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(dtsa.ConfigError, match="pandas: got None; allowed: an installed pandas"):
        flight.receptions  # noqa: B018


GOOD = """
import dtsa

flight: dtsa.FlightLog = dtsa.simulate(agents=4, policy="lease", loss=0.1, seed=3)
settings: dtsa.RunConfig = dtsa.run_config(agents=4)
agent = dtsa.Agent(1, dtsa.SwarmConfig(agents=3))
frame: bytes | None = agent.on_slot(0)
verdict: dtsa.Verdict = dtsa.Channel(dtsa.ChannelConfig(agents=3)).arbitrate(0, [1])
found: dtsa.Verification = dtsa.verify("runs/a")
checked: bool = found.ok
version: str = dtsa.__version__
rows: int = len(dtsa.sweep(axes={"loss": [0.0, 0.1]}, seeds=3).axes)
"""
BAD = """
import dtsa

dtsa.nothing
dtsa.Agent("one", dtsa.SwarmConfig(agents=3))
dtsa.verify("runs/a").okay
dtsa.sweep("loss", {"loss": [0]})
dtsa.simulate(agnets=4)
dtsa.simulate(agents="four")
"""


def test_types_work_from_outside(tmp_path: Path) -> None:
    """A user's script, checked strictly from another directory, knows the types of the installed package."""
    pytest.importorskip("mypy")
    (tmp_path / "good.py").write_text(GOOD)
    (tmp_path / "bad.py").write_text(BAD)
    (tmp_path / "mypy.ini").write_text("[mypy]\nstrict = True\n")
    result = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", "mypy.ini", "good.py", "bad.py"],
        cwd=tmp_path, env={**os.environ, "MYPYPATH": ""}, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    errors = [line for line in result.stdout.splitlines() if ": error:" in line]
    assert {line.split(":")[0] for line in errors} == {"bad.py"}, result.stdout
    assert sorted({int(line.split(":")[1]) for line in errors}) == [4, 5, 6, 7, 8, 9], result.stdout


def test_the_document_is_true(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    document = ROOT / "docs" / "how-to" / "python.md"
    if not document.exists():
        pytest.skip("not in the source tree")
    shutil.copytree(run, tmp_path / "runs" / "a")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", document.read_text(encoding="utf-8"), re.DOTALL)
    assert all(">>>" in block for block in blocks)
    test = doctest.DocTestParser().get_doctest("\n".join(blocks), {}, document.name, str(document), 0)
    assert len(test.examples) > 20
    run_examples(test)


def run_examples(test: doctest.DocTest) -> None:
    failures: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=failures.append)
    assert not failures, "".join(failures)


@pytest.mark.parametrize("name", ["_flights", "_plots", "_sweep", "env"])
def test_examples_of_docstrings_run(name: str) -> None:
    if name == "env":
        pytest.importorskip("pettingzoo")
    module = importlib.import_module(f"dtsa.{name}")
    tests = [test for test in doctest.DocTestFinder().find(module, extraglobs={"dtsa": dtsa}) if test.examples]
    assert tests
    for test in tests:
        run_examples(test)
