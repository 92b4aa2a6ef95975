"""Processes that this one has started."""

from __future__ import annotations

import signal
import subprocess


def end_process(process: subprocess.Popen[str] | subprocess.Popen[bytes], patience_s: float) -> bool:
    """Asks a process to end as Ctrl-C does, and kills it if it does not.

    :param process: the process; may have ended already.
    :param patience_s: s.
    :returns: whether it has ended by itself.
    """
    if process.poll() is None:
        process.send_signal(signal.SIGINT)
    try:
        process.wait(patience_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return False
    return True
