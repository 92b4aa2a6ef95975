"""Runs the programs of a release one after the other: a line of progress, a log, and an end by Ctrl-C."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from machine import progress, wheels

_FOREIGN = ("AMENT_", "ROS_", "RMW_", "COLCON_", "CMAKE_", "DTSA_", "LD_LIBRARY_PATH", "VIRTUAL_ENV")
LIMIT_S = 1800.0  # for one program; the longest fetches a hundred megabytes
PATIENCE_S = 10.0  # for a program to end after SIGINT
POLL_S = 0.1


def clean_environment() -> dict[str, str]:
    """Environment without a ROS, a workspace or packages of another Python."""
    return {key: value for key, value in wheels.clean_environment().items() if not key.startswith(_FOREIGN)}


@dataclass(frozen=True)
class Done:
    """A program that has ended."""

    words: tuple[str, ...]
    code: int
    stdout: str
    stderr: str
    seconds: float

    def reason(self) -> str:
        """The last line that it said, for a message."""
        lines = [line for line in (self.stderr.strip() or self.stdout.strip()).splitlines() if line.strip()]
        return f"exit code {self.code}: {lines[-1][:200] if lines else 'no output'}"


class Runner:
    """Runs programs; everything that they say goes into a log.

    :param log: the log, open for writing.
    """

    def __init__(self, log: IO[str]) -> None:
        self._log = log
        self._live = sys.stderr.isatty()
        self._title = ""
        self._begun = time.monotonic()

    def say(self, title: str) -> None:
        """Tells what is done from now on.

        :param title: in a few words.
        """
        self._title, self._begun = title, time.monotonic()
        self._log.write(f"\n== {title}\n")
        self._show("\n" if not self._live else "")

    def _show(self, end: str) -> None:
        if self._live:
            elapsed = time.monotonic() - self._begun
            print(f"\r\033[Kdtsa: {self._title} ... {elapsed:.0f} s"[:120], end=end, file=sys.stderr, flush=True)
        else:
            print(f"dtsa: {self._title} ...", end=end, file=sys.stderr, flush=True)

    def run(
        self,
        words: Sequence[str | Path],
        directory: Path,
        environment: Mapping[str, str] | None = None,
        limit_s: float = LIMIT_S,
        until: str = "",
        then: Callable[[str], None] | None = None,
    ) -> Done:
        """Runs one program.

        :param words: the program and its arguments.
        :param directory: where it runs.
        :param environment: what it finds there; None: that of :func:`clean_environment`.
        :param limit_s: it is ended after so many seconds.
        :param until: it is ended by SIGINT as soon as it has printed this to its standard output,
        :param then: which is given what it has printed before that.
        :raises KeyboardInterrupt: when this process is to end.
        """
        return self.run_together([words], directory, environment, limit_s, until, then)[0]

    def run_together(
        self,
        commands: Sequence[Sequence[str | Path]],
        directory: Path,
        environment: Mapping[str, str] | None = None,
        limit_s: float = LIMIT_S,
        until: str = "",
        then: Callable[[str], None] | None = None,
    ) -> list[Done]:
        """Runs programs at the same time; see :meth:`run`."""
        begun = time.monotonic()
        given = dict(clean_environment() if environment is None else environment)
        with tempfile.TemporaryDirectory() as kept, progress.noted_signals() as signals:
            running = [
                _Running(words, directory, given, Path(kept, str(number))) for number, words in enumerate(commands)
            ]
            try:
                while any(each.running() for each in running) and not signals:
                    time.sleep(POLL_S)
                    for each in running:
                        if until and not each.interrupted_at and until in each.said():
                            if then is not None:
                                then(each.said())
                            each.interrupt()
                        if time.monotonic() - begun > limit_s or each.interrupted_at:
                            each.interrupt()
                    if self._live:
                        self._show("")
            finally:
                for each in running:
                    progress.stop(each.process)
            done = [each.done() for each in running]
        for each in done:
            self._log.write(
                f"$ {shlex.join(each.words)}\n{each.stdout}{each.stderr}[{each.code}, {each.seconds:.1f} s]\n"
            )
        self._log.flush()
        if signals:
            raise KeyboardInterrupt
        return done

    def end(self) -> None:
        """Leaves the line of progress."""
        if self._live:
            print("\r\033[K", end="", file=sys.stderr, flush=True)


class _Running:
    """A program under way, its output in files."""

    def __init__(self, words: Sequence[str | Path], directory: Path, environment: dict[str, str], place: Path) -> None:
        self.words = tuple(str(word) for word in words)
        self._out, self._err = place.with_suffix(".out"), place.with_suffix(".err")
        self._begun, self._ended = time.monotonic(), 0.0
        self.interrupted_at = 0.0  # s, monotonic; 0: not yet
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self.process = subprocess.Popen(
                self.words,
                cwd=directory,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )

    def running(self) -> bool:
        """Whether it runs; notes when it has ended."""
        over = self.process.poll() is not None
        if over and not self._ended:
            self._ended = time.monotonic()
        return not over

    def said(self) -> str:
        """What it has printed so far."""
        return self._out.read_text(encoding="utf-8", errors="replace")

    def interrupt(self) -> None:
        """Ends it as Ctrl-C does; kills it when it takes no notice."""
        first = not self.interrupted_at
        if first:
            self.interrupted_at = time.monotonic()
        if first or time.monotonic() - self.interrupted_at > PATIENCE_S:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGINT if first else signal.SIGKILL)

    def done(self) -> Done:
        """What came of it."""
        error = self._err.read_text(encoding="utf-8", errors="replace")
        seconds = (self._ended or time.monotonic()) - self._begun
        return Done(self.words, self.process.returncode, self.said(), error, seconds)
