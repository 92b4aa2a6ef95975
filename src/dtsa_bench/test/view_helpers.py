"""Pages of the live view in tests: recorded flights as the ROS graph would tell them, and flights with a page."""

from __future__ import annotations

import base64
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from bag_helpers import flight_bag

from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.record import SLOT_RECORD
from dtsa_bench.pages.view.follower import Follower
from dtsa_bench.pages.view.history import RunHistory

SLOTS, AGENTS = 150, 6
PATIENCE_S = 60.0


def lossy_bag(directory: Path) -> Path:
    bag = directory / "lossy" / "bag"
    flight_bag(bag, slots=SLOTS, loss=0.2, agents=AGENTS, moving=5, policy="tdma", seed=2)
    return bag


def history_of(
    bag: Path, more: Callable[[Any], Sequence[tuple[str, Any]]] = lambda record: (), refused: bool = True
) -> RunHistory:
    """All of a lockstep bag, as a page gets it from the ROS graph while it is flown.

    :param more: messages, and their kinds, that come before a slot's record.
    :param refused: whether they are.
    """
    history = RunHistory("lossy")
    follower, count = Follower(history, {}), 0
    with Bag(bag) as opened:
        follower.start(opened.config)
        for _, record in opened.typed([SLOT_RECORD]):
            if not len(record.chosen):  # where all are at the end
                continue
            messages = more(record)
            count += refused * len(messages)
            for kind, message in (*messages, ("SlotRecord", record)):
                follower.receive(kind, message)
    follower.finish("recorded")
    assert follower.unusable == count
    return history


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


@contextmanager
def viewed_flight(out: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    command = [sys.executable, "-m", "dtsa_bench", "fly", "--out", str(out), "--view", *words]
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, stdin=subprocess.DEVNULL, text=True
    )
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


@contextmanager
def on_graph(history: RunHistory, domain: int) -> Iterator[Any]:
    from dtsa_bench.pages.view.graph import GraphSource  # needs ROS

    source = GraphSource(history, domain, control=True)
    listening = threading.Thread(target=source.run, daemon=True)
    listening.start()
    try:
        yield source
    finally:
        source.stopped = True
        listening.join(PATIENCE_S)
