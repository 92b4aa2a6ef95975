"""Processes of this machine, as others name them in messages: alive, or gone for good."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path


@dataclass(frozen=True, slots=True)
class ProcessName:
    """A process that can be looked for on its machine."""

    node: str  # with the namespace
    machine: str  # its boot and its process namespace
    pid: int
    started: int  # clock ticks after the boot

    @classmethod
    def own(cls, node: str) -> ProcessName:
        """This process.

        :param node: its node's name, with the namespace.
        """
        return cls(node, _machine(), os.getpid(), _started(os.getpid()))

    def __str__(self) -> str:
        return f"{self.node} (process {self.pid})"

    @property
    def gone(self) -> bool:
        """Whether the process has ended for sure. A stopped one has not; of other machines nothing is known."""
        return self._of_here and _started(self.pid) != self.started

    @property
    def paused(self) -> bool:
        """Whether the process is there but stopped, by a signal or a debugger; of other machines nothing is known."""
        fields = _fields(self.pid) if self._of_here else []
        return bool(fields) and fields[0] in (b"T", b"t") and int(fields[19]) == self.started

    @property
    def _of_here(self) -> bool:
        return bool(self.started) and self.machine == _machine() and self.pid > 0


@cache
def _machine() -> str:
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {os.readlink('/proc/self/ns/pid')}"
    except OSError:  # another kernel
        return ""


def _started(pid: int) -> int:
    """When a process started, in clock ticks after the boot; 0: there is none, or it is a zombie."""
    fields = _fields(pid)
    return int(fields[19]) if fields and fields[0] not in (b"Z", b"X") else 0


def _fields(pid: int) -> list[bytes]:
    """What the kernel says about a process, from its state on; nothing if there is none."""
    try:
        return Path(f"/proc/{pid}/stat").read_bytes().rpartition(b")")[2].split()
    except OSError:
        return []
