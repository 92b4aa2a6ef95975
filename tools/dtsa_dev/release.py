"""`dtsa release`: the distribution, made and tried."""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

from dtsa_agent.core.errors import ConfigError
from dtsa_bench.commands.registry import Command

ROOT = Path(__file__).resolve().parents[2]
TRIAL = Path(__file__).with_name("release_trial.py")
PYTHONS, AARCH64 = ("3.10", "3.11", "3.12", "3.13"), "aarch64"
CROSS = {"CC": "aarch64-linux-gnu-gcc", "LDSHARED": "aarch64-linux-gnu-gcc -shared"}
QEMU = "qemu-aarch64-static"
MAX_WHEEL_BYTES = 3_000_000
FOREIGN = ("AMENT_", "ROS_", "RMW_", "DTSA_", "LD_LIBRARY_PATH", "VIRTUAL_ENV", "PYTHON", "_ROS_")
# No debug information, which names the folder of the build: equal sources give equal files.
CLEAN = {name: value for name, value in os.environ.items() if not name.startswith(FOREIGN)} | {"CFLAGS": "-g0"}


class ReleaseCommand(Command):
    description = """\
Makes the source distribution and the wheels (x86_64 and aarch64) of this checkout, installs them in fresh environments
of Python 3.10 to 3.13 (aarch64: Debian's Python in QEMU), tries commands there, and compares digests of flights. The
files, release.json and release.log are then in DIR. Nothing is uploaded."""
    examples = (
        ("--out dist", "everything"),
        ("--out dist --skip 3.12 --skip aarch64", "on a machine without that Python and without a cross compiler"),
    )

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--out", metavar="DIR", required=True, help="new directory for the files")
        names = (*PYTHONS, AARCH64)
        text = f"do without, where the machine lacks it: {', '.join(names)}; more than once"
        parser.add_argument("--skip", metavar="NAME", action="append", default=[], choices=names, help=text)

    def run(self, args: argparse.Namespace) -> int:
        """Make and try everything.

        :returns: exit code: 0, or 1 if something is not as it should be.
        :raises ConfigError: for what the machine lacks.
        """
        from dtsa_bench.runs.options import new_directory

        wanted = [name for name in (*PYTHONS, AARCH64) if name not in args.skip]
        lacking = [
            name
            for name in wanted
            if not (all(map(shutil.which, (CROSS["CC"], QEMU))) if name == AARCH64 else python(name))
        ]
        if lacking:
            raise ConfigError(
                "machine", f"without {', '.join(lacking)}", f"one with all, or --skip {' --skip '.join(lacking)}"
            )
        out = new_directory(args.out)
        with tempfile.TemporaryDirectory(prefix="dtsa-release-") as name, (out / "release.log").open("w") as log:
            try:
                record = Release(out, Path(name), log).make(wanted)
            except subprocess.CalledProcessError as error:
                print(f"dtsa: error: failed: {' '.join(error.cmd)[:200]}; log: {out / 'release.log'}", file=sys.stderr)
                return 1
        text = json.dumps(record, indent=1) + "\n"
        (out / "release.json").write_text(text, encoding="utf-8")
        print(text, end="")
        return 0 if record["ok"] else 1


def python(version: str) -> str:
    """Path of a Python of a version, in PATH or of pyenv; empty where there is none."""
    path = os.pathsep.join([os.environ["PATH"], *map(str, Path.home().glob(f".pyenv/versions/{version}.*/bin"))])
    words = ["uv", "python", "find", "--no-python-downloads", "--no-project", "--system", version]
    environment = {**os.environ, "PATH": path}
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False).stdout.strip()


class Release:
    """Make and try the files of a release, in `out`; all else goes to `work`, what programs print to `log`."""

    def __init__(self, out: Path, work: Path, log: IO[str]) -> None:
        self._out, self._work, self._log = out, work, log

    def make(self, wanted: Sequence[str]) -> dict[str, Any]:
        """All files, and what was found.

        :raises subprocess.CalledProcessError: if a step fails without which nothing can be tried.
        """
        stamp = {"SOURCE_DATE_EPOCH": self._call(["git", "log", "-1", "--format=%ct"]).strip() or "0"}
        self._call(["uv", "build", "--no-build-isolation", "--sdist", "--out-dir", self._out, ROOT], stamp)
        source = next(self._out.glob("*.tar.gz"))
        wheel = self._build_wheel(source, stamp)
        trials = {f"{name}, wheel": self._try(name, wheel) for name in wanted if name != AARCH64}
        trials["source"] = self._try(wanted[0], source, "source")
        if AARCH64 in wanted:
            cross = self._build_wheel(source, {**stamp, **CROSS, "_PYTHON_HOST_PLATFORM": "linux-aarch64"})
            trials[AARCH64] = self._try_aarch64(cross)
        files = {path.name: path.stat().st_size for path in sorted(self._out.glob("dtsa-*"))}
        self._call([sys.executable, "-m", "twine", "check", "--strict", *(self._out / name for name in files)])
        well = not any(trial["failures"] for trial in trials.values()) and max(files.values()) < MAX_WHEEL_BYTES
        ok = well and len({trial["digest"] for trial in trials.values()}) == 1
        return {"ok": ok, "files": files, "trials": trials}

    def _call(self, words: Sequence[str | Path], more: Mapping[str, str] | None = None, at: Path = ROOT) -> str:
        """Standard output of a program; all that it prints goes into the log."""
        command = [str(word) for word in words]
        print(f"dtsa: {' '.join(command)[:110]} ...", file=sys.stderr, flush=True)
        done = subprocess.run(
            command, cwd=at, env={**CLEAN, **(more or {})}, capture_output=True, text=True, check=False
        )
        self._log.write(f"$ {' '.join(command)}\n{done.stdout}{done.stderr}")
        done.check_returncode()
        return done.stdout

    def _build_wheel(self, source: Path, environment: Mapping[str, str]) -> Path:
        """A wheel out of the source distribution, with the tag that its symbols allow."""
        before, raw = set(self._out.glob("*.whl")), Path(tempfile.mkdtemp(dir=self._work))
        self._call(["uv", "build", "--no-build-isolation", "--wheel", "--out-dir", raw, source], environment)
        self._call([sys.executable, "-m", "auditwheel", "repair", "--wheel-dir", self._out, next(raw.glob("*.whl"))])
        return (set(self._out.glob("*.whl")) - before).pop()

    def _try(self, version: str, file: Path, name: str = "") -> dict[str, Any]:
        """Install a file in a fresh environment and try it there."""
        place = self._work / (name or version)
        self._call(["uv", "venv", "--no-project", "--python", python(version), place / "venv"])
        self._call(["uv", "pip", "install", "--python", place / "venv/bin/python", file])
        return dict(json.loads(self._call([place / "venv/bin/python", TRIAL], at=place).splitlines()[-1]))

    def _try_aarch64(self, wheel: Path) -> dict[str, Any]:
        """Try the wheel for aarch64 in Debian's Python, in QEMU. The machine's own packages stay as they are."""
        place = self._work / AARCH64
        for part in ("lists/partial", "cache/archives/partial", "run"):
            (place / part).mkdir(parents=True)
        (place / "status").touch()
        options = {
            "APT::Architecture": "arm64", "APT::Architectures": "arm64", "APT::Sandbox::User": "root",
            "Debug::NoLocking": "1", "Dir::State": place, "Dir::State::lists": place / "lists",
            "Dir::State::status": place / "status", "Dir::Cache": place / "cache",
        }  # fmt: skip
        apt = ["apt-get", "-q", "-y", *(f"-o{key}={value}" for key, value in options.items())]
        self._call([*apt, "update"])
        self._call([*apt, "--no-install-recommends", "--download-only", "install", "python3", "libstdc++6"])
        for package in sorted((place / "cache/archives").glob("*.deb")):
            self._call(["dpkg-deb", "-x", package, place / "root"])
        program = next((place / "root/usr/bin").glob("python3.??"))
        install = ["uv", "pip", "install", "--only-binary", ":all:", "--python-platform", "aarch64-manylinux_2_28"]
        self._call([*install, "--python-version", program.name[6:], "--target", place / "site", wheel])
        words = [QEMU, "-L", place / "root", program, TRIAL]
        return dict(json.loads(self._call(words, {"PYTHONPATH": str(place / "site")}, place / "run").splitlines()[-1]))
