"""Integration: whole flights in C under the sanitizers of addresses and of undefined behaviour."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from dtsa_dev.proofs.programs import LIBRARY, NotHere, compile_program, sources, tool

import dtsa_agent

SIMULATOR, SOCKETS = LIBRARY.parent / "libdtsa_sim", LIBRARY.parent / "air"
BINDING = Path(dtsa_agent.__file__).resolve().parents[1] / "build" / "binding" / "_kernel.c"
FLAGS = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined", "-shared", "-fPIC")
FLIGHTS = """
import importlib.machinery, importlib.util, sys
name = "dtsa_agent.core._kernel"
loader = importlib.machinery.ExtensionFileLoader(name, sys.argv[1])
kernel = sys.modules[name] = importlib.util.module_from_spec(importlib.util.spec_from_loader(name, loader))
loader.exec_module(kernel)
from dtsa_bench.experiments.sweep import run_config
from dtsa_bench.simulation.simulate import simulate
from dtsa.env import parallel_env

bursts = {"loss": 0.2, "burst_length": 3.0}
for policy in ("tdma", "dtsa", "age", "aloha", "lease"):
    for agents in (1, 2, 5, 18, 33):
        for more in (
            {}, {"loss": 0.2}, bursts, {**bursts, "burst_scope": "link"}, {"range_m": 3.0}, {"avoider": "bvc"},
            {"avoider": "potential", "slot_ms": 30.0}, {"estimator": "intent", "scenario": "waypoints"},
        ):
            if agents < 4:
                more = {"moving": 0, **more, "scenario": "exchange"}
            settings = {"seed": agents, "timeout_s": 0.5, "stop_on_crash": False, "agents": agents, "policy": policy}
            run = run_config({**settings, **more})
            for log in (False, True):
                simulate(run, log=log, frames=log)
long = {"agents": 6, "loss": 0.1, "policy": "aloha", "timeout_s": 25.0, "tail_s": 30.0, "stop_on_crash": False}
assert len(simulate(run_config(long), log=True, frames=True).log) > 2048
env = parallel_env(agents=6, loss=0.1, slots=50)
env.reset(seed=1)
while env.agents:
    env.step(dict.fromkeys(env.agents, 1))
print("flown")
"""


def test_flights_touch_nothing_that_is_not_theirs(tmp_path: Path) -> None:
    pytest.importorskip("pettingzoo")
    try:
        gcc = tool("gcc", "gcc")
    except NotHere as error:
        pytest.skip(str(error))
    if not BINDING.exists():
        pytest.skip(f"no {BINDING}: the binding was compiled elsewhere")
    paths = (sysconfig.get_paths()["include"], LIBRARY / "avoider", SIMULATOR, SOCKETS)
    flags = (*FLAGS, "-DPy_LIMITED_API=0x030a0000", *(f"-I{path}" for path in paths))
    files = [BINDING, *sources(), *sorted(SIMULATOR.glob("*.c")), *sorted(SOCKETS.glob("*.c"))]
    kernel = compile_program(gcc, tmp_path / "_kernel.so", files, flags)
    preload = subprocess.run([gcc, "-print-file-name=libasan.so"], capture_output=True, text=True, check=True)
    environment = {**os.environ, "LD_PRELOAD": preload.stdout.strip(), "ASAN_OPTIONS": "detect_leaks=0"}
    command = [sys.executable, "-c", FLIGHTS, str(kernel)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=280, check=False)
    assert (done.returncode, done.stdout) == (0, "flown\n"), done.stderr[-3000:]
