"""The command line: errors in one line, exit codes, and what is imported."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from types import ModuleType

import pytest

from dtsa_agent.core.errors import ConfigError, RemoteProtocolError
from dtsa_bench.commands import cli, registry


def fake_command(monkeypatch: pytest.MonkeyPatch, action: object) -> None:
    """Register one command `probe` that does what the action says."""
    module = ModuleType("dtsa_bench.commands.probe")

    def add_arguments(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--slots", type=int, default=0)

    module.DESCRIPTION, module.EXAMPLES, module.add_arguments = "", (), add_arguments  # type: ignore[attr-defined]
    module.run = action  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "dtsa_bench.commands.probe", module)
    monkeypatch.setattr(cli, "COMMANDS", {"probe": "does what the test says"})


def test_exit_code_and_arguments_reach_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_command(monkeypatch, lambda args: args.slots)
    assert cli.main(["probe", "--slots", "7"]) == 7
    assert cli.main(["probe"]) == 0


def test_config_error_is_one_line_and_exit_2(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(args: argparse.Namespace) -> int:
        raise ConfigError("agents", 0, "2 to 1000")

    fake_command(monkeypatch, fail)
    assert cli.main(["probe"]) == 2
    assert capsys.readouterr().err == "dtsa: error: agents: got 0; allowed: 2 to 1000\n"


def test_other_errors_of_ours_are_one_line_and_exit_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(args: argparse.Namespace) -> int:
        raise RemoteProtocolError("frame of agent 3:\n  too short")

    fake_command(monkeypatch, fail)
    assert cli.main(["probe"]) == 1
    assert capsys.readouterr().err == "dtsa: error: frame of agent 3: too short\n"


def test_a_bug_keeps_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(args: argparse.Namespace) -> int:
        raise ZeroDivisionError

    fake_command(monkeypatch, fail)
    with pytest.raises(ZeroDivisionError):
        cli.main(["probe"])


def test_an_interrupted_command_is_not_kept_by_what_is_left_of_the_interpreter() -> None:
    program = """
import atexit, sys, threading, time
from dtsa_bench import entry
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


def test_interrupt_is_exit_130_without_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(args: argparse.Namespace) -> int:
        raise KeyboardInterrupt

    fake_command(monkeypatch, interrupt)
    assert cli.main(["probe"]) == 130
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("words", [["probe", "--slots", "many"], ["probe", "--nothing"], ["nonsense"], []])
def test_wrong_arguments_are_one_line_and_exit_2(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    fake_command(monkeypatch, lambda args: 0)
    with pytest.raises(SystemExit) as stopped:
        cli.main(words)
    error = capsys.readouterr().err
    assert stopped.value.code == 2
    assert error.startswith("dtsa: error: ")
    assert error.count("\n") == 1


def test_every_command_has_its_help() -> None:
    for name in registry.COMMANDS:
        parser, module = cli.build_parser(name)
        assert module is not None
        with pytest.raises(SystemExit) as stopped:
            parser.parse_args([name, "--help"])
        assert stopped.value.code == 0


def test_no_command_module_is_forgotten() -> None:
    from importlib.resources import files

    package = "dtsa_bench.commands"
    found = {
        f"{package}.{file.name.removesuffix('.py')}"
        for file in files(package).iterdir()
        if file.name.endswith(".py") and "EXAMPLES = (" in file.read_text()
    }
    assert found == {name for name in map(registry.module_of, registry.COMMANDS) if name.startswith(package)}


def test_the_list_of_commands_imports_nothing_heavy() -> None:
    script = (
        "import sys; from dtsa_bench.commands.cli import build_parser; build_parser(None); "
        "print(sorted({'numpy', 'rclpy', 'matplotlib', 'pandas', 'rosbags'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_help_of_commands_that_read_runs_imports_nothing_heavy() -> None:
    script = (
        "import sys; from dtsa_bench.commands.cli import build_parser; "
        "[build_parser(name) for name in ('verify', 'report', 'replay', 'recover', 'export', 'sweep')]; "
        "print(sorted({'numpy', 'rclpy', 'matplotlib', 'pandas', 'rosbags'} & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"
