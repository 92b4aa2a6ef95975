"""Settings in a file that all computers of a swarm share."""

from __future__ import annotations

import argparse
import threading
import time
from pathlib import Path

import air_helpers as helpers
import pytest
from cli_helpers import refused

from dtsa_agent.air.port import PortSettings
from dtsa_agent.air.settings import AgentSettings
from dtsa_agent.core import ConfigError, SwarmConfig
from dtsa_bench.commands.cli import main
from dtsa_bench.commands.network import read_network_options
from dtsa_bench.commands.registry import load_command
from dtsa_bench.runs.options import option_values

SHARED = """\
air: udp
agents: 12
policy: tdma
slot_ms: 20
auth: false
epsilon: 0.3
group: 239.1.2.3:4567
interface: lo
priority: 0
"""
IN_ROS = "/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in SHARED.splitlines())


def parsed(words: list[str], command: str = "agent") -> tuple[argparse.Namespace, PortSettings, SwarmConfig]:
    """Options as a command sees them, and what they and the file say."""
    parser = argparse.ArgumentParser()
    load_command(command).add_arguments(parser)
    args = parser.parse_args(words)
    return args, *read_network_options(args)


@pytest.mark.parametrize("text", [SHARED, IN_ROS])
def test_settings_of_a_file_stand_for_options_and_options_go_before_them(tmp_path: Path, text: str) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(text)
    args, port, swarm = parsed(["--swarm", str(path), "--slot-ms", "30", "--group", "239.1.2.3:9", "--id", "3"])
    wanted = SwarmConfig(agents=12, policy="tdma", slot_ms=30.0, epsilon=0.3, auth=False)
    assert swarm == wanted
    assert (port.to_dict()["group"], port.to_dict()["interface"]) == ("239.1.2.3:9", "lo")
    assert option_values(args, AgentSettings, "own") == {"id": 3, "priority": 0}
    for command in ("sniff", "view"):
        _, port, swarm = parsed(["--swarm", str(path)], command)
        assert swarm.slot_ms == 20.0
        assert port.to_dict()["group"] == "239.1.2.3:4567"


def test_without_a_file_all_is_as_the_options_say(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DTSA_AUTH_KEY", "8f3c1d5e7a9b2460c1e3f5a7b9d8c6e4")
    args, _, swarm = parsed(["--interface", "lo", "--auth-session", "4"])
    assert args.air == "udp"
    assert swarm == SwarmConfig(policy="lease", auth=True, auth_session=4)


@pytest.mark.parametrize(("line", "field", "allowed"), [
    ("slot_ms: 0", "slot_ms", "ms"), ("slot_ms: fast", "slot_ms", "ms"),
    ("slotms: 5", "slotms", "did you mean slot_ms?"), ("air: carrier pigeon", "air", "udp"),
    ("id: 3", "id", "each has an --id of its own"), ("agents: 5\nagents: 6", "agents", "once"),
])  # fmt: skip
def test_an_error_names_file_and_setting(tmp_path: Path, line: str, field: str, allowed: str) -> None:
    path = tmp_path / "swarm.yaml"
    path.write_text(line)
    with pytest.raises(ConfigError) as error:
        parsed(["--swarm", str(path)])
    assert error.value.field == f"{field} in {path}"
    assert allowed in error.value.allowed


@pytest.mark.parametrize("content", [None, b"\xff\xfe", b"a: [", b"- 1"])
def test_a_file_that_holds_no_settings_is_named(tmp_path, content, capsys):
    path = tmp_path / "swarm.yaml"
    if content is not None:
        path.write_bytes(content)
    assert str(path) in refused(["agent", "--id", "1", "--swarm", str(path)], capsys)


@pytest.mark.parametrize(("command", "bag", "begins"), [
    (["agent", "--id", "1", "--quorum", "0"], "cf1", "state"), (["sniff"], "sniffed", "heard"),
])  # fmt: skip
def test_a_summary_that_cannot_be_written_is_printed_and_the_file_is_named(tmp_path, capsys, command, bag, begins):
    """As on a disk that has become full: here a directory is in its place."""
    helpers.need_multicast()
    out = tmp_path / "cf1"

    def block() -> None:
        while not (out / f"{bag}.mcap").exists():
            time.sleep(0.01)
        (out / "summary.json").mkdir()

    threading.Thread(target=block, daemon=True).start()
    words = ("--no-seal", "--agents", "2", "--interface", "lo", "--group", helpers.own_group())
    assert main([*command, "--duration-s", "1", "--out", str(out), *words]) == 1
    said = capsys.readouterr()
    assert said.out.startswith(begins)
    assert str(out / "summary.json") in said.err.splitlines()[-1]
