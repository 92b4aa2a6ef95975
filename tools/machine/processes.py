"""Which processes use a directory: what is in use is never removed. What a killed set-up left running is ended."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from machine import layout
from machine.layout import SetupError

MARK = "DTSA_SETUP_OF"  # in the environment of what the steps of a set-up start
ORPHANS_S = 30.0  # for orphans to end after SIGKILL


def mark() -> dict[str, str]:
    """What a step's command has in its environment: the checkout that is set up."""
    return {MARK: str(layout.ROOT)}


def marked() -> list[int]:
    """Processes that the steps of this checkout's set-up have started, whoever their parent is by now."""
    wanted = f"{MARK}={layout.ROOT}".encode()
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if wanted in (entry / "environ").read_bytes().split(b"\0") and int(entry.name) != os.getpid():
                found.append(int(entry.name))
    return found


def end_orphans() -> None:
    """End what a set-up that was killed has left running: it would write into the same directories.

    Only for the process that holds the lock: what is marked then is nobody's.

    :raises SetupError: if it does not end.
    """
    deadline = time.monotonic() + ORPHANS_S
    while found := marked():
        if time.monotonic() > deadline:
            raise SetupError(f"process {found[0]}, left by a set-up that was killed, cannot be ended")
        for process in found:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        time.sleep(0.05)


def users_of(directories: Iterable[Path]) -> list[int]:
    """Processes that run a program from one of these directories, or have loaded a library from it.

    :param directories: absolute paths.
    :returns: their ids, as far as this user may see them. This process and the start of another `tools/dtsa`, which
        uses nothing but the interpreter, do not count.
    """
    beginnings = tuple(f"{directory}{os.sep}" for directory in directories)
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        if int(entry.name) == os.getpid():
            continue
        try:
            words = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
            maps = (entry / "maps").read_text(errors="replace")
        except OSError:
            continue  # it has ended, or is another user's
        loaded = {fields[5] for line in maps.splitlines() if len(fields := line.split(maxsplit=5)) == 6}
        runs = words[0].startswith(beginnings) and words[1:3] != ["-I", "-S"]
        if runs or any(path.startswith(beginnings) for path in loaded):
            found.append(int(entry.name))
    return sorted(found)


def refuse_if_used(directories: Iterable[Path]) -> None:
    """Ask before something is removed.

    :param directories: what is to be removed.
    :raises SetupError: if a process uses it.
    """
    wanted = [directory for directory in directories if directory.exists()]
    users = users_of(wanted)
    if users:
        names = ", ".join(directory.name for directory in wanted)
        shown = ", ".join(map(str, users[:5])) + (", ..." if len(users) > 5 else "")
        raise SetupError(f"{names}: in use by process {shown}; end it first: nothing was removed", code=2)
