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
from dtsa_bench import __main__ as entry
from dtsa_bench.commands import cli
words = {words!r}.split()
sys.exit(entry.recorded_channel() if words == ["recorded_channel"] else cli.main(words))
"""


@pytest.mark.parametrize(("package", "words", "said"), [
    ("mcap", "verify x", "dtsa: error: the Python package mcap is missing: pip"),
    ("yaml", "verify x", "yaml is missing: apt install python3-yaml"),
    ("pyarrow", "export x", "pyarrow is missing: pip install pyarrow"),
    ("aiohttp", "view x", "aiohttp is missing: pip install aiohttp"),
    ("serial", "sniff --air serial --device x --no-seal", "serial is missing: pip install pyserial cobs"),
    ("cobs", "sniff --air serial --device x --no-seal", "cobs is missing: pip install pyserial cobs"),
    ("rclpy", "demo", "rclpy is missing: source an installation of ROS 2"),
    ("mcap", "recorded_channel", "recorded_channel: error: the Python package mcap"),
    ("dtsa_msgs", "recorded_channel", "dtsa_msgs is missing: build the workspace"),
])  # fmt: skip
def test_a_missing_package_is_named(package: str, words: str, said: str) -> None:
    program = WITHOUT.format(package=package, words=words)
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert result.returncode == 2, result.stderr
    assert said in result.stderr
    assert result.stderr.count("\n") == 1
