"""Integration: policies, estimators and avoiders from a package of the user's, found by entry point."""

from __future__ import annotations

import importlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dtsa
from dtsa_agent.core import REASONS, Agent, ConfigError, PluginError, SwarmConfig, plug_in_random, plugins
from dtsa_agent.core.registry import POLICIES
from dtsa_agent.core.settings.flight_models import flight_model
from dtsa_bench.commands.cli import main
from dtsa_bench.experiments import sweep as spec
from dtsa_bench.experiments.batch import Task, attempt
from dtsa_bench.simulation.simulate import simulate

EXAMPLE = Path(__file__).resolve().parents[4] / "examples" / "dtsa_plugins"


@pytest.fixture(scope="module", autouse=True)
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
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
    return simulate(spec.run_config({"agents": 6, "seed": 5, "timeout_s": 1.5, **settings}), log=True, observer=1)


def test_a_policy_of_ones_own_decides_who_sends() -> None:
    result = flight(policy="least-known")
    assert {REASONS[code] for code in result.log.reason.ravel()} == {"plugin"}
    senders = result.log.senders()
    assert senders[:6] == [(i,) for i in range(1, 7)]
    assert all(len(ids) == 1 for ids in senders)
    assert [ids[0] for ids in senders[10::10]] == [slot // 10 % 6 + 1 for slot in range(10, len(senders), 10)]


def test_an_estimator_of_ones_own_feeds_avoider_and_metrics() -> None:
    linear, damped = (flight(estimator=name, policy="tdma") for name in ("linear", "damped"))
    quick = flight(estimator="damped", policy="tdma", options={"damped.rest_s": 0.05})
    assert len({f.log.positions().tobytes() for f in (linear, damped, quick)}) == 3
    # Whoever is believed to stop at once is believed to be too far back.
    errors = [f.summary()["estimate_error_mean_m"] for f in (linear, damped, quick)]
    assert errors[0] < errors[1] < errors[2]
    swarm = quick.swarm
    age = (quick.metrics.slots - swarm.sent_slot[0]) * 0.01
    expected = swarm.sent_position[0] + swarm.sent_velocity[0] * age * (1 + 1 / (1 + age / 0.05)) / 2
    np.testing.assert_allclose(quick.log.estimate[-1], expected, atol=1e-12)


def test_an_avoider_of_ones_own_flies() -> None:
    result = flight(avoider="give-way", timeout_s=20.0)
    assert result.summary()["end"] == "completed"
    assert flight_model("give-way").vehicle.tau == 0.1
    speed = np.linalg.norm(np.diff(result.log.positions(), axis=0), axis=1) / 0.01
    assert 0.9 < speed.max() <= 1.0 + 1e-9
    straight = flight(
        avoider="none", timeout_s=20.0, options={"v_max": 1.0, "tau": 0.1, "spacing": 0.55, "min_radius": 1.8}
    )
    assert straight.summary()["end"] == "crashed"


def test_all_three_together_are_the_same_flight_every_time_and_with_single_agents() -> None:
    settings = {"policy": "least-known", "estimator": "damped", "avoider": "give-way", "timeout_s": 0.6}
    together = flight(**settings)
    senders = together.log.senders()
    config = SwarmConfig(agents=6, seed=5, **{k: v for k, v in settings.items() if k != "timeout_s"})
    agents = [Agent(i, config) for i in range(1, 7)]
    for slot in range(60):
        frames = {agent.id: agent.on_slot(slot) for agent in agents}
        sent = {i: data for i, data in frames.items() if data}
        assert tuple(sent) == senders[slot]
        for agent in agents:
            agent.swarm.fly(slot)
            for i, data in sent.items():
                assert agent.id == i or agent.on_frame(data, slot)
        positions = np.concatenate([agent.swarm.position for agent in agents], axis=1)
        assert np.array_equal(positions, together.log.position[slot, -1])


@pytest.mark.ros
def test_nodes_find_plugins_too_and_agree_with_the_simulator(installed, tmp_path, monkeypatch):
    pytest.importorskip("rclpy")
    from dtsa_bench.flights.flight import fly
    from dtsa_bench.flights.options import FlightOptions

    monkeypatch.setenv("PYTHONPATH", str(installed), prepend=os.pathsep)
    settings = {"agents": 4, "policy": "least-known", "estimator": "damped", "avoider": "give-way", "loss": 0.1}
    run = spec.run_config({**settings, "seed": 5, "timeout_s": 0.8})
    real = fly(run, tmp_path / "flight", FlightOptions(processes=2, pictures=False))
    ours = simulate(run, log=True)
    ends = ours.log.position[:, -1]
    assert len(real.positions) >= 80
    assert np.array_equal(real.positions[1:80], ends[:79])


def test_sweeps_take_plugins_by_name_and_their_failures_are_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    sweep = spec.load_file(EXAMPLE / "sweep.yaml", seeds=1)
    assert {cell.labels["policy"] for cell in sweep.cells} == {"tdma", "dtsa", "least-known"}
    tasks = [task for task in sweep.tasks if task.settings["policy"] == "least-known"]
    rows = [attempt(task, spec.fly) for task in tasks]
    assert len(rows) == 4
    assert {row["status"] for row in rows} <= {"completed", "crashed"}
    assert all(row["summary"]["policy"] == "least-known" for row in rows)

    import dtsa_plugins

    monkeypatch.setattr(dtsa_plugins.LeastKnown, "choose", lambda self, view, slot: 1 // 0)
    row = attempt(tasks[0], spec.fly)
    assert row["status"] == "failed"
    assert "ZeroDivisionError" in row["reason"]
    monkeypatch.setattr(dtsa_plugins.LeastKnown, "choose", lambda self, view, slot: 99)
    with pytest.raises(PluginError, match="policy least-known, choose: chose agent 99 in slot 0; allowed: 0"):
        simulate(spec.run_config({**tasks[0].settings, "agents": 6, "moving": 6}))


@pytest.mark.ros
def test_a_plugin_that_raises_is_named_where_nodes_fly_it(installed: Path, tmp_path: Path) -> None:
    pytest.importorskip("rclpy")
    broken = tmp_path / "path"
    shutil.copytree(installed, broken)
    source = broken / "dtsa_plugins" / "__init__.py"
    line = "        speed = np.sqrt("
    source.write_text(source.read_text().replace(line, f"        raise RuntimeError('lost')\n{line}"))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(broken), os.environ.get("PYTHONPATH", "")])}
    for words in (["simulate"], ["fly", "--out", str(tmp_path / "flight"), "--no-picture", "--processes", "2"]):
        command = [sys.executable, "-m", "dtsa_bench", *words, "--agents", "4", "--policy", "least-known"]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
        assert ended.returncode == 1, words
        assert "policy least-known, choose: RuntimeError: lost (" in ended.stderr, words
        assert "Traceback" not in ended.stderr, words


class Empty:
    def __init__(self, config: object, agent: int) -> None:
        pass


class Mute(Empty):
    own_bytes = 1

    def choose(self, table: object, slot: int) -> int:
        return 1


class Odd:
    """Whatever is asked of it raises an error."""

    def _raise(self, *_: object) -> Any:
        raise KeyError("odd")

    __repr__ = __index__ = __len__ = __iter__ = __float__ = __bool__ = _raise


class Endless(Empty):
    def estimate(self, table: object, slot: int, step: int, position: Any, velocity: Any) -> None:
        position[0, 0] = float("nan")


def gives(method: str, answer: Any) -> type:

    def call(self: object, *_: object) -> Any:
        if isinstance(answer, BaseException):
            raise answer
        return answer

    return type("Wrong", (Empty,), {method: call})


@pytest.mark.parametrize(("kind", "wrong", "said"), [
    ("policy", lambda *_: {}["no such option"], r"^policy wrong: KeyError: 'no such option' \(.*plugins.py:\d"),
    ("policy", gives("choose", RuntimeError("lost")), r"^policy wrong, choose: RuntimeError: lost \(.*plugins.py"),
    ("policy", gives("choose", SystemExit(0)), r"^policy wrong, choose: SystemExit: 0 \(.*test_plugins.py"),
    ("policy", gives("choose", None), r"chose agent None in slot 0; allowed: an integer, 0 \(no agent\) to 4"),
    ("policy", gives("choose", 3.0), "wrong, choose: chose agent 3.0 in slot 0; allowed: an integer, 0"),
    ("policy", gives("choose", -1), "policy wrong, choose: chose agent -1 in slot 0"),
    ("policy", gives("choose", Odd()), r"^policy wrong, choose: chose agent <Odd> in slot 0; allowed: an int"),
    ("policy", gives("senders", None), r"^policy wrong, senders: gave None in slot 0; allowed: a list of the ids"),
    ("policy", gives("senders", Odd()), r"^policy wrong, senders: gave <Odd> in slot 0; allowed: a list"),
    ("policy", gives("wake", Odd()), r"^policy wrong, wake: gave <Odd> ns; allowed: whole numbers above 0"),
    ("policy", Empty, r"^policy wrong: Empty has no method choose\(table, slot\)$"),
    ("policy", lambda config, agent: None, r"^policy wrong: NoneType has no method choose"),
    ("policy", Mute, r"Mute has no method own_data\(table, slot\) and receive_data\(table, slot, sender, data\)$"),
    ("policy", type("Args", (), {}), r"^policy wrong: TypeError: Args\(\) takes no arguments"),
    ("estimator", Endless, "estimator wrong, estimate: wrote a number that is not finite in slot 0"),
    ("estimator", Empty, r": Empty has no method estimate\(table, slot, step, position, velocity\)$"),
    ("avoider", gives("command", (1.0, 2.0)), r"wrong, command: gave \(1.0, 2.0\) in slot 0; allowed: three"),
    ("avoider", gives("command", (1.0, 2.0, float("inf"))), "avoider wrong, command: gave"),
    ("avoider", gives("command", "fast"), "avoider wrong, command: gave 'fast'"),
    ("avoider", gives("command", Odd()), r"^avoider wrong, command: gave <Odd> in slot 0; allowed: three finite"),
    ("avoider", Empty, r"^avoider wrong: Empty has no method command\(table, slot, step\)$"),
])  # fmt: skip
def test_what_a_plugin_does_wrong_is_named_with_type_message_and_place(kind: str, wrong: Any, said: str) -> None:
    dtsa.register(kind, "wrong", wrong)
    settings = {"agents": 4, "timeout_s": 0.2, kind: "wrong"}
    with pytest.raises(PluginError, match=said):
        simulate(spec.run_config(settings))
    row = attempt(Task("key", 0, 1, settings, 1.0), spec.fly)
    assert row["status"] == "failed"
    assert row["reason"].startswith(f"PluginError: {kind} wrong")


@pytest.mark.parametrize(("kind", "attribute", "value"), [
    ("policy", "port", "send"), ("policy", "port", 3), ("policy", "port", (["send"],)), ("policy", "own_bytes", "3"),
    ("policy", "may_join", 1), ("policy", "own_bytes", Odd()), ("estimator", "needs_intent", Odd()),
    ("avoider", "model", []), ("policy", "options", "error_m"), ("estimator", "options", (1,)),
])  # fmt: skip
def test_attributes_that_mean_nothing_are_named(kind: str, attribute: str, value: Any) -> None:
    wrong = type("Wrong", (Empty,), {attribute: value})
    name = f"wrong-{kind}"

    def use() -> SwarmConfig:
        dtsa.register(kind, name, wrong)
        return SwarmConfig(**{kind: name}, options={f"{name}.error_m": 1.0})

    with pytest.raises(ConfigError, match=rf"^{name}\.{attribute}: got "):
        use()


@pytest.mark.parametrize(("option", "near"), [
    ("event-tdma.eror_m", "event-tdma.error_m"), ("event-tmda.error_m", "event-tdma"), ("damped.rest", "damped.rest_s"),
    ("least-known.every", ""), ("lease.probation", ""),
])  # fmt: skip
def test_an_option_that_no_plug_in_has_is_refused_with_the_nearest(option, near, tmp_path, capsys):
    for policy in ("event-tdma", "tdma"):
        file = tmp_path / "sweep.yaml"
        file.write_text(f"base: {{agents: 4, options: {{{option}: 9}}}}\naxes: {{policy: [{policy}]}}\n")
        for words in (
            ["simulate", "--agents", "4", "--policy", policy, "--options", f"{option}=9"],
            ["sweep", "--file", str(file), "--out", str(tmp_path / "runs")],
        ):
            assert main(words) == 2
            said = capsys.readouterr().err
            assert f"options: got '{option}'; allowed: " in said
            assert not near or said.endswith(f"; did you mean {near}?\n")
            assert len(said.splitlines()) == 1


def test_options_of_others_are_allowed_and_random_numbers_follow_from_seed_agent_and_name() -> None:
    for _ in range(2):
        SwarmConfig(policy="tdma", options={"event-tdma.error_m": 0.1, "damped.rest_s": 2.0})

    def drawn(seed: int, agent: int, name: str) -> bytes:
        return plug_in_random(SwarmConfig(seed=seed), agent, name).bytes(16)

    assert drawn(1, 1, "mine") == drawn(1, 1, "mine")
    assert len({drawn(*who) for who in ((1, 1, "mine"), (2, 1, "mine"), (1, 2, "mine"), (1, 1, "min"))}) == 4


_LOTS = """
from dtsa_agent.core import plug_in_random

class Lots:
    may_join = True
    def __init__(self, config, agent):
        self.agent, self.agents = agent, config.agents
        self.random = plug_in_random(config, agent, "lots")

    def choose(self, table, slot):
        return self.agent if self.random.random() < 1.0 / self.agents else 0


class Near:  # by estimates: the least difference of one shows
    def __init__(self, config, agent):
        self.agents = config.agents

    def choose(self, table, slot):
        return int(abs(table.estimate_position).sum() * 1e6) % self.agents + 1
"""


@pytest.mark.ros
@pytest.mark.parametrize(("policy", "counts"), [("lots", (1, 4)), ("near", (2,))])
def test_lots_and_estimates_are_the_same_in_nodes_processes_and_simulator_and_verified(
    policy: str, counts: Sequence[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    from dtsa_bench.flights.flight import fly
    from dtsa_bench.flights.options import FlightOptions

    (tmp_path / "lots_of_test.py").write_text(_LOTS)
    about = tmp_path / "lots-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: lots\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[dtsa.policies]\nlots = lots_of_test:Lots\nnear = lots_of_test:Near\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.syspath_prepend(str(tmp_path))
    run = spec.run_config({"agents": 4, "policy": policy, "loss": 0.1, "seed": 5, "timeout_s": 0.8})
    ours = simulate(run, log=True)
    assert {len(ids) for ids in ours.log.senders()} >= {0, 1}
    ends = ours.log.position[:, -1]
    for processes in counts:
        real = fly(run, tmp_path / f"flight-{processes}", FlightOptions(processes=processes, pictures=False))
        assert np.array_equal(real.positions[1:80], ends[:79])
        assert main(["verify", str(tmp_path / f"flight-{processes}")]) == 0


def test_what_does_not_exist_is_named_and_what_a_plugin_sees_it_cannot_change(monkeypatch: pytest.MonkeyPatch) -> None:
    for kind, near in (("policy", "least-known"), ("estimator", "damped"), ("avoider", "give-way")):
        with pytest.raises(ConfigError, match=f"^{kind}: got 'nothing'.*{near}"):
            SwarmConfig(**{kind: "nothing"})
    broken = importlib.metadata.EntryPoint("broken", "no_such_module:Thing", "dtsa.policies")
    monkeypatch.setattr(POLICIES, "plug_ins", lambda: {"broken": broken})
    with pytest.raises(ConfigError, match="no_such_module"):
        SwarmConfig(policy="broken")
    swarm = plugins.make_swarm(SwarmConfig(agents=3, moving=2, policy="least-known"))
    table = plugins.Table(swarm, 0)
    for name in ("sent_position", "in_ap", "last_turn", "own_position", "goal"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(table, name)[...] = 0
