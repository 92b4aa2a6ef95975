"""An empty checkout for the tests of the tools."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from machine import layout, workspace


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty place that stands for the checkout: sources are copied, nothing is built."""
    for package in workspace.PACKAGES:
        ignore = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info", "test")
        shutil.copytree(layout.SOURCES / package, tmp_path / "src" / package, ignore=ignore)
    shutil.copytree(layout.REQUIREMENTS, tmp_path / "requirements")
    places = {
        "ROOT": ".", "SOURCES": "src", "REQUIREMENTS": "requirements", "BUILD": "build", "INSTALL": "install",
        "VENV": ".venv", "PYTHON": ".venv/bin/python", "VENV_STAMPS": ".venv/.dtsa",
        "STATE": ".dtsa", "STEP_LOGS": ".dtsa/log",
    }  # fmt: skip
    for name, place in places.items():
        monkeypatch.setattr(layout, name, tmp_path / place)
    return tmp_path
