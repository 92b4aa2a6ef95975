"""Imports go one way: the contracts of ``pyproject.toml``, checked over the sources, imports in functions included."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[4]
PACKAGES = ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench", "dtsa")
SOURCES = [ROOT / "src" / name for name in ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench")]


def lint(directory: Path, sources: list[Path]) -> subprocess.CompletedProcess[str]:
    """Runs ``lint-imports`` with the project's contracts over some source folders."""
    command = [sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()"]
    paths = os.pathsep.join([*map(str, sources), os.environ.get("PYTHONPATH", "")])
    return subprocess.run(
        [*command, "--config", str(ROOT / "pyproject.toml"), "--no-cache"],
        cwd=directory, env={**os.environ, "PYTHONPATH": paths}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip


def test_imports_go_one_way_and_have_no_cycles(tmp_path: Path) -> None:
    result = lint(tmp_path, SOURCES)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "0 broken" in result.stdout


def test_an_import_against_the_arrows_is_found(tmp_path: Path) -> None:
    copies = []
    for source in SOURCES:
        for file in (f for package in PACKAGES for f in (source / package).rglob("*.py")):
            target = tmp_path / source.name / file.relative_to(source)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
        copies.append(tmp_path / source.name)
    errors = tmp_path / "dtsa_agent" / "dtsa_agent" / "core" / "errors.py"
    hidden = "\n\ndef late() -> None:\n    from dtsa_bench.commands import cli\n\n    print(cli)\n"
    errors.write_text(errors.read_text() + hidden)
    result = lint(tmp_path, copies)
    assert result.returncode != 0
    assert "dtsa_agent is not allowed to import dtsa_bench" in " ".join(result.stdout.split())
