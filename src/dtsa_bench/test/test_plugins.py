"""Policies, estimators and avoiders from a package of the user's, found by entry point."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dtsa
from dtsa_agent.core import REASONS, Agent, ConfigError, PluginError, SwarmConfig, plugins
from dtsa_agent.core.flight_models import flight_model
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.batch.task import Task
from dtsa_bench.simulate import simulate
from dtsa_bench.sweep import spec, work

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "dtsa_plugins"


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The example package, installed by pip into a directory of its own."""
    source, target = tmp_path_factory.mktemp("source") / "example", tmp_path_factory.mktemp("target")
    shutil.copytree(EXAMPLE, source)
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*command, "--target", str(target), str(source)], check=True, capture_output=True)
    sys.path.append(str(target))
    importlib.invalidate_caches()
    yield target
    sys.path.remove(str(target))
    sys.modules.pop("dtsa_plugins", None)


def flight(**settings: Any) -> Any:
    return simulate(spec.run_config({"agents": 6, "seed": 5, "timeout_s": 1.5, **settings}), trace=True)


def test_a_policy_of_ones_own_decides_who_sends() -> None:
    result = flight(policy="least-known")
    assert {REASONS[code] for code in result.trace.reasons} == {"plugin"}
    senders = result.trace.senders
    assert senders[:6] == [(i,) for i in range(1, 7)]
    assert all(len(ids) == 1 for ids in senders)
    assert [ids[0] for ids in senders[10::10]] == [slot // 10 % 6 + 1 for slot in range(10, len(senders), 10)]


def test_an_estimator_of_ones_own_feeds_avoider_and_metrics() -> None:
    linear, damped = (flight(estimator=name, policy="tdma") for name in ("linear", "damped"))
    quick = flight(estimator="damped", policy="tdma", options={"damped.rest_s": 0.05})
    assert len({f.trace.positions().tobytes() for f in (linear, damped, quick)}) == 3
    # Whoever is believed to stop at once is believed to be too far back.
    errors = [f.summary()["estimate_error_mean_m"] for f in (linear, damped, quick)]
    assert errors[0] < errors[1] < errors[2]
    swarm = quick.swarm
    age = (quick.metrics.slots - swarm.sent_slot[0]) * 0.01
    expected = swarm.sent_position[0] + swarm.sent_velocity[0] * age * (1 + 1 / (1 + age / 0.05)) / 2
    np.testing.assert_allclose(quick.trace.estimates[-1], expected, atol=1e-12)


def test_an_avoider_of_ones_own_flies() -> None:
    result = flight(avoider="give-way", timeout_s=20.0)
    assert result.summary()["end"] == "completed"
    assert flight_model("give-way").vehicle.tau == 0.1
    speed = np.linalg.norm(np.diff(result.trace.positions(), axis=0), axis=1) / 0.01
    assert 0.9 < speed.max() <= 1.0 + 1e-9
    straight = flight(
        avoider="none", timeout_s=20.0, options={"v_max": 1.0, "tau": 0.1, "spacing": 0.55, "min_radius": 1.8}
    )
    assert straight.summary()["end"] == "crashed"


def test_all_three_together_are_the_same_flight_every_time_and_with_single_agents() -> None:
    settings = {"policy": "least-known", "estimator": "damped", "avoider": "give-way", "timeout_s": 0.6}
    together = flight(**settings)
    config = SwarmConfig(agents=6, seed=5, **{k: v for k, v in settings.items() if k != "timeout_s"})
    agents = [Agent(i, config) for i in range(1, 7)]
    for slot in range(60):
        frames = {agent.id: agent.on_slot(slot) for agent in agents}
        sent = {i: data for i, data in frames.items() if data}
        assert tuple(sent) == together.trace.senders[slot]
        for agent in agents:
            agent.swarm.fly(slot)
            for i, data in sent.items():
                assert agent.id == i or agent.on_frame(data, slot)
        positions = np.concatenate([agent.swarm.position for agent in agents], axis=1)
        assert np.array_equal(positions, together.trace.tracks[slot][-1])


@pytest.mark.ros
def test_nodes_find_plugins_too_and_agree_with_the_simulator(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    from dtsa_bench.fly.flight import fly
    from dtsa_bench.fly.options import FlightOptions

    # Its processes inherit the way to the package.
    before = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, [str(installed), before])))
    settings = {"agents": 4, "policy": "least-known", "estimator": "damped", "avoider": "give-way", "loss": 0.1}
    run = spec.run_config({**settings, "seed": 5, "timeout_s": 0.8})
    real = fly(run, tmp_path / "flight", FlightOptions(processes=2, pictures=False))
    ours = simulate(run, trace=True)
    assert ours.trace is not None
    ends = np.stack([track[-1] for track in ours.trace.tracks])
    assert len(real.positions) >= 80
    assert np.array_equal(real.positions[1:80], ends[:79])


def test_sweeps_take_plugins_by_name_and_their_failures_are_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = spec.load_file(EXAMPLE / "sweep.yaml", seeds=1)
    assert {cell.labels["policy"] for cell in sweep.cells} == {"tdma", "dtsa", "least-known"}
    tasks = [task for task in sweep.tasks() if task.settings["policy"] == "least-known"]
    rows = [work.fly_one(task) for task in tasks]
    assert len(rows) == 4
    assert {row["status"] for row in rows} <= {"completed", "crashed"}
    assert all(row["summary"]["policy"] == "least-known" for row in rows)

    import dtsa_plugins

    monkeypatch.setattr(dtsa_plugins.LeastKnown, "choose", lambda self, view, slot: 1 // 0)
    row = work.fly_one(tasks[0])
    assert row["status"] == "failed"
    assert "ZeroDivisionError" in row["reason"]
    monkeypatch.setattr(dtsa_plugins.LeastKnown, "choose", lambda self, view, slot: 99)
    with pytest.raises(PluginError, match="policy least-known, choose: chose agent 99 in slot 0; allowed: 0"):
        simulate(spec.run_config({**tasks[0].settings, "agents": 6, "moving": 6}))


_WRONG = """
class {name}:
    def __init__(self, config, agent):
        if {where!r} == "factory":
            raise KeyError("no such option")

    def choose(self, table, slot):
        {choose}

    def estimate(self, table, slot, step, position, velocity):
        position[0, 0] = float("nan")

    def command(self, table, slot, step):
        return {command}
"""


def _wrong(where: str, choose: str = "return 1", command: str = "(0.0, 0.0, 0.0)") -> Any:
    scope: dict[str, Any] = {}
    exec(compile(_WRONG.format(name="Wrong", where=where, choose=choose, command=command), "wrong.py", "exec"), scope)
    return scope["Wrong"]


@pytest.mark.parametrize(
    ("kind", "wrong", "said"),
    [
        ("policy", _wrong("factory"), r"policy wrong: KeyError: 'no such option' \(wrong.py:5\)"),
        ("policy", _wrong("", "raise RuntimeError('lost')"), r"policy wrong, choose: RuntimeError: lost \(wrong"),
        ("policy", _wrong("", "while True: pass"), r"wrong, choose: TimeoutError: no answer within 0.2 s \(wrong.py:8"),
        ("policy", _wrong("", "return None"), r"wrong, choose: chose agent None in slot 0; allowed: 0 \(nobody\) to 4"),
        ("policy", _wrong("", "return 1.5"), "policy wrong, choose: chose agent 1.5 in slot 0"),
        ("policy", _wrong("", "return -1"), "policy wrong, choose: chose agent -1 in slot 0"),
        ("estimator", _wrong(""), "estimator wrong, estimate: wrote a number that is not finite in slot 0"),
        ("avoider", _wrong("", command="(1.0, 2.0)"), r"wrong, command: gave \(1.0, 2.0\) in slot 0; allowed: three"),
        ("avoider", _wrong("", command="(1.0, 2.0, float('inf'))"), "avoider wrong, command: gave"),
        ("avoider", _wrong("", command="'fast'"), "avoider wrong, command: gave 'fast'"),
    ],
)  # fmt: skip
def test_what_a_plugin_does_wrong_is_named_with_type_message_and_place(
    monkeypatch: pytest.MonkeyPatch, kind: str, wrong: Any, said: str
) -> None:
    monkeypatch.setenv("DTSA_PLUGIN_LIMIT_S", "0.2")
    dtsa.register(kind, "wrong", wrong)
    settings = {"policy": "tdma", "estimator": "linear", kind: "wrong"}
    run = spec.run_config({"agents": 4, "timeout_s": 0.2, **settings})
    with pytest.raises(PluginError, match=said):
        simulate(run)
    row = work.fly_one(Task("key", 0, 1, {"agents": 4, "timeout_s": 0.2, **settings}, 1.0))
    assert row["status"] == "failed"
    assert row["reason"].startswith(f"PluginError: {kind} wrong")


def test_a_plugin_that_catches_its_own_errors_or_waits_in_a_thread_is_ended_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("DTSA_PLUGIN_LIMIT_S", "0.2")
    settings = {"agents": 4, "timeout_s": 0.2, "policy": "wrong"}
    rows = []
    for choose in (
        "import time; time.sleep(60)",
        "while True:\n            try: pass\n            except Exception: pass",
    ):
        dtsa.register("policy", "wrong", _wrong("", choose))
        rows.append(work.fly_one(Task("key", 0, 1, settings, 1.0)))
    other = threading.Thread(target=lambda: rows.append(work.fly_one(Task("key", 0, 1, settings, 1.0))))
    other.start()  # as on a cluster
    other.join(timeout=30)
    assert len(rows) == 3
    assert all("policy wrong, choose: TimeoutError: no answer within 0.2 s (wrong.py:" in r["reason"] for r in rows)
    monkeypatch.setenv("DTSA_PLUGIN_LIMIT_S", "soon")
    with pytest.raises(ConfigError, match=r"^DTSA_PLUGIN_LIMIT_S: got .soon.; allowed: 0\.05 to 86400 s"):
        simulate(spec.run_config(settings))


@pytest.mark.ros
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("raise RuntimeError('lost')", "RuntimeError: lost ("),
        ("while True: pass", "TimeoutError: no answer within 1 s ("),
    ],
)
def test_a_plugin_that_raises_or_hangs_is_named_where_nodes_fly_it(
    installed: Path, tmp_path: Path, fault: str, said: str
) -> None:
    pytest.importorskip("rclpy")
    broken = tmp_path / "path"
    shutil.copytree(installed, broken)
    source = broken / "dtsa_plugins" / "__init__.py"
    source.write_text(
        source.read_text().replace("        speed = np.sqrt(", f"        {fault}\n        speed = np.sqrt(")
    )
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [str(broken), os.environ.get("PYTHONPATH", "")])),
        "DTSA_PLUGIN_LIMIT_S": "1",
    }
    for words in (["simulate"], ["fly", "--out", str(tmp_path / "flight"), "--no-picture", "--processes", "2"]):
        command = [sys.executable, "-m", "dtsa_bench", *words, "--agents", "4", "--policy", "least-known"]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
        assert ended.returncode == 1, words
        assert f"policy least-known, choose: {said}" in ended.stderr, words
        assert "Traceback" not in ended.stderr, words


def test_what_does_not_exist_or_does_not_import_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, near in (("policy", "least-known"), ("estimator", "damped"), ("avoider", "give-way")):
        with pytest.raises(ConfigError, match=f"^{kind}: got 'nothing'.*{near}"):
            SwarmConfig(**{kind: "nothing"})
    broken = importlib.metadata.EntryPoint("broken", "no_such_module:Thing", "dtsa.policies")
    monkeypatch.setattr(POLICIES, "plug_ins", lambda: {"broken": broken})
    with pytest.raises(ConfigError, match="no_such_module"):
        SwarmConfig(policy="broken")


def test_what_a_plugin_sees_it_cannot_change() -> None:
    swarm = plugins.make_swarm(SwarmConfig(agents=3, moving=2, policy="least-known"))
    table = plugins.Table(swarm, 0)
    for name in ("sent_position", "in_ap", "last_turn", "own_position", "goal"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(table, name)[...] = 0


def test_built_in_names_never_make_a_plugin_swarm() -> None:
    assert type(plugins.make_swarm(SwarmConfig())).__name__ == "Swarm"
    assert type(plugins.make_swarm(SwarmConfig(policy="least-known"))).__name__ == "PluginSwarm"
