"""Disks and files: full, removed, cut, changed, in use; keys that are missing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from dtsa_dev.soak.checks import clean_end, interrupted_well, met, recovered
from dtsa_dev.soak.flights import ENDLESS, dtsa, flying

from .fault import LOCKSTEP, REALTIME, Fault

_FULL_BYTES = 60_000
_SHORT = ("--timeout-s", "1", "--no-picture")


def _disk_full(words: tuple[str, ...]) -> Callable[[Path], None]:
    def run(directory: Path) -> None:
        with flying(directory, *words, *ENDLESS, files_bytes=_FULL_BYTES) as flight:
            clean_end(flight, 1, "recording to", "recover")
            recovered(flight)

    return run


def _directory_removed(directory: Path) -> None:
    with flying(directory, *LOCKSTEP, *ENDLESS) as flight:
        shutil.rmtree(flight.out)
        flight.process.send_signal(2)
        code = flight.end()
        met(code in (1, 130), f"exit code {code}")
        met("Traceback" not in flight.said(), f"a traceback: {flight.said().strip()[-300:]}")
        flight.nobody_left()


def refused(*words: str, says: str) -> None:
    """A command that ends with code 2 and one line that says why.

    :param words: the command.
    :param says: a text in that line.
    """
    done = dtsa(*words)
    said = done.stderr.strip()
    met(done.returncode == 2, f"exit code {done.returncode}: {said[-300:]}")
    met(says in said and len(said.splitlines()) == 1, f"it does not say {says!r} in one line: {said[-300:]}")


def _directory_in_use(directory: Path) -> None:
    (directory / "out").mkdir()
    (directory / "out" / "mine.txt").write_text("mine")
    refused("fly", "--out", str(directory / "out"), *LOCKSTEP, says="out")
    met([path.name for path in (directory / "out").iterdir()] == ["mine.txt"], "the directory was changed")


def _directory_read_only(directory: Path) -> None:
    (directory / "file").write_text("no directory")
    done = dtsa("fly", "--out", str(directory / "file" / "out"), *LOCKSTEP)
    met(done.returncode in (1, 2), f"exit code {done.returncode}")
    met(len(done.stderr.strip().splitlines()) == 1, f"more than one line: {done.stderr.strip()[-300:]}")


def _flown(directory: Path, *words: str) -> Path:
    done = dtsa("fly", "--out", str(directory / "out"), *words, *_SHORT)
    met(done.returncode == 0, f"no flight: {done.stderr.strip()[-300:]}")
    return directory / "out" / "bag" / "bag_0.mcap"


def _bag_cut(directory: Path) -> None:
    path = _flown(directory, *LOCKSTEP, "--processes", "1")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) * 3 // 4])
    code = dtsa("verify", str(path)).returncode
    met(code, "a bag that was cut passes")
    met(dtsa("recover", str(path.parent)).returncode == 0, "it is not recovered")
    done = dtsa("verify", str(path.parent.with_name("bag_recovered")))
    met(done.returncode == 0 and "where the recording breaks off" in done.stdout, done.stdout.strip()[-300:])


def _bag_changed(directory: Path) -> None:
    path = _flown(directory, *LOCKSTEP, "--processes", "1")
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)
    done = dtsa("verify", str(path))
    met(done.returncode != 0, "a bag with a changed bit passes")
    met("Traceback" not in done.stderr, f"a traceback: {done.stderr.strip()[-300:]}")


def _key_missing(directory: Path) -> None:
    os.environ.pop("DTSA_AUTH_KEY", None)
    refused("fly", "--out", str(directory / "out"), "--auth", *LOCKSTEP, says="DTSA_AUTH_KEY")
    met(not (directory / "out").exists(), "a directory was made")


def _domain_in_use(directory: Path) -> None:
    with flying(directory, *LOCKSTEP, *ENDLESS) as flight:
        domain = flight.environment(flight.known[0])["ROS_DOMAIN_ID"]
        words = ("fly", "--out", str(directory / "second"), "--domain", domain, *LOCKSTEP)
        refused(*words, says="domain")
        interrupted_well(flight)


def _two_flights(directory: Path) -> None:
    with (
        flying(directory / "one", *LOCKSTEP, *ENDLESS) as one,
        flying(directory / "two", *LOCKSTEP, "--seed", "5", *ENDLESS) as two,
    ):
        interrupted_well(one)
        interrupted_well(two)


_REFUSED = "refused with one line and code 2 before anything is started"

FAULTS = (
    Fault("disk full, lockstep", "the disk is full while a flight in lockstep is recorded",
          "the flight ends with code 1 and a line that names the file; `recover` saves a bag that verifies",
          _disk_full(LOCKSTEP), True),
    Fault("disk full, real time", "the disk is full while a flight in real time is recorded",
          "the flight ends with code 1 and a line that names the file; `recover` saves a bag that verifies",
          _disk_full(REALTIME)),
    Fault("directory removed", "the flight's directory is removed while it is under way",
          "the flight ends on SIGINT, without a traceback; no process stays", _directory_removed),
    Fault("directory in use", "`--out` names a directory with files in it", f"{_REFUSED}; the files stay",
          _directory_in_use, True),
    Fault("directory impossible", "`--out` cannot be made", "one line that says so", _directory_read_only, True),
    Fault("bag cut", "a bag is cut off at three quarters",
          "`verify` refuses it; `recover` saves what verifies up to where it breaks off", _bag_cut, True),
    Fault("bag changed", "one bit of a bag is changed", "`verify` finds it", _bag_changed),
    Fault("key missing", "`--auth` without a key in the environment", _REFUSED, _key_missing, True),
    Fault("domain in use", "`--domain` of a flight under way", f"{_REFUSED}; the first flight is unharmed",
          _domain_in_use),
    Fault("two flights", "two flights at the same time", "neither hears the other; both bags verify", _two_flights),
)  # fmt: skip
