"""`dtsa fly` as a process, and the processes that it starts."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from waiting import wait_for

from dtsa_bench.log.bag.recover import recover
from dtsa_bench.log.record import load_log
from dtsa_bench.log.verify.check import verify_bag
from dtsa_bench.log.verify.result import Result

PATIENCE_S = 180.0
ENDLESS = ("--tail-s", "3600", "--no-picture")  # of simulated time, long enough to be disturbed
_BEGUN_BYTES = 12_000  # of a bag: definitions take 10,000, so some slots have been recorded
_GROWTH_BYTES = 2_000


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "dtsa_bench", "fly", *words]


def fly(out: Path, *words: str) -> dict[str, Any]:
    done = subprocess.run(
        command("--out", str(out), *words), capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return summary_of(out)


def frames(out: Path) -> list[tuple[int, int, bytes]]:
    """(slot, sender, frame) of all frames that the nodes of a flight sent, in order."""
    sent = load_log(out).sent_frames
    return list(zip(sent.row.tolist(), sent.sender.tolist(), sent.data, strict=True))


def readable(out: Path) -> int:
    """Slots in a bag that is finished and says nothing but what the protocol gives."""
    assert (out / "bag" / "metadata.yaml").is_file()
    return int(verified(out / "bag").slots)


def verified(bag: Path) -> Result:
    result = verify_bag(bag)
    assert result.ok, result.difference
    return result


def summary_of(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "summary.json").read_text()))


def run_dtsa(*words: str) -> subprocess.CompletedProcess[str]:
    """A command of `dtsa`, run to its end; whatever ends this, none of its processes is left."""
    process = subprocess.Popen(
        [sys.executable, "-m", "dtsa_bench", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        output, errors = process.communicate(timeout=PATIENCE_S)
    finally:
        end_all(process)
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)


def children(supervisor: int) -> list[int]:
    """Processes that a flight has started and that still run, whoever their parent is by now."""
    mark = f"DTSA_SUPERVISOR={supervisor}".encode()
    pids = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                marked = mark in (entry / "environ").read_bytes().split(b"\0")
                if marked and b") Z " not in (entry / "stat").read_bytes():
                    pids.append(int(entry.name))
    return sorted(pids)


def process_with(supervisor: int, argument: str) -> int:
    for pid in children(supervisor):
        with contextlib.suppress(OSError):
            if argument.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                return pid
    raise AssertionError(f"no process of the flight was started with {argument}")


def end_all(process: subprocess.Popen[Any]) -> None:
    left = children(process.pid)
    if process.poll() is None:
        process.kill()
    process.wait()
    for pid in {*left, *children(process.pid)}:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    if not all(pipe is None or pipe.closed for pipe in (process.stdout, process.stderr)):
        process.communicate()  # the pipes end with the last of them


def pid_of(supervisor: int, agent: int) -> int:
    return process_with(supervisor, f"__ns:=/cf{agent}")


@dataclass(slots=True)
class FlightProcess:
    """A flight under way, to be killed, stopped or disturbed, and what is asserted of it."""

    out: Path
    process: subprocess.Popen[bytes]
    nodes: list[int] = field(default_factory=list)  # its node processes when it had begun
    safety: dict[str, Any] = field(default_factory=dict)  # what `verify` counts in its bag

    def bag_bytes(self) -> int:
        with contextlib.suppress(OSError):
            return (self.out / "bag" / "bag_0.mcap").stat().st_size
        return 0

    def stderr(self) -> str:
        return (self.out.parent / "stderr.txt").read_text(errors="replace")

    def pid_of(self, agent: int) -> int:
        return pid_of(self.process.pid, agent)

    def until_says(self, *texts: str) -> None:
        """Wait until a text is on standard error; the flight goes on until then."""
        wait_for(lambda: self.process.poll() is not None or any(text in self.stderr() for text in texts), PATIENCE_S)
        assert any(text in self.stderr() for text in texts), self.stderr()[-1500:]

    def environment(self, pid: int) -> dict[str, str]:
        words = Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
        return dict(word.split("=", 1) for word in words if "=" in word)

    def end(self) -> int:
        """Wait for the flight to end by itself; its exit code."""
        code = self.process.wait(PATIENCE_S)
        assert "Timeout (" not in self.stderr(), f"the flight stood still after a signal: {self.stderr()[-1500:]}"
        return code

    def assert_no_process_left(self) -> None:
        wait_for(lambda: not children(self.process.pid), 20.0, "a process of the flight stays")

    def assert_ends(self, code: int, *messages: str) -> None:
        """The flight ends by itself with a code and messages, without a traceback, and no process stays."""
        found = self.end()
        text = self.stderr()
        assert found == code, text[-300:]
        assert "Traceback" not in text, text[-300:]
        for message in messages:
            assert message in text, text[-300:]
        self.assert_no_process_left()

    def assert_flies_on(self) -> None:
        size = self.bag_bytes()
        wait_for(
            lambda: self.process.poll() is not None or self.bag_bytes() > size + _GROWTH_BYTES, PATIENCE_S, "no growth"
        )
        assert self.process.poll() is None, f"the flight has ended: {self.stderr()[-300:]}"

    def interrupt(self, number: int = signal.SIGINT) -> dict[str, Any]:
        """A signal ends the flight in good order, and its bag verifies; its summary."""
        self.process.send_signal(number)
        self.assert_ends(130, "interrupted")
        self.assert_verifies()
        return summary_of(self.out)

    def assert_verifies(self) -> None:
        """The bag is closed, has slots, and is what the protocol gives."""
        assert (self.out / "bag" / "metadata.yaml").is_file()
        result = verified(self.out / "bag")
        assert result.slots
        self.safety = result.safety

    def assert_recovered_verifies(self) -> None:
        """The bag was not closed; what `recover` makes of it verifies up to where it breaks off."""
        result = verified(recover(self.out / "bag").directory)
        assert result.broken_off
        assert result.slots


@contextmanager
def start_flight(directory: Path, *words: str, begun: bool = True, files_bytes: int = 0) -> Iterator[FlightProcess]:
    """A flight whose bag has slots, and which can write so many bytes a file; nothing of it is left afterwards."""
    directory.mkdir(parents=True, exist_ok=True)

    def limit() -> None:
        import resource

        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (files_bytes, files_bytes))

    out = directory / "out"
    with (directory / "stderr.txt").open("wb") as errors:
        process = subprocess.Popen(
            command("--out", str(out), *words),
            stdout=subprocess.DEVNULL, stderr=errors, preexec_fn=limit if files_bytes else None,
        )  # fmt: skip
    flight = FlightProcess(out, process)
    try:
        if begun:
            wait_for(lambda: process.poll() is not None or flight.bag_bytes() > _BEGUN_BYTES, PATIENCE_S)
            assert process.poll() is None, f"the flight ended before it had begun: {flight.stderr()[-300:]}"
            flight.nodes = children(process.pid)
        yield flight
    finally:
        end_all(process)
