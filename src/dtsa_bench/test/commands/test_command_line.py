"""Integration: the command line as people use it: help, misspelt words, completion; nothing half done is left."""

from __future__ import annotations

import json
import shlex
import subprocess
from contextlib import redirect_stdout
from pathlib import Path

import pytest
from cli_helpers import refused
from dtsa_dev.registry import add_commands

import checkout
from dtsa_bench.commands import cli, registry
from dtsa_bench.commands.cli import CHECKOUT_COMMANDS, CommandParser, build_parser
from dtsa_bench.flights.progress import flight_text

add_commands()
COMMANDS = list(registry.COMMANDS)


def parser_of(command: str) -> CommandParser:
    return build_parser(command)[0].commands[command]


@pytest.mark.parametrize("command", COMMANDS)
def test_help_ends_with_examples_that_the_command_takes(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    parser, chosen = build_parser(command)
    own = parser.commands[command]
    assert type(own) is CommandParser
    assert own.prog.split()[-1] == command
    assert not parser.allow_abbrev
    assert not own.allow_abbrev
    assert chosen.examples
    for words, text in chosen.examples:
        given = shlex.split(words.partition(" >")[0])
        parser.parse_args([command, *given])
        with pytest.raises(SystemExit):
            parser.parse_args([command, "--help"])
        shown = capsys.readouterr().out
        assert f"tools/dtsa {command} {words}".rstrip() + f"\n      {text}\n" in shown


@pytest.mark.parametrize(("words", "meant"), [
    (["simulate", "--agnets", "3"], "option --agnets: unknown; did you mean --agents?"),
    (["simulate", "--polic", "tdma"], "option --polic: unknown; did you mean --policy?"),
    (["simulate", "--sed=3"], "option --sed=3: unknown; did you mean --seed?"),
    (["simulate", "--policy", "dsta"], "; did you mean dtsa?"),
    (["simulate", "--scenario", "way-points"], "did you mean waypoints?"),
    (["fly", "--ot", "a"], "option --ot: unknown; did you mean --out?"),
    (["bridge", "--config", "a", "--backend", "cflb"], "did you mean cflib?"),
    (["sweep", "--preset", "papr-12"], "did you mean paper-12?"), (["simulat"], "did you mean simulate?"),
    (["simulate", "surplus"], "argument surplus: unknown"),
])  # fmt: skip
def test_the_nearest_word_is_named(words: list[str], meant: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert meant in refused(words, capsys)


@pytest.mark.parametrize("words", [["simulate", "--xyzzy", "3"], ["simulate", "--agents", "many"], ["quux"]])
def test_nothing_is_guessed_where_nothing_is_near(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert "did you mean" not in refused(words, capsys)


def test_the_tool_names_the_nearest_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert checkout.main(["flyy"]) == 2
    assert "did you mean fly?" in capsys.readouterr().err


@pytest.mark.parametrize(("line", "wanted"), [
    ("dtsa ex", {"export"}), ("dtsa se", {"setup"}), ("dtsa fly --poli", {"--policy"}), ("dtsa fly --policy ls", set()),
    ("dtsa fly --policy l", {"lease"}), ("dtsa bridge --backend ", {"cflib", "sim"}), ("dtsa completion z", {"zsh"}),
])  # fmt: skip
def test_bash_completes(line: str, wanted: set[str], completions: Path) -> None:
    words = line.split(" ")
    test = (
        f". {completions}; COMP_WORDS=({' '.join(map(shlex.quote, words))}); COMP_CWORD={len(words) - 1}; "
        '_shtab_dtsa dtsa "${COMP_WORDS[COMP_CWORD]}"; printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(["bash", "-c", test], capture_output=True, text=True, check=True)
    assert not done.stderr
    assert set(done.stdout.split()) == wanted


@pytest.fixture(scope="module")
def completions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "dtsa.bash"
    with path.open("w", encoding="utf-8") as stream, redirect_stdout(stream):
        assert cli.main(["completion", "bash"]) == 0
    return path


def test_progress_says_nothing_of_a_distance_that_was_not_measured() -> None:
    """Before the first slot is over there is no pair, however many agents there are."""
    assert "closest" not in flight_text(0, 0.0, 0.1, 0.0, (0, 0))
    assert "alone" not in flight_text(0, 0.0, 0.1, 0.0, (0, 0))
    assert flight_text(3, 0.03, 0.1, 0.5, (1, 4)).endswith("closest cf1 cf4 0.500 m")


@pytest.mark.parametrize("command", ["fly", "simulate"])
def test_auth_without_a_key_leaves_nothing_behind(command, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("DTSA_AUTH_KEY", raising=False)
    assert "DTSA_AUTH_KEY" in refused([command, "--auth", "--agents", "3", "--out", str(tmp_path / "a")], capsys)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["agent", "--id", "1"], ["sniff"], ["view", "--air", "udp"]])
@pytest.mark.parametrize("session", [[], ["--auth-session", "0"]])
def test_sealed_frames_on_a_network_need_a_session(words, session, capsys, monkeypatch):
    """Else an old flight with the same key could be played again, and be believed."""
    monkeypatch.setenv("DTSA_AUTH_KEY", "7c1f0a93e4d25b6880b13f96c2de470a")
    assert "auth_session: got 0; allowed: 1 to" in refused([*words, "--interface", "lo", *session], capsys)


def test_completion_knows_every_command_and_option_and_results_are_printed_as_json(capsys):
    for command in ("demo", "fly", "simulate", "sweep", "verify", "recover", "export"):
        parser = parser_of(command)
        assert any("--json" in action.option_strings for action in parser._actions), command
    assert cli.main(["completion", "zsh"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("#compdef dtsa")
    assert set(CHECKOUT_COMMANDS) == set(checkout.COMMANDS)
    assert all(f"    {command}:'" in text for command in (*COMMANDS, *CHECKOUT_COMMANDS))
    for command in COMMANDS:
        options = {o for action in parser_of(command)._actions for o in action.option_strings if o.startswith("--")}
        assert all(option in text for option in options), command


def test_simulate_draws_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = ["simulate", "--agents", "4", "--timeout-s", "3", "--json"]
    picture = tmp_path / "flight.png"
    assert cli.main([*plain, "--picture", str(picture)]) == 0
    drawn = json.loads(capsys.readouterr().out)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert cli.main(plain) == 0
    without = json.loads(capsys.readouterr().out)
    times = {"wall_time_s": 0, "realtime_factor": 0}
    assert {**drawn, **times} == {**without, **times}
    for wrong in ("flight.svg", "missing/flight.png"):
        assert refused([*plain, "--picture", str(tmp_path / wrong)], capsys).startswith("dtsa: error: picture: got")
