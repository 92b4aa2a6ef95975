"""Processes that this one has started."""

from __future__ import annotations

import signal
import subprocess


def end_process(
    process: subprocess.Popen[str] | subprocess.Popen[bytes],
    patience_s: float,
    ask: signal.Signals = signal.SIGINT,
) -> bool:
    """Asks a process to end, as Ctrl-C does if nothing else is wanted, and kills it if it does not.

    :param process: the process; may have ended already.
    :param patience_s: s.
    :param ask: the signal.
    :returns: whether it has ended by itself.
    """
    if process.poll() is None:
        process.send_signal(ask)
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return False
    return True
