"""The command line: errors in one line, exit codes, what is imported, and what happens where a package is missing."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable
from unittest.mock import MagicMock

import pytest
from cli_helpers import refused

from dtsa_agent.core.errors import ConfigError, RemoteProtocolError
from dtsa_bench.commands import cli, registry


def fake_command(monkeypatch: pytest.MonkeyPatch, action: Callable[[argparse.Namespace], int]) -> None:
    class ProbeCommand(registry.Command):
        description = ""

        def add_arguments(self, parser: argparse.ArgumentParser) -> None:
            parser.add_argument("--slots", type=int, default=0)

        def run(self, args: argparse.Namespace) -> int:
            return action(args)

    monkeypatch.setattr(cli, "load_command", lambda name: ProbeCommand())
    monkeypatch.setattr(cli, "COMMANDS", {"probe": "does what the test says"})


def test_exit_code_and_arguments_reach_the_command_and_a_bug_keeps_its_traceback(monkeypatch):
    fake_command(monkeypatch, lambda args: args.slots)
    assert cli.main(["probe", "--slots", "7"]) == 7
    assert cli.main(["probe"]) == 0
    fake_command(monkeypatch, MagicMock(side_effect=ZeroDivisionError))
    with pytest.raises(ZeroDivisionError):
        cli.main(["probe"])


@pytest.mark.parametrize(("error", "code", "said"), [
    (ConfigError("agents", 0, "2 to 1000"), 2, "dtsa: error: agents: got 0; allowed: 2 to 1000\n"),
    (RemoteProtocolError("frame of agent 3:\n  too short"), 1, "dtsa: error: frame of agent 3: too short\n"),
    (KeyboardInterrupt(), 130, ""),
])  # fmt: skip
def test_an_error_is_one_line_and_an_exit_code(error, code, said, monkeypatch, capsys):
    fake_command(monkeypatch, MagicMock(side_effect=error))
    assert (cli.main(["probe"]), capsys.readouterr().err.strip()) == (code, said.strip())


@pytest.mark.parametrize("words", [["probe", "--slots", "many"], ["probe", "--nothing"], ["nonsense"], []])
def test_wrong_arguments_are_one_line_and_exit_2(words, monkeypatch, capsys):
    fake_command(monkeypatch, lambda args: 0)
    assert refused(words, capsys).startswith("dtsa: error: ")


def test_an_interrupted_command_is_not_kept_by_what_is_left_of_the_interpreter() -> None:
    program = """
import atexit, sys, threading, time
from dtsa_bench import __main__ as entry
from dtsa_bench.commands import cli
atexit.register(print, "said at the end")
threading.Thread(target=time.sleep, args=(60,)).start()  # an interpreter that ends in good order waits for it
cli.main = lambda: int(sys.argv[1])
sys.exit(entry.dtsa())
"""
    words = [sys.executable, "-c", program, "130"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "said at the end\n", "")


@pytest.mark.parametrize("words", [["simulate", "--agents", "3", "--timeout-s", "1"], ["sweep", "--list"], ["--help"]])
def test_a_full_disk_behind_standard_output_is_one_line(words: list[str]) -> None:
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [sys.executable, "-m", "dtsa_bench", *words]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, env=buffered, check=False)
    said = "dtsa: error: standard output: No space left on device\n"
    assert (done.returncode, done.stderr) == (1, said)


def test_no_command_is_forgotten_and_help_imports_nothing_heavy() -> None:
    kinds = {type(registry.load_command(name)) for name in registry.COMMANDS}
    assert kinds >= {kind for kind in registry.Command.__subclasses__() if kind.__module__.startswith("dtsa_bench.c")}
    # That of the list of commands, and of commands that read runs.
    script = (
        "import sys; from dtsa_bench.commands.cli import build_parser; "
        "[build_parser(name) for name in (None, 'verify', 'report')]; assert 'subprocess' not in sys.modules; "
        "[build_parser(name) for name in ('replay', 'recover', 'export', 'sweep')]; "
        "print(sorted({'numpy', 'rclpy', 'matplotlib', 'pandas', 'rosbags'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


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
