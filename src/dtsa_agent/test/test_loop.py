"""Signals: a flag for loops, an exception for what looks at no flag."""

from __future__ import annotations

import os
import signal
import time

import pytest

from dtsa_agent.ros.common.loop import Stop


def _signalled(stop: Stop) -> None:
    with stop.at_once():
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
