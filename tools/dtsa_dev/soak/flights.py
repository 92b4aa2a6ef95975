"""A flight of `dtsa fly` as a process of its own, and what it has started: for soaks, which kill and stop them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .item import NotMet

PATIENCE_S = 180.0  # s of wall time that anything may take
_BEGUN_BYTES = 6_000  # of the bag: some slots have been recorded
ENDLESS = ("--tail-s", "3600", "--no-picture")  # of simulated time, long enough to be disturbed


def command(*words: str) -> list[str]:
    """Words that run a command of `dtsa` in this environment."""
    return [sys.executable, "-m", "dtsa_bench", *words]


def dtsa(*words: str, patience_s: float = PATIENCE_S) -> subprocess.CompletedProcess[str]:
    """Runs a command of `dtsa` to its end; whatever ends this, none of its processes is left.

    :param words: the command and its options.
    :param patience_s: s, after which it counts as hung.
    :raises NotMet: if it does not end.
    """
    process = subprocess.Popen(command(*words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        said, errors = process.communicate(timeout=patience_s)
    except subprocess.TimeoutExpired:
        raise NotMet(f"`dtsa {' '.join(words[:1])}` did not end within {patience_s:g} s") from None
    finally:
        end_all(process)
    return subprocess.CompletedProcess(process.args, process.returncode, said, errors)


def until(condition: Callable[[], object], what: str, patience_s: float = PATIENCE_S) -> None:
    """Waits for something.

    :param condition: what is waited for.
    :param what: the same in words.
    :param patience_s: s, how long.
    :raises NotMet: if it does not happen.
    """
    deadline = time.monotonic() + patience_s
    while not condition():
        if time.monotonic() > deadline:
            raise NotMet(f"{what}: not within {patience_s:g} s")
        time.sleep(0.02)


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and is not waited for does not."""
    try:
        return b") Z " not in Path(f"/proc/{pid}/stat").read_bytes()
    except OSError:
        return False


def children(supervisor: int) -> list[int]:
    """Processes that a flight has started and that are still there, whoever their parent is by now."""
    mark = f"DTSA_SUPERVISOR={supervisor}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                if mark in (entry / "environ").read_bytes().split(b"\0") and alive(int(entry.name)):
                    found.append(int(entry.name))
    return sorted(found)


def process_with(supervisor: int, argument: str) -> int:
    """The process of a flight that was started with an argument.

    :param supervisor: process of `dtsa fly`.
    :param argument: the whole word.
    :raises NotMet: there is none.
    """
    for pid in children(supervisor):
        with contextlib.suppress(OSError):
            if argument.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                return pid
    raise NotMet(f"no process of the flight was started with {argument}")


def end_all(process: subprocess.Popen[Any]) -> None:
    """Kills a flight and all that it has started.

    :param process: that of `dtsa fly`.
    """
    left = children(process.pid)
    if process.poll() is None:
        process.kill()
    process.wait()
    for pid in {*left, *children(process.pid)}:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    if not all(pipe is None or pipe.closed for pipe in (process.stdout, process.stderr)):
        process.communicate()  # the pipes end with the last of them


@dataclass(slots=True)
class Running:
    """A flight under way."""

    out: Path
    process: subprocess.Popen[bytes]
    domain: int = 0  # ROS domain; 0: its own choice
    known: list[int] = field(default_factory=list)  # its node processes when it had begun

    @property
    def bag(self) -> Path:
        """The file that is being recorded."""
        return self.out / "bag" / "bag_0.mcap"

    def bag_bytes(self) -> int:
        """Size of the file that is being recorded; 0: not there yet."""
        with contextlib.suppress(OSError):
            return self.bag.stat().st_size
        return 0

    def said(self) -> str:
        """Everything on standard error until now."""
        return (self.out.parent / "said.txt").read_text(errors="replace")

    def pid_of(self, agent: int) -> int:
        """Process of one agent, in flights with a process each."""
        return process_with(self.process.pid, f"__ns:=/cf{agent}")

    def environment(self, pid: int) -> dict[str, str]:
        """Environment variables of a process of the flight."""
        words = Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
        return dict(word.split("=", 1) for word in words if "=" in word)

    def end(self, patience_s: float = PATIENCE_S) -> int:
        """Waits for the flight to end by itself; its exit code.

        :param patience_s: s, how long.
        :raises NotMet: if it does not, or stood still after a signal.
        """
        try:
            code = self.process.wait(patience_s)
        except subprocess.TimeoutExpired:
            raise NotMet(f"the flight did not end within {patience_s:g} s") from None
        _, stood, where = self.said().partition("Timeout (")
        if stood:
            raise NotMet(f"the flight stood still after a signal: {where[-1500:]}")
        return code

    def nobody_left(self) -> None:
        """Waits until no process of the flight is left.

        :raises NotMet: if one stays.
        """
        until(lambda: not children(self.process.pid), "all processes of the flight end", 20.0)


@contextmanager
def flying(directory: Path, *words: str, begun: bool = True, files_bytes: int = 0) -> Iterator[Running]:
    """A flight; whatever happens to it, no process of it is left afterwards.

    :param directory: where its directory `out` and what it says are put.
    :param words: options of `dtsa fly`.
    :param begun: wait until some slots are in its bag.
    :param files_bytes: largest size of a file that it can write; 0: any.
    """
    directory.mkdir(parents=True, exist_ok=True)

    def limit() -> None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (files_bytes, files_bytes))

    with (directory / "said.txt").open("wb") as said:
        process = subprocess.Popen(
            command("fly", "--out", str(directory / "out"), *words),
            stdout=subprocess.DEVNULL,
            stderr=said,
            preexec_fn=limit if files_bytes else None,
        )
    flight = Running(directory / "out", process)
    try:
        if begun:
            until(lambda: process.poll() is not None or flight.bag_bytes() > _BEGUN_BYTES, "the flight begins")
            if process.poll() is not None:
                raise NotMet(f"the flight ended before it had begun: {flight.said().strip()[-300:]}")
            flight.known = children(process.pid)
        yield flight
    finally:
        end_all(process)
