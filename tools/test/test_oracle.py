"""Integration: whole flights on both statements: equal in every frame, decision, digest and position."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from dtsa_dev.proofs.both_statements import Differs, Setting, fly_both, random_setting

from dtsa_agent.core import AbstractSwarm, ConfigError, Swarm, SwarmConfig
from dtsa_agent.core.reference.lease import issue, listen
from dtsa_agent.core.swarms.reference_swarm import ReferenceSwarm
from dtsa_channel_sim import ChannelConfig

SAMPLE = 10  # settings; `dtsa soak statements` has 200


@pytest.mark.parametrize("seed", range(1, SAMPLE + 1))
def test_flights_are_equal(seed: int) -> None:
    setting = random_setting(seed, lasts=False)
    assert fly_both(setting)["slots"] == setting.slots


@pytest.mark.parametrize("seed", [10, 36])
def test_flights_are_equal_in_which_the_dead_are_adopted_and_some_come_back(seed: int) -> None:
    figures = fly_both(random_setting(seed, "lease", lasts=True))
    assert figures["reasons"]["adopted"] > 100
    assert {"own", "anchor", "leased", "absent", "open"} <= set(figures["reasons"])


@pytest.mark.parametrize("moving", [2, 3])
def test_flights_are_equal_in_which_few_of_many_move(moving: int) -> None:
    """Movers give turns of their own away, and keep those that are worth most to themselves."""
    swarm = SwarmConfig(agents=12, moving=moving, policy="lease", avoider="none", axis_x_m=20.0, seed=3)
    figures = fly_both(Setting(swarm, ChannelConfig(agents=12, seed=3), 300))
    assert {"own", "anchor", "leased", "open"} <= set(figures["reasons"])


@pytest.mark.parametrize(
    ("module", "name", "value"),
    [
        (issue, "MISSED", 1),
        (issue, "RELAY_IDS", 1),
        (listen, "DEAF", 0),
        (issue, "OFTEN", 50.0),
    ],
)
def test_a_rule_that_differs_is_found(monkeypatch: pytest.MonkeyPatch, module: object, name: str, value: float) -> None:
    """The oracle itself: one constant of the specification changed."""
    monkeypatch.setattr(module, name, value)
    with pytest.raises(Differs, match="slot"):
        fly_both(random_setting(36, "lease", lasts=True))


FLIGHT = (
    "--policy", "lease", "--agents", "4", "--moving", "2", "--loss", "0.1", "--avoider", "none", "--jitter-m", "0.05",
    "--axis-y-m", "3", "--timeout-s", "3", "--json", "--no-stop-on-crash",
)  # fmt: skip
WITHOUT_KERNEL = """
import sys
sys.modules["dtsa_agent.core._kernel"] = None
from dtsa_bench.commands.cli import main
sys.exit(main(sys.argv[1:]))
"""


def simulated(*words: str, kernel: bool) -> subprocess.CompletedProcess[str]:
    command = ["-m", "dtsa_bench"] if kernel else ["-c", WITHOUT_KERNEL]
    return subprocess.run(
        [sys.executable, *command, "simulate", *words], capture_output=True, text=True, timeout=120, check=False
    )


def test_simulate_flies_on_the_specification_where_no_compiler_is() -> None:
    """And with the same results to the digit, but for the time it takes."""
    results = []
    for kernel, words in ((True, ()), (True, ("--core", "reference")), (False, ("--core", "reference"))):
        done = simulated(*FLIGHT, *words, kernel=kernel)
        assert done.returncode == 0, done.stderr
        results.append(
            {k: v for k, v in json.loads(done.stdout).items() if k not in ("wall_time_s", "realtime_factor")}
        )
    assert results[0] == results[1] == results[2]
    assert results[0]["age_mean_slots"] > 0
    refused = simulated(*FLIGHT, kernel=False)
    assert refused.returncode == 2
    assert "core: got 'compiled'; allowed: reference" in refused.stderr
    assert "Traceback" not in refused.stderr


def test_a_swarm_says_what_moves_it() -> None:
    config = SwarmConfig(agents=3)
    swarm: AbstractSwarm = Swarm(config, core="reference", shared_table=True)
    assert isinstance(swarm, ReferenceSwarm)
    assert type(Swarm(config)) is Swarm
    with pytest.raises(ConfigError, match="compiled, reference"):
        Swarm(config, core="other")
