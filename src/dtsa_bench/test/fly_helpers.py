"""`dtsa fly` as a process, and the processes that it starts."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dtsa_dev.soak.flights import end_all, process_with
from waiting import wait_for

from dtsa_agent.ros.common.wire.packing import split_frames
from dtsa_bench.recordings.bag.reader import Bag
from dtsa_bench.recordings.verify import verify_bag

PATIENCE_S = 120.0


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "dtsa_bench", "fly", *words]


def fly(out: Path, *words: str) -> dict[str, Any]:
    """A whole flight; its summary."""
    done = subprocess.run(
        command("--out", str(out), *words), capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads((out / "summary.json").read_text())


def frames(out: Path) -> list[tuple[int, int, bytes]]:
    """(slot, sender, frame) of all frames that the nodes of a flight sent, in order."""
    sent = []
    with Bag(out / "bag") as bag:
        for _, message in bag.typed(["/swarm/transmission"]):
            pieces = split_frames(message.data, message.length)
            sent += [(int(message.slot), int(a), f) for a, f in zip(message.agent, pieces, strict=True) if f]
    return sorted(sent)


@contextmanager
def flying(out: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """A flight that has begun, in the state in which the test leaves it."""
    process = subprocess.Popen(
        command("--out", str(out), *words), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
    )
    bag = out / "bag" / "bag_0.mcap"
    try:
        wait_for(lambda: process.poll() is not None or (bag.exists() and bag.stat().st_size > 20_000))
        yield process
    finally:
        end_all(process)


def pid_of(supervisor: int, agent: int) -> int:
    """Process of one agent."""
    return process_with(supervisor, f"__ns:=/cf{agent}")


def readable(out: Path) -> int:
    """Slots in a bag that is finished and says nothing but what the protocol gives."""
    assert (out / "bag" / "metadata.yaml").is_file()
    result = verify_bag(out / "bag")
    assert result.ok, result.difference
    return result.slots
