"""Integration: what happens where a package is not installed: one line that names it, exit code 2."""

from __future__ import annotations

import subprocess
import sys

import pytest

# Finds everything but one package, as on a machine that lacks it.
WITHOUT = """
import sys
class Without:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == {package!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Without())
from {module} import {function}
sys.exit({function}({arguments}))
"""


@pytest.mark.parametrize(
    ("package", "module", "function", "arguments", "said"),
    [
        (
            "mcap",
            "dtsa_bench.commands.cli",
            "main",
            "['verify', 'x']",
            "dtsa: error: the Python package mcap is missing: pip",
        ),
        (
            "yaml",
            "dtsa_bench.commands.cli",
            "main",
            "['verify', 'x']",
            "yaml is missing: apt install python3-yaml",
        ),
        (
            "pyarrow",
            "dtsa_bench.commands.cli",
            "main",
            "['export', 'x']",
            "pyarrow is missing: pip install pyarrow",
        ),
        (
            "aiohttp",
            "dtsa_bench.commands.cli",
            "main",
            "['view', 'x']",
            "aiohttp is missing: pip install aiohttp",
        ),
        *(
            (
                package,
                "dtsa_bench.commands.cli",
                "main",
                "['sniff', '--air', 'serial', '--device', 'x', '--no-seal']",
                f"{package} is missing: pip install pyserial cobs",
            )
            for package in ("serial", "cobs")
        ),
        ("rclpy", "dtsa_bench.commands.cli", "main", "['demo']", "rclpy is missing: source an installation of ROS 2"),
        ("mcap", "dtsa_bench.entry", "recorded_channel", "", "recorded_channel: error: the Python package mcap"),
        ("dtsa_msgs", "dtsa_bench.entry", "recorded_channel", "", "dtsa_msgs is missing: build the workspace"),
    ],
)
def test_a_missing_package_is_named(package: str, module: str, function: str, arguments: str, said: str) -> None:
    program = WITHOUT.format(package=package, module=module, function=function, arguments=arguments)
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 2, result.stderr
    assert said in result.stderr
    assert result.stderr.count("\n") == 1
