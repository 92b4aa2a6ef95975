"""Integration: verify finds a byte that was changed in a bag, wherever it stands."""

from __future__ import annotations

import random
from collections import Counter
from pathlib import Path
from typing import Any

import air_helpers as helpers
import pytest
from fly_helpers import fly
from mcap.opcode import Opcode

from dtsa_agent.air.settings import UdpSettings
from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import DtsaError
from dtsa_bench.log.bag.file import MAGIC, PREFIX
from dtsa_bench.log.bag.recover import recover
from dtsa_bench.log.verify.check import verify_bag

pytestmark = [pytest.mark.ros, pytest.mark.soak]
KEY = "7c1f0a93e4d25b6880b13f96c2de470a"
KINDS = ("lockstep", "realtime", "udp", "merged", "recovered", "sealed")
POLICIES = ("lease", "tdma", "aloha", "age")  # of flights of nodes
SEEDS = [pytest.param(seed, marks=[pytest.mark.sample] * (seed == 1)) for seed in range(1, 11)]
CHANGES = 5  # of each bag, one byte at a time
_CHUNK_HEAD = 40  # bytes of a chunk before the name of its compression


def _fly(out: Path, seed: int, *words: str, policies: tuple[str, ...] = POLICIES) -> list[Path]:
    more = ("--policy", policies[seed % len(policies)], "--loss", f"{seed % 3 / 10}", "--agents", str(3 + seed % 3))
    fly(out, *more, "--processes", "2", "--timeout-s", "1", "--seed", str(seed), "--no-picture", *words)
    return sorted((out / "bag").glob("*.mcap"))


def _fly_on_network(directory: Path, seed: int) -> list[Path]:
    helpers.need_multicast()
    directory.mkdir()
    config = SwarmConfig(agents=3, policy=("lease", "tdma")[seed % 2], slot_ms=20.0, seed=seed)
    port = UdpSettings(interface="lo", group=helpers.own_group())
    with helpers.flying(config, [port] * 3, directory) as agents:
        helpers.hear_each_other(agents, 5)
        helpers.go_on(agents, 30)
    return sorted(directory.glob("*.mcap"))


def make_bag(kind: str, directory: Path, seed: int) -> tuple[Path, list[Path]]:
    """A recorded flight, as `verify` takes it, and its files."""
    out = directory / "flight"
    if kind == "udp":
        return out, _fly_on_network(out, seed)
    if kind == "merged":
        helpers.merge_bags(_fly_on_network(directory / "agents", seed), out)
        return out, sorted((out / "bag").glob("*.mcap"))
    realtime = (
        ("--mode", "realtime", "--slot-ms", "20") if kind == "realtime" or (kind, seed % 2) == ("recovered", 1) else ()
    )
    files = _fly(out, seed, *realtime, *(["--auth"] if kind == "sealed" else []))
    if kind == "recovered":
        data = files[0].read_bytes()
        files[0].write_bytes(data[: len(data) * 3 // 4])
        out = recover(out, directory / "saved").directory
        files = sorted(out.glob("*.mcap"))
    return out, files


def name_of(data: bytes | bytearray, place: int) -> str:
    """The part of an MCAP file in which a byte stands."""
    position = len(MAGIC)
    while position < len(data) - len(MAGIC):
        opcode, length = PREFIX.unpack_from(data, position)
        if position <= place < position + PREFIX.size + length:
            part = "records" if opcode == Opcode.CHUNK and place >= position + PREFIX.size + _CHUNK_HEAD else "head"
            return f"{Opcode(opcode).name.lower()}, {part if opcode == Opcode.CHUNK else 'record'}"
        position += PREFIX.size + length
    return "magic"


def is_found(path: Path) -> bool:
    try:
        return not verify_bag(path).ok
    except DtsaError:
        return True


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_changed_byte(kind: str, seed: int, tmp_path: Path, monkeypatch: Any, record: list[dict[str, Any]]) -> None:
    pytest.importorskip("dtsa_msgs.msg")
    monkeypatch.setenv("DTSA_AUTH_KEY", KEY)
    path, files = make_bag(kind, tmp_path, seed)
    result, pick = verify_bag(path), random.Random(f"{kind} {seed}")
    assert result.ok, result.difference
    file = pick.choice(files)
    data, names = bytearray(file.read_bytes()), []
    for _ in range(CHANGES):
        place, bit = pick.randrange(len(data)), 1 << pick.randrange(8)
        data[place] ^= bit
        file.write_bytes(data)
        found, data[place] = is_found(path), data[place] ^ bit
        names.append(name_of(data, place))
        assert found, f"byte {place} of {len(data)}: {names[-1]}"
    record.append({"kind": kind, "names": names})


def summarise(found: list[dict[str, Any]]) -> tuple[list[str], list[list[object]]]:
    rows: list[list[object]] = []
    for kind in KINDS:
        names = Counter(name for row in found if row["kind"] == kind for name in row["names"])
        rows.append([kind, names.total(), ", ".join(f"{count} {name}" for name, count in sorted(names.items()))])
    return ["bag", "changes, all found", "where they were"], rows
