"""Sweeps: read, flown on cores and clusters, interrupted and resumed, counted honestly."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import yaml
from cli_helpers import refused
from fly_helpers import children
from waiting import wait_for

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_bench.commands.cli import main
from dtsa_bench.drawing.style import INK
from dtsa_bench.experiments import batch
from dtsa_bench.experiments import sweep as spec
from dtsa_bench.experiments.batch import Journal
from dtsa_bench.experiments.provenance import PROJECT
from dtsa_bench.experiments.tables import SweepTable

ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
CONTENT: dict[str, Any] = {
    "title": "small", "seeds": 6, "base": {"agents": 6, "timeout_s": 0.6},
    "axes": {"policy": ["tdma", "dtsa"], "channel": {"clear": {}, "lossy": {"loss": 0.2}}},
    "figures": [{"kind": "matrix", "rows": "policy", "columns": "channel", "y": ["crashed"]}],
}  # fmt: skip


def sweep(**changes: Any) -> spec.Sweep:
    content = {**CONTENT, **changes}
    if "axes" in changes and "figures" not in changes:
        del content["figures"]
    return spec.make_sweep(content, "small")


def stable(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{key: value for key, value in row.items() if key != "wall_time_s"} for row in rows]


def fly(directory: Path, plan: spec.Sweep, **options: Any) -> SweepTable:
    with closing(Journal(directory, plan.batch)) as journal:
        return SweepTable(plan, batch.run_all(plan.batch, journal, **options))


def lines_of(directory: Path) -> list[str]:
    return (directory / "runs.jsonl").read_text(encoding="utf-8").splitlines()


def test_axes_are_combined_and_names_may_be_of_any_section() -> None:
    plan = sweep(base={"agents": 6, "timeout_s": 0.6, "burst_length": 4.0, "epsilon": 0.25})
    assert [cell.labels for cell in plan.cells] == [
        {"policy": p, "channel": c} for p in ("tdma", "dtsa") for c in ("clear", "lossy")
    ]
    run = plan.cells[3].run(5)
    assert (run.swarm.policy, run.air.loss, run.air.burst_length) == ("dtsa", 0.2, 4.0)
    assert run.limits.timeout_s == 0.6
    assert (run.swarm.seed, run.air.seed, run.swarm.epsilon) == (5, 5, 0.25)
    assert plan.seeds == tuple(range(1001, 1007))
    assert sweep(seeds=[3, 9]).seeds == (3, 9)
    assert spec.make_sweep(CONTENT, "s", seeds=2, first_seed=50).seeds == (50, 51)


@pytest.mark.parametrize(("changes", "field"), [
    ({"axes": {"color": ["red"]}}, "axes.color"), ({"axes": {"policy": []}}, "axes.policy"),
    ({"axes": {"agents": [6, -3]}}, "agents"), ({"axes": {"x": {"a": {"nothing": 1}}}}, "nothing"),
    ({"axes": {"channel": {"a": {"loss": 1.5}}}}, "loss"), ({"base": {"timeout": 3}}, "timeout"),
    ({"base": []}, "base"), ({"seeds": 0}, "seeds"), ({"seeds": ["a"]}, "seeds"),
    ({"color": "red"}, "color"),
    *(({"figures": [figure]}, f"figures[0].{name}") for figure, name in (
        ({"kind": "pie"}, "kind"), ({"kind": ["bars"]}, "kind"), ({"kind": "trajectories"}, "facets"),
        ({"kind": "bars", "x": "moving", "y": []}, "x"), ({"kind": "bars", "x": "policy", "y": []}, "y"),
        ({"kind": "bars", "x": "policy"}, "y"), ({"kind": "bars", "x": "policy", "y": ["speed"]}, "y"),
        ({"kind": "bars", "x": "policy", "y": ["crashed"], "facets": "channel"}, "facets"),
        ({"kind": "bars", "x": "policy", "y": ["crashed"], "log": "crashed"}, "log"),
        ({"kind": "bars", "x": "policy", "y": ["crashed"], "name": "../x"}, "name"),
        ({"kind": "lines", "x": "policy", "y": ["crashed"]}, "x"), ({"kind": "matrix", "rows": "policy"}, "columns"),
    )),
])  # fmt: skip
def test_what_is_wrong_is_named_before_anything_flies(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(ConfigError) as caught:
        sweep(**changes)
    assert caught.value.field == field


def test_files_that_are_no_sweeps_are_refused(tmp_path: Path) -> None:
    for text in ("- 1\n- 2\n", "a: [", "\x00"):
        path = tmp_path / "sweep.yaml"
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ConfigError, match="file"):
            spec.load_file(path)
    with pytest.raises(ConfigError, match="readable"):
        spec.load_file(tmp_path / "missing.yaml")
    with pytest.raises(ConfigError, match="paper-12"):
        spec.load_preset("nothing")


def test_a_sweep_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = sweep()
    whole = fly(tmp_path / "whole", plan).rows
    monkeypatch.setattr(batch, "CHUNK_COST", 1.0)

    def stop(runs: int, cost: float) -> None:
        seen.append(runs)
        if len(seen) == 7:
            raise KeyboardInterrupt

    seen: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        fly(tmp_path / "parts", plan, advance=stop)
    assert len(lines_of(tmp_path / "parts")) == 7
    with (tmp_path / "parts" / "runs.jsonl").open("a") as file:
        file.write('{"key": "torn')  # a kill in the middle of a line
    flown: list[int] = []
    again = fly(tmp_path / "parts", plan, advance=lambda runs, cost: flown.append(runs)).rows
    assert sum(flown) == 24 - 7
    assert stable(again) == stable(whole)
    flown.clear()
    assert fly(tmp_path / "parts", plan, advance=lambda runs, cost: flown.append(runs)).rows == again
    assert not flown


def test_rows_of_other_code_and_of_other_sweeps_are_never_mixed_in(tmp_path, monkeypatch):
    plan = sweep(seeds=1)
    whole = stable(fly(tmp_path, plan).rows)
    with monkeypatch.context() as patched:
        patched.setattr(batch, "code_digest", lambda plug_ins: "other")
        with closing(Journal(tmp_path, plan.batch)) as journal:
            assert (journal.other_code, journal.rows) == (4, {})
            journal.append([{"key": plan.tasks[0].key, "status": "completed", "seed": 1, "summary": {}}])
        digests = iter(["other", "worker's"])
        patched.setattr(batch, "code_digest", lambda plug_ins: next(digests))
        with pytest.raises(DtsaError, match=r"other code .worker's"):
            batch.run_all(plan.batch)
    with closing(Journal(tmp_path, plan.batch)) as journal:
        assert (journal.other_code, len(journal.rows)) == (1, 4)
    assert stable(fly(tmp_path, plan).rows) == whole
    with pytest.raises(ConfigError, match="small"):
        Journal(tmp_path, spec.make_sweep(CONTENT, "big").batch)


def test_all_code_that_flies_is_in_the_digest() -> None:
    text = f"""
import sys
from dtsa_bench.experiments import sweep
plan = sweep.make_sweep({CONTENT!r}, "small")
assert sweep.fly(plan.tasks[0])[0] != "failed"
print(*sorted({{name.partition(".")[0] for name in sys.modules if name.startswith("dtsa")}}))
"""
    ended = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=120, check=True)
    assert set(ended.stdout.split()) == set(PROJECT)


def test_changed_settings_are_flown_anew_and_equal_ones_are_kept(tmp_path: Path) -> None:
    fly(tmp_path, sweep(seeds=2))
    flown: list[int] = []
    fly(tmp_path, sweep(seeds=3), advance=lambda runs, cost: flown.append(runs))
    assert sum(flown) == 4
    flown.clear()
    fly(tmp_path, sweep(seeds=2, base={"agents": 8, "timeout_s": 0.6}), advance=lambda r, c: flown.append(r))
    assert sum(flown) == 8


def test_failures_are_rows_with_a_reason_and_are_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from dtsa_bench.simulation import simulate

    real = simulate.simulate

    def sometimes(run: Any) -> Any:
        if run.swarm.policy == "dtsa" and run.swarm.seed % 2 == 0:
            raise RuntimeError("out of\nluck")
        return real(run)

    monkeypatch.setattr(simulate, "simulate", sometimes)
    plan = sweep()
    group = fly(tmp_path, plan).select_groups(policy="dtsa", channel="clear")[0]
    assert (len(group.rows), group.flown_count, group.failed, group.crashed.total) == (6, 3, 3, 3)
    assert group.left_out["failed (RuntimeError: out of luck)"] == 3
    monkeypatch.setattr(simulate, "simulate", real)
    assert all(row["status"] != "failed" for row in fly(tmp_path, plan).rows)


def test_crashes_and_timeouts_are_left_out_of_means_and_counted(tmp_path: Path) -> None:
    plan = sweep(base={"agents": 12, "slot_ms": 20.0, "estimator": "hold", "timeout_s": 20.0}, seeds=12, axes={
        "agents": [8, 14], "timeout_s": [0.5, 20.0],
    })  # fmt: skip
    table = fly(tmp_path, plan)
    late = table.select_groups(agents=8, timeout_s=0.5)[0]
    assert late.left_out == {"timed out": 12}
    assert late.mean("min_distance_m").count == 0
    assert late.mean("age_mean_slots").count == 12
    risky = table.select_groups(agents=14, timeout_s=20.0)[0]
    crashed = sum(row["collided"] for row in risky.rows)
    assert crashed > 0
    assert risky.left_out.get("crashed", 0) == crashed == risky.crashed.count
    assert risky.mean("min_distance_m").count == 12 - crashed
    kept = [row["min_distance_m"] for row in risky.rows if not row["collided"]]
    assert not kept or risky.mean("min_distance_m").value == pytest.approx(sum(kept) / len(kept))


def test_the_command_writes_everything(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(CONTENT), encoding="utf-8")
    out = tmp_path / "out"
    words = ["sweep", "--file", str(path), "--out", str(out), "--seeds", "2"]
    words += ["--set", "timeout_s=0.4", "--jobs", "1"]
    assert main(words) == 0
    assert "8 runs" in capsys.readouterr().out
    with (out / "results.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 8
    assert {row["policy"] for row in rows} == {"tdma", "dtsa"}
    assert {float(row["flight_time_s"]) for row in rows} <= {0.4}
    content = json.loads((out / "results.json").read_text())
    assert len(content["runs"]) == 8
    assert len(content["groups"]) == 4
    assert content["groups"][0]["crashed"]["of"] == 2
    assert content["sweep"]["base"]["timeout_s"] == 0.4
    assert "<svg" in (out / "report.html").read_text()
    # In the colours of the page, so that a dark one has light lines; files of their own keep theirs.
    assert "var(--ink)" in (out / "report.html").read_text()
    assert INK not in (out / "report.html").read_text().split("<figure", 1)[1]
    assert (out / "figures" / "matrix.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(("words", "field"), [
    (["--preset", "nothing"], "preset"), (["--preset", "idle", "--seeds", "0"], "seeds"),
    (["--preset", "idle", "--jobs", "many"], "jobs"), (["--preset", "idle", "--set", "loss"], "set"),
    (["--preset", "idle", "--set", "loss=2"], "loss"),
    (["--preset", "estimate", "--cluster", "tcp://127.0.0.1:1"], "cluster"), ([], ""),
])  # fmt: skip
def test_wrong_words_end_with_one_line_and_code_2(words, field, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(batch, "PATIENCE_S", 1.0)
    if field == "cluster":
        pytest.importorskip("distributed")
    assert f"error: {field}" in refused(["sweep", *words, "--out", str(tmp_path)], capsys)


def run_python(code: str, *words: str) -> subprocess.CompletedProcess[str]:
    code = f"{code}\nimport sys\nfrom dtsa_bench.commands.cli import main\nsys.exit(main({list(words)!r}))"
    return subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("how", ["ctrl-c", "terminated", "killed"])
def test_however_a_sweep_ends_nothing_runs_on_and_its_rows_stay(how: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "dtsa_bench", "sweep", "--preset", "limits", "--jobs", "2", "--out", str(tmp_path)]
    marked = {**ENVIRONMENT, "DTSA_SUPERVISOR": str(os.getpid())}
    process = subprocess.Popen(
        command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=marked
    )
    try:
        rows = tmp_path / "runs.jsonl"
        wait_for(lambda: rows.exists() and rows.read_bytes().count(b"\n") >= 5)
        if how == "ctrl-c":
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.send_signal(signal.SIGTERM if how == "terminated" else signal.SIGKILL)
        error = process.communicate(timeout=60)[1].decode()
        assert process.returncode == (-signal.SIGKILL if how == "killed" else 130)
        wait_for(lambda: not children(os.getpid()), 20.0)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    if how != "killed":
        assert "goes on from there" in error
        assert "Traceback" not in error
    assert len(lines_of(tmp_path)) >= 5


def test_a_worker_process_that_dies_costs_no_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = sweep(seeds=200)
    victims: list[int] = []

    def kill_one(runs: int, cost: float) -> None:
        if not victims:
            children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
            names = {int(pid): Path(f"/proc/{pid}/cmdline").read_text() for pid in children}
            victims.append(next(pid for pid, name in names.items() if "batch.serve" in name))
            os.kill(victims[0], signal.SIGKILL)

    monkeypatch.setattr(batch, "CHUNK_COST", 20_000.0)
    rows = fly(tmp_path / "cores", plan, jobs=2, advance=kill_one).rows
    assert victims
    assert len(rows) == 800
    assert all(row["status"] != "failed" for row in rows)
    assert [row["seed"] for row in rows[:200]] == list(plan.seeds)
    here = fly(tmp_path / "here", sweep()).rows
    assert [row for row in stable(rows) if row["seed"] < 1007] == stable(here)  # cores change nothing


def test_a_sweep_needs_no_shared_memory(tmp_path: Path) -> None:
    """As on a machine whose /dev/shm is missing, full or read-only, where no semaphore can be made."""
    code = """
import _multiprocessing
class Semaphore(_multiprocessing.SemLock):
    def __new__(cls, *args, **more):
        raise OSError(28, "No space left on device")
_multiprocessing.SemLock = Semaphore
"""
    words = ("sweep", "--preset", "trajectories", "--seeds", "2", "--jobs", "2", "--no-report", "--out", str(tmp_path))
    ended = run_python(code, *words)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert len(lines_of(tmp_path)) == 6


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    pytest.importorskip("distributed")
    file = tmp_path / "scheduler.json"

    def start(what: str, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{what}", "--scheduler-file", str(file), "--no-dashboard"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        return subprocess.Popen([*command, *words], env=ENVIRONMENT, **quiet)  # type: ignore[call-overload, no-any-return]

    processes = [start("dask_scheduler", "--host", "127.0.0.1", "--port", "0")]
    alone = ("--nworkers", "1", "--nthreads", "1", "--no-nanny", "--local-directory", str(tmp_path))
    try:
        processes += [start("dask_worker", *alone) for _ in range(2)]
        wait_for(lambda: file.exists() and file.read_text().rstrip().endswith("}"))
        yield json.loads(file.read_text())["address"], processes[1:]
    finally:
        for process in processes:
            process.kill()
            process.wait()


def test_a_worker_of_a_cluster_that_dies_costs_no_result(cluster, tmp_path, monkeypatch):
    from distributed import Client

    address, workers = cluster
    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(2, timeout=60)
    plan = sweep(seeds=100)
    monkeypatch.setattr(batch, "CHUNK_COST", 20_000.0)
    done: list[int] = []

    def kill_one(runs: int, cost: float) -> None:
        done.append(runs)
        if len(done) == 3:
            workers[0].kill()

    rows = fly(tmp_path / "cluster", plan, cluster=address, advance=kill_one).rows
    assert len(done) > 3
    assert workers[0].wait() == -signal.SIGKILL
    assert len(rows) == 400
    here = fly(tmp_path / "here", sweep(seeds=5)).rows
    picked = [row for row in stable(rows) if row["seed"] < 1006]
    assert picked == stable(here)


def test_rows_that_cannot_be_written_end_in_one_line(tmp_path: Path) -> None:
    limit = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (6000, 6000))"
    words = ("sweep", "--preset", "trajectories", "--seeds", "9", "--jobs", "1", "--out", str(tmp_path))
    ended = run_python(limit, *words)
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1
    assert "runs.jsonl cannot be written (File too large)" in ended.stderr
    assert 0 < len(lines_of(tmp_path)) < 28
