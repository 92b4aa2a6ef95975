"""Name of the command line, and the end of processes that it has started."""

from __future__ import annotations

import os
import signal
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import subprocess


def program() -> str:
    """Return the words in front of a command that a message names: `tools/dtsa` in a checkout, else `dtsa`."""
    return os.environ.get("DTSA_PROGRAM", "dtsa")


def end_process(
    process: subprocess.Popen[str] | subprocess.Popen[bytes], patience_s: float, ask: signal.Signals = signal.SIGINT
) -> bool:
    """Ask a process to end and kill it if it does not in time; return whether it has ended by itself."""
    from subprocess import TimeoutExpired  # milliseconds of each command's start

    if process.poll() is None:
        process.send_signal(ask)
    try:
        process.wait(patience_s)
    except TimeoutExpired:
        process.kill()
        process.wait()
        return False
    return True
