"""Tries an installed `dtsa` where there is no ROS; prints what failed, and a digest of flights, as JSON.

A script of its own: it runs where `dtsa` alone is installed. It starts no other process, as QEMU cannot.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from pathlib import Path

import dtsa
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.commands.cli import main
from dtsa_bench.experiments.sweep import run_config
from dtsa_bench.simulation.simulate import simulate

SWEEP = "title: t\ntext: t\nbase: {agents: 6, timeout_s: 5}\naxes: {policy: [tdma, dtsa], loss: [0.0, 0.1]}\nseeds: 2\n"
PLAIN = {"agents": 12, "timeout_s": 10, "seed": 3}
LOSSY = {**PLAIN, "estimator": "intent", "avoider": "bvc", "loss": 0.1, "moving": 5}
# Command line, exit code, what it must print, and a file that it must make.
COMMANDS: tuple[tuple[str, int, str, str], ...] = (
    ("--version", 0, f"dtsa {dtsa.__version__}", ""),
    ("simulate --agents 12 --picture first.png", 0, "picture", "first.png"),
    ("simulate --agents 6 --policy lease --json", 0, '"policy": "lease"', ""),
    ("sweep --file sweep.yaml --out swept --jobs 1", 0, "", "swept/report.html"),
    ("new-plugin smoke-policy --out plug-in", 0, "", "plug-in/pyproject.toml"),
    ("completion bash", 0, "simulate", ""),
    ("fly --out flown", 2, "rclpy is missing: source an installation of ROS 2 Jazzy", ""),
)


def run(words: str) -> tuple[int, str]:
    """Exit code and output of a command line."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        try:
            return main(words.split()), text.getvalue()
        except SystemExit as end:
            return int(end.code or 0), text.getvalue()


def digest() -> str:
    """Of everything that happens in flights of each policy: positions, senders, outcomes, choices, priorities."""
    whole = hashlib.sha256()
    for settings in ({"policy": policy, **setting} for policy in POLICIES.names for setting in (PLAIN, LOSSY)):
        log = simulate(run_config(settings), log=True).log
        assert log is not None
        whole.update(log.position.tobytes() + log.score.tobytes() + log.outcome.tobytes() + log.chosen.tobytes())
        whole.update(json.dumps(log.senders()).encode())
    return whole.hexdigest()[:16]


if __name__ == "__main__":
    Path("sweep.yaml").write_text(SWEEP, encoding="utf-8")
    failures = [] if len(dtsa.simulate(agents=4, timeout_s=3).slots) else ["no table of slots"]
    for words, code, text, path in COMMANDS:
        exit_code, output = run(words)
        if exit_code != code or text not in output or not Path(path).exists():
            failures.append(f"dtsa {words}: exit code {exit_code}: {' '.join(output.split())[-200:]}")
    print(json.dumps({"version": dtsa.__version__, "failures": failures, "digest": digest()}))
