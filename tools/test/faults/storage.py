"""Disks and files: full, removed, cut, changed, in use; keys that are missing; the machine's clock set in flight."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import patch

from fly_helpers import ENDLESS, FlightProcess, run_dtsa, start_flight
from mcap.reader import make_reader

from .row import LOCKSTEP, REALTIME, fault, in_flight

_FULL_BYTES = 150_000
_SHORT = ("--timeout-s", "1", "--no-picture")

_SAVED = "the flight ends with code 1 and a line that names the file; `recover` saves a bag that verifies"
_REFUSED = "refused with one line and code 2 before anything is started"
_NO_EFFECT = "nothing: only clocks that are never set are used; the flight goes on, the bag verifies"


def _fill_disk(directory: Path, words: tuple[str, ...]) -> None:
    with start_flight(directory, *words, *ENDLESS, files_bytes=_FULL_BYTES) as flight:
        flight.assert_ends(1, "recording to", "recover")
        flight.assert_recovered_verifies()


@fault("the disk is full while a flight in lockstep is recorded", _SAVED, sample=True)
def disk_full(directory: Path) -> None:
    _fill_disk(directory, LOCKSTEP)


@fault("the disk is full while a flight in real time is recorded", _SAVED)
def disk_full_in_real_time(directory: Path) -> None:
    _fill_disk(directory, REALTIME)


@in_flight(
    "the flight's directory is removed while it is under way",
    "the flight ends on SIGINT, without a traceback; no process stays", *LOCKSTEP,
)  # fmt: skip
def directory_removed(flight: FlightProcess) -> None:
    shutil.rmtree(flight.out)
    flight.process.send_signal(2)
    assert flight.end() in (1, 130)
    assert "Traceback" not in flight.stderr(), flight.stderr()[-300:]
    flight.assert_no_process_left()


def _assert_refused(says: str, *words: str) -> None:
    """`fly` ends with code 2 and one line that says why."""
    done = run_dtsa("fly", *words, *LOCKSTEP)
    text = done.stderr.strip()
    assert done.returncode == 2, text[-300:]
    assert says in text
    assert len(text.splitlines()) == 1, text[-300:]


@fault("`--out` names a directory with files in it", f"{_REFUSED}; the files stay")
def directory_in_use(directory: Path) -> None:
    (directory / "out").mkdir()
    (directory / "out" / "mine.txt").write_text("mine")
    _assert_refused("out", "--out", str(directory / "out"))
    assert [path.name for path in (directory / "out").iterdir()] == ["mine.txt"]


@fault("`--out` cannot be made", "one line that says so")
def directory_impossible(directory: Path) -> None:
    (directory / "file").write_text("no directory")
    done = run_dtsa("fly", "--out", str(directory / "file" / "out"), *LOCKSTEP)
    assert done.returncode in (1, 2)
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr[-300:]


def _fly(directory: Path) -> Path:
    done = run_dtsa("fly", "--out", str(directory / "out"), *LOCKSTEP, "--processes", "1", *_SHORT)
    assert done.returncode == 0, done.stderr[-300:]
    return directory / "out" / "bag" / "bag_0.mcap"


@fault(
    "a bag is cut off at three quarters",
    "`verify` refuses it; `recover` saves what verifies up to where it breaks off",
    sample=True,
)
def bag_cut(directory: Path) -> None:
    path = _fly(directory)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 4])
    assert run_dtsa("verify", str(path)).returncode
    assert run_dtsa("recover", str(path.parent)).returncode == 0
    done = run_dtsa("verify", str(path.parent.with_name("bag_recovered")))
    assert done.returncode == 0, done.stdout[-300:]
    assert "where the recording breaks off" in done.stdout


@fault("one bit of a bag is changed", "`verify` finds it")
def bag_changed(directory: Path) -> None:
    path = _fly(directory)
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes  # what stands between them is an index nobody reads
    data[chunks[len(chunks) // 2].chunk_start_offset + 100] ^= 1
    path.write_bytes(data)
    done = run_dtsa("verify", str(path))
    assert done.returncode != 0
    assert "Traceback" not in done.stderr, done.stderr[-300:]


@fault("`--auth` without a key in the environment", _REFUSED, sample=True)
def key_missing(directory: Path) -> None:
    with patch.dict(os.environ):
        os.environ.pop("DTSA_AUTH_KEY", None)
        _assert_refused("DTSA_AUTH_KEY", "--out", str(directory / "out"), "--auth")
    assert not (directory / "out").exists()


@in_flight("`--domain` of a flight under way", f"{_REFUSED}; the first flight is unharmed", *LOCKSTEP)
def domain_in_use(flight: FlightProcess) -> None:
    domain = flight.environment(flight.nodes[0])["ROS_DOMAIN_ID"]
    _assert_refused("domain", "--out", str(flight.out.parent / "second"), "--domain", domain)
    flight.interrupt()


@fault("two flights at the same time", "neither hears the other; both bags verify")
def two_flights(directory: Path) -> None:
    with (
        start_flight(directory / "one", *LOCKSTEP, *ENDLESS) as one,
        start_flight(directory / "two", *LOCKSTEP, "--seed", "5", *ENDLESS) as two,
    ):
        one.interrupt()
        two.interrupt()


def _step_clock(directory: Path, words: tuple[str, ...]) -> None:
    """Set the clock of a flight's processes back by an hour, then to a day ahead."""
    library, file = directory / "step.so", directory / "step"
    command = ["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(Path(__file__).with_name("clock_step.c"))]
    subprocess.run([*command, "-ldl"], check=True, timeout=60)

    def step(seconds: int) -> None:
        fresh = directory / "fresh"
        fresh.write_text(f"{seconds}\n")
        fresh.replace(file)

    with patch.dict(os.environ, {"LD_PRELOAD": str(library), "CLOCK_STEP_FILE": str(file)}):
        step(-3600)
        clock = subprocess.run(
            [sys.executable, "-c", "import time; print(time.time())"], capture_output=True, text=True
        )
        assert float(clock.stdout) - time.time() < -3000, "the library does not set the clock"
        step(0)
        with start_flight(directory / "flight", *words, *ENDLESS) as flight:
            for seconds in (-3600, 86_400):
                step(seconds)
                time.sleep(0.5)
                flight.assert_flies_on()
            assert flight.interrupt()["end"] == "stopped"
            assert "not been heard of" not in flight.stderr()


@fault("the machine's clock is set back by an hour, then to a day ahead, lockstep", _NO_EFFECT)
def clock_set(directory: Path) -> None:
    _step_clock(directory, LOCKSTEP)


@fault("the machine's clock is set back by an hour, then to a day ahead, real time", _NO_EFFECT)
def clock_set_in_real_time(directory: Path) -> None:
    _step_clock(directory, REALTIME)
