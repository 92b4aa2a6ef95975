"""Signals: a flag for loops, an exception for what looks at no flag."""

from __future__ import annotations

import os
import signal
import time

import pytest

from dtsa_agent.ros.common.loop import Stop


def test_a_signal_ends_what_looks_at_no_flag_and_is_a_flag_elsewhere() -> None:
    with Stop() as stop:
        with pytest.raises(KeyboardInterrupt), stop.at_once():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(5)
            pytest.fail("still here")
        assert stop.signal == signal.SIGINT
        os.kill(os.getpid(), signal.SIGTERM)  # a flag again
        assert stop.count == 2
        with pytest.raises(KeyboardInterrupt), stop.at_once():  # there was a signal before
            pytest.fail("begun")
