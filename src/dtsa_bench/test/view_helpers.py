"""Pages of the live view in tests: servers, flights with a page, and what moments tell."""

from __future__ import annotations

import base64
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from flight_helpers import flight_bag

from dtsa_bench.pages.view.recording import BagSource
from dtsa_bench.pages.view.track import Track

SLOTS, AGENTS = 150, 6
PATIENCE_S = 60.0


def lossy_bag(directory: Path) -> Path:
    """A flight on a channel that loses frames."""
    bag = directory / "lossy" / "bag"
    flight_bag(bag, slots=SLOTS, loss=0.2, agents=AGENTS, moving=5, policy="tdma", seed=2)
    return bag


def track_of(bag: Path) -> Track:
    """All of a bag, as a page gets it."""
    found = Track("lossy")
    BagSource(bag, found).run()
    return found


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


@contextmanager
def viewed_flight(out: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A flight with a page, and the address of that."""
    command = [sys.executable, "-m", "dtsa_bench", "fly", "--out", str(out), "--view", *words]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL, text=True
    )
    assert process.stderr is not None
    try:
        line = process.stderr.readline()
        assert line.startswith("view: http://127.0.0.1:"), line + process.stderr.read()
        yield process, line.split()[1]
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            raise
