"""A release from beginning to end: made, installed, tried, written down."""

from __future__ import annotations

import json
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from dtsa_bench import __version__
from dtsa_bench.runs.options import new_directory
from machine import prepare

from . import aarch64, parts
from .build import ReleaseError, checked, make
from .running import Runner, clean_environment
from .smoke import Installed, Trial

MAX_IMPORT_S = 0.5
EXTRAS = "tables,view,cluster,learning"
RECORD, LOG = "release.json", "release.log"


def release(out: str, skipped: set[str], root: str | None, as_json: bool) -> int:
    """Makes and tries everything.

    :param out: new directory for the files.
    :param skipped: what to do without, of `parts.PARTS`.
    :param root: where Debian's Python for aarch64 is kept; None: nowhere.
    :param as_json: print the record in place of tables.
    :returns: exit code: 0, or 1 if something was not as it should be.
    :raises ConfigError: for what is missing on the machine.
    """
    pythons, with_aarch64 = parts.find(skipped)
    directory = new_directory(out)
    signal.signal(signal.SIGTERM, prepare.interrupt)  # as Ctrl-C: what was begun is removed
    with tempfile.TemporaryDirectory(prefix="dtsa-release-") as name:
        work = Path(name)
        files = work / "files"
        files.mkdir()
        kept = None
        try:
            with (files / LOG).open("w", encoding="utf-8") as log:
                runner = Runner(log)
                kept = _Release(runner, work, files, Path(root).resolve() if root else work / "root")
                try:
                    kept.run(pythons, with_aarch64)
                finally:
                    runner.end()
            kept.record["skipped"] = sorted(skipped)
            (files / RECORD).write_text(json.dumps(kept.record, indent=1) + "\n", encoding="utf-8")
            for path in sorted(files.iterdir()):
                (directory / path.name).write_bytes(path.read_bytes())
        except ReleaseError as error:
            (directory / LOG).write_bytes((files / LOG).read_bytes())
            print(f"dtsa: error: {error}; log: {directory / LOG}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            directory.rmdir()
            raise
    print(json.dumps(kept.record, indent=1) if as_json else tables(kept.record, directory))
    return 0 if kept.record["ok"] else 1


class _Release:
    """What is made, tried and noted."""

    def __init__(self, runner: Runner, work: Path, files: Path, root: Path) -> None:
        from dtsa_bench.experiments.batch.made_with import made_with

        self._runner, self._work, self._files, self._root = runner, work, files, root
        self.record: dict[str, Any] = {"version": __version__, **made_with(), "files": [], "trials": [], "ok": False}

    def run(self, pythons: dict[str, str], with_aarch64: bool) -> None:
        """Makes, checks, tries.

        :param pythons: interpreter by version.
        :param with_aarch64: whether aarch64 is made and tried.
        """
        made = make(self._runner, self._files, with_aarch64)
        self._runner.say("metadata")
        self.record["files"] = [checked(self._runner, path) for path in made]
        for version, interpreter in pythons.items():
            self._try(version, interpreter, made[0], made[1])
        if with_aarch64:
            self._try_aarch64(made[2], self._work / next(iter(pythons)) / "run")
        trials = self.record["trials"]
        digests = {trial["digest"] for trial in trials}
        self.record["digests_equal"] = len(digests) <= 1 and "" not in digests
        failed = [*self.record["files"], *trials]
        self.record["ok"] = self.record["digests_equal"] and not any(each["failures"] for each in failed)

    def _try(self, version: str, interpreter: str, source: Path, wheel: Path) -> None:
        """The wheel in a fresh environment, its extras, and then the source distribution in its place."""
        place = self._work / version
        place.mkdir()
        self._runner.say(f"Python {version}: environment")
        self._must([interpreter, "-m", "venv", place / "venv"], place)
        programs = place / "venv" / "bin"
        installed = Installed((str(programs / "dtsa"),), (str(programs / "python"),), clean_environment())
        trial = Trial(self._runner, installed, place / "run")
        trial.directory.mkdir()
        pip = [programs / "pip", "install", "-q"]
        self._runner.say(f"Python {version}: from nothing to a picture")
        begun = time.monotonic()
        self._must([*pip, wheel], place)
        install_s = time.monotonic() - begun
        picture = trial.dtsa("simulate", "--agents", "12", "--picture", "first.png", makes="first.png")
        self._runner.say(f"Python {version}: all commands")
        import_s = trial.imported(__version__)
        trial.note(import_s < MAX_IMPORT_S, f"import dtsa: {import_s:.2f} s; allowed: less than {MAX_IMPORT_S} s")
        digest = trial.flown()
        trial.without_extras(__version__)
        self._runner.say(f"Python {version}: extras")
        self._must([*pip, f"{wheel}[{EXTRAS}]"], place)
        trial.with_extras()
        self._note(version, "wheel", trial, digest, install_s, picture.seconds, import_s)
        self._runner.say(f"Python {version}: from source")
        from_source = Trial(self._runner, installed, place / "source")
        from_source.directory.mkdir()
        begun = time.monotonic()
        self._must([*pip, "--force-reinstall", "--no-deps", source], place)
        install_s = time.monotonic() - begun
        picture = from_source.dtsa("simulate", "--agents", "12", "--picture", "first.png", makes="first.png")
        import_s = from_source.imported(__version__)
        self._note(version, "source", from_source, from_source.flown(), install_s, picture.seconds, import_s)

    def _try_aarch64(self, wheel: Path, flown: Path) -> None:
        """The wheel for aarch64 in Debian's Python.

        Agents do not fly there: QEMU knows neither SO_TIMESTAMPNS nor IP_MULTICAST_ALL. What they did here is merged
        and verified there: all decisions are made again by the other processor.

        :param wheel: the wheel.
        :param flown: where the agents' bags are.
        """
        place = self._work / parts.AARCH64
        place.mkdir()
        version = aarch64.unpack(self._runner, self._root, place)
        self._runner.say("aarch64: wheels")
        begun = time.monotonic()
        installed = aarch64.install(self._runner, self._root, version, wheel, place, sys.executable)
        install_s = time.monotonic() - begun
        trial = Trial(self._runner, installed, place / "run")
        trial.directory.mkdir()
        self._runner.say("aarch64: all commands, in QEMU")
        picture = trial.dtsa("simulate", "--agents", "12", "--picture", "first.png", makes="first.png")
        digest = trial.flown()
        trial.without_extras(__version__, flown)
        self._note(f"{version} aarch64", "wheel", trial, digest, install_s, picture.seconds, None)

    def _must(self, words: list[str | Path], place: Path) -> None:
        done = self._runner.run(words, place)
        if done.code != 0:
            raise ReleaseError(f"{' '.join(map(str, words[-3:]))}: {done.reason()}")

    def _note(
        self,
        python: str,
        made_of: str,
        trial: Trial,
        digest: str,
        install_s: float,
        picture_s: float,
        import_s: float | None,
    ) -> None:
        row = {
            "python": python, "from": made_of, "install_s": round(install_s, 1), "picture_s": round(picture_s, 2),
            "import_s": None if import_s is None else round(import_s, 4), "checks": trial.count, "digest": digest,
            "failures": trial.failures,
        }  # fmt: skip
        self.record["trials"].append(row)


def tables(record: dict[str, Any], directory: Path) -> str:
    """A record for people.

    :param record: what was found.
    :param directory: where it is.
    """
    from dtsa_dev.benchmark.tables import table_text

    changed = ", and changes that are in no commit" if record["tree_changed"] else ""
    files = [
        {"file": row["file"], "MB": row["bytes"] / 1e6, "twine": row["twine"], "symbols allow": row.get("platform")}
        for row in record["files"]
    ]
    trials = [
        {
            "python": row["python"], "from": row["from"], "install_s": row["install_s"],
            "first_picture_s": row["picture_s"], "import_s": row["import_s"], "flights": row["digest"],
            "checks": row["checks"], "failed": len(row["failures"]),
        }
        for row in record["trials"]
    ]  # fmt: skip
    lines = [f"dtsa {record['version']}, commit {record['commit'][:12]}{changed}", "", table_text(files), ""]
    lines += [table_text(trials), ""]
    for row in record["files"]:
        lines += [f"failed: {row['file']}: {failure}" for failure in row["failures"]]
    for row in record["trials"]:
        lines += [f"failed: {row['python']}, {row['from']}: {failure}" for failure in row["failures"]]
    if not record["digests_equal"]:
        lines.append("failed: the digests of the flights differ")
    lines += [f"skipped: {', '.join(record['skipped'])}"] if record["skipped"] else []
    lines.append(f"{'all is well' if record['ok'] else 'NOT GOOD'}; nothing was uploaded; files: {directory}")
    return "\n".join(lines)
