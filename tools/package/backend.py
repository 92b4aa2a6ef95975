"""Builds the distribution `dtsa` from a checkout: `pip install .`, `pip wheel .`, `tools/dtsa release`.

The workspace's root cannot be a Python package itself: `colcon build` would take it for one and look no further. So the
sources are put into a folder of their own with the files beside this one on top, and setuptools builds there.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from setuptools import build_meta

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
_TOP = ("README.md", "LICENSE", "NOTICE", "CHANGELOG.md", "CITATION.cff")
_PACKAGES = ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench")
_MESSAGES = "dtsa_bench/dtsa_bench/recordings/bag/messages"  # bags are written without ROS, too
_LEFT_OUT = shutil.ignore_patterns("__pycache__", "*.so", "*.egg-info", "build", "test", "urdf", "rviz", "launch")


def lay_out(folder: Path) -> None:
    """Puts all that belongs into the distribution into a folder.

    :param folder: an empty one.
    """
    for name in _TOP:
        shutil.copy2(ROOT / name, folder)
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in"):
        shutil.copy2(HERE / name, folder)
    for name in _PACKAGES:
        shutil.copytree(ROOT / "src" / name, folder / "src" / name, ignore=_LEFT_OUT)
    shutil.copytree(ROOT / "src" / "dtsa_msgs" / "msg", folder / "src" / _MESSAGES)


@contextmanager
def _laid_out() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="dtsa-") as name:
        lay_out(Path(name))
        before = Path.cwd()
        os.chdir(name)
        try:
            yield
        finally:
            os.chdir(before)


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Nothing but what pyproject.toml names."""
    return []


get_requires_for_build_sdist = get_requires_for_build_wheel


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """The wheel; PEP 517."""
    out = os.path.abspath(wheel_directory)
    with _laid_out():
        return build_meta.build_wheel(out, config_settings)


def build_sdist(sdist_directory: str, config_settings: Any = None) -> str:
    """The source distribution; PEP 517."""
    out = os.path.abspath(sdist_directory)
    with _laid_out():
        return build_meta.build_sdist(out, config_settings)
