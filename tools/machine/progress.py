"""Runs the commands of a step: elapsed time while it runs, everything else into a log file."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from machine import layout, processes
from machine.layout import SetupError

REASON = re.compile(r"(?i)\b(error|fatal|failed|no space left|could not|cannot|no matching distribution)\b")
OFFLINE = re.compile(r"NewConnectionError|NameResolutionError|ConnectTimeoutError|ProxyError")
UNREACHABLE = "the package index cannot be reached, and a package is not in pip's cache: "
NOISE = re.compile(r"(?i)^\s*(warning|note|\[notice\])|A new release of pip|Failed\s+<<<")


class Step:
    """One step of the set-up, with its log file and its line on the terminal.

    :param name: short name; also the log file's.
    :param title: what the user reads.
    """

    def __init__(self, name: str, title: str) -> None:
        self.name = name
        self.title = title
        self.log = layout.STEP_LOGS / f"{name}.log"
        self.began = time.monotonic()
        self.note = ""
        self.live = sys.stderr.isatty()

    def elapsed(self) -> str:
        return f"{time.monotonic() - self.began:.0f} s"

    def show(self, end: str = "") -> None:
        """Write the line of this step: over and over on a terminal, once at the end elsewhere."""
        text = f"dtsa: {self.title} {self.note}".rstrip()
        if self.live:
            width = os.get_terminal_size(sys.stderr.fileno()).columns if sys.stderr.isatty() else 80
            line = f"{text} ... {self.elapsed()}"[: max(width - 1, 20)]
            print(f"\r\033[K{line}", end="\n" if end else "", file=sys.stderr, flush=True)
        elif end:
            print(f"{text} ... {end}, {self.elapsed()}", file=sys.stderr, flush=True)

    def run(self, command: Sequence[str | Path], environment: Mapping[str, str]) -> None:
        """Run one command; its output goes to the log.

        :raises SetupError: naming the step, the reason and the log, when it fails.
        """
        with self.log.open("ab") as log, noted_signals() as signals:
            log.write(f"$ {' '.join(str(word) for word in command)}\n".encode())
            log.flush()
            start = log.tell()
            process = subprocess.Popen(
                [str(word) for word in command],
                env={**environment, **processes.mark()},
                cwd=layout.ROOT,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                while process.poll() is None and not signals:
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(timeout=0.2)
                    self.show()
            finally:
                stop(process)
        if signals:
            raise KeyboardInterrupt
        if process.returncode != 0:
            raise SetupError(f"{reason(self.log, start)}")


@contextmanager
def noted_signals() -> Iterator[list[int]]:
    """Notes SIGINT and SIGTERM in a list until the end of the context.

    An exception raised by a signal while a command is being started, or ended, would leave it running.
    """
    noted: list[int] = []
    handlers = {
        number: signal.signal(number, lambda number, frame: noted.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield noted
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a command and everything that it started, when the user interrupts.

    The command itself may clean up; what it started and left behind is killed: a shell's background
    jobs ignore SIGINT.
    """
    if process.poll() is not None:
        return
    for number in (signal.SIGINT, signal.SIGTERM):
        os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=3)
            break
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def reason(log: Path, start: int = 0) -> str:
    """The line of a log that most likely says why a command failed."""
    text = log.read_bytes()[start:].decode(errors="replace")
    lines = [line.strip() for line in text.splitlines() if line.strip() and not NOISE.search(line)]
    hint = UNREACHABLE if OFFLINE.search(text) else ""
    for number, line in enumerate(lines):
        if REASON.search(line):
            return hint + " ".join(lines[number : number + 3] if line.endswith(":") else [line])[:300]
    return lines[-1][:300] if lines else "no output"


@contextmanager
def step(name: str, title: str) -> Iterator[Step]:
    """Run a step: shows its line, and says which step failed, why, and where its log is."""
    layout.STEP_LOGS.mkdir(parents=True, exist_ok=True)
    current = Step(name, title)
    current.log.write_bytes(b"")
    if not current.live:
        print(f"dtsa: {title} ...", file=sys.stderr, flush=True)
    current.show()
    try:
        yield current
    except SetupError as error:
        current.show("failed")
        log = os.path.relpath(current.log)
        raise SetupError(
            f"set-up failed at step '{name}': {error}; log: {log}; run the same command again to go on from there",
            error.code,
        ) from None
    except OSError as error:
        current.show("failed")
        raise SetupError(f"set-up failed at step '{name}': {error}") from None
    current.show("done")
