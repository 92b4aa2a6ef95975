"""What Linux says about a process: its sockets, its shared memory, its priority."""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path


def open_files(pid: int) -> Iterator[str]:
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(FileNotFoundError):
            yield os.readlink(entry)


def addresses(pid: int) -> set[str]:
    """Local addresses of all UDP and TCP sockets of a process."""
    inodes = {target[8:-1] for target in open_files(pid) if target.startswith("socket:[")}
    found = set()
    for table in ("udp", "tcp", "udp6", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[9] in inodes:
                raw = fields[1].split(":")[0]
                found.add(socket.inet_ntoa(struct.pack("<I", int(raw, 16))) if len(raw) == 8 else raw)
    return found


def segments_of(pid: int) -> set[str]:
    """Names of the shared memory segments and ports whose locks a process has open: its own."""
    return {Path(target).name[:-3] for target in open_files(pid) if target.startswith("/dev/shm/fast")}


def real_time(pid: int) -> bool:
    return os.sched_getscheduler(pid) & ~os.SCHED_RESET_ON_FORK == os.SCHED_RR


def may_be_real_time() -> bool:
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
    except OSError:
        return False
    os.sched_setscheduler(0, *before)
    return True
