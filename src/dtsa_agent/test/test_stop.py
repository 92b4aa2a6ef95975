"""Signals: a flag for loops, an exception for what looks at no flag."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from dtsa_agent.stop import Stop


def _signalled(stop: Stop) -> None:
    with stop.interruptible():
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)


def test_a_signal_ends_what_looks_at_no_flag_and_is_a_flag_elsewhere() -> None:
    with Stop() as stop:
        begun = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            _signalled(stop)
        assert time.monotonic() - begun < 5
        assert stop.signal == signal.SIGINT
        os.kill(os.getpid(), signal.SIGTERM)  # a flag again
        assert stop.count == 2
        with pytest.raises(KeyboardInterrupt):  # there was a signal before
            _signalled(stop)
        assert stop.count == 2


@pytest.mark.parametrize("before", [signal.SIG_IGN, signal.SIG_DFL])
def test_a_hang_up_that_is_ignored_stays_ignored(before: signal.Handlers) -> None:
    usual = signal.signal(signal.SIGHUP, before)
    try:
        with Stop() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert bool(stop) is (before == signal.SIG_DFL)
        assert signal.getsignal(signal.SIGHUP) == before
    finally:
        signal.signal(signal.SIGHUP, usual)


@pytest.mark.parametrize(("program", "code", "said"), [
    ("with Stop(0.3) as stop:\n    interrupt()\n    stands_still(60)", 1, "in stands_still"),
    ("with Stop(0.3) as stop:\n    interrupt()\ntime.sleep(0.6)", 0, ""),
    # With the interpreter's lock: nobody sees a signal then, and no other thread runs.
    ("with Stop(0.3) as stop, stop.in_time():\n    holds_the_lock(50)", 1, "in holds_the_lock"),
    ("with Stop(30) as stop, stop.in_time():\n    holds_the_lock(0.1)", 0, ""),
    ("with Stop(0.0) as stop, stop.in_time():\n    holds_the_lock(0.5)", 0, ""),
])  # fmt: skip
def test_what_does_not_end_or_stands_still_says_where_and_is_ended(program: str, code: int, said: str) -> None:
    head = (
        "import ctypes, os, signal, time\nfrom dtsa_agent.stop import Stop\n"
        "def interrupt():\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "def stands_still(seconds):\n    time.sleep(seconds)\n"
        "def holds_the_lock(seconds):\n    ctypes.PyDLL(None).usleep(int(1e6 * seconds))\n"
    )
    words = [sys.executable, "-c", head + program]
    done = subprocess.run(words, capture_output=True, text=True, timeout=50, check=False)
    assert done.returncode == code
    assert said in done.stderr
    assert bool(done.stderr) == bool(said)
