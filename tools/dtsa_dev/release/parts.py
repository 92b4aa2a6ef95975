"""What a release is tried on, and what of it this machine lacks."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

from dtsa_agent.core.errors import ConfigError

AARCH64 = "aarch64"
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
PARTS = (*PYTHONS, AARCH64)
CROSS_COMPILER, QEMU = "aarch64-linux-gnu-gcc", "qemu-aarch64-static"
# What runs another processor's Python here, and the Debian package that has it.
_NEEDED = {
    CROSS_COMPILER: "gcc-aarch64-linux-gnu libc6-dev-arm64-cross",
    QEMU: "qemu-user-static",
    "apt-get": "apt",
    "dpkg-deb": "dpkg",
}


def find(skipped: Iterable[str]) -> tuple[dict[str, str], bool]:
    """What this machine can try a release on.

    :param skipped: names of `PARTS` to do without.
    :returns: interpreter by version; whether aarch64 is made.
    :raises ConfigError: for a name that does not exist, or with all that is missing.
    """
    left_out = set(skipped)
    for name in sorted(left_out - set(PARTS)):
        raise ConfigError("skip", name, ", ".join(PARTS))
    if left_out >= set(PYTHONS):
        raise ConfigError("skip", ", ".join(PYTHONS), "all but one of them at most")
    if platform.machine() != "x86_64":
        raise ConfigError("machine", platform.machine(), "x86_64; wheels for aarch64 are made there, too")
    pythons = {version: interpreter(version) for version in PYTHONS if version not in left_out}
    lacking = {version: f"Python {version} with venv" for version, path in pythons.items() if path is None}
    programs = [] if AARCH64 in left_out else [name for name in _NEEDED if shutil.which(name) is None]
    if programs:
        packages = " ".join(_NEEDED[name] for name in programs)
        lacking[AARCH64] = f"{', '.join(programs)} (Debian: apt install {packages})"
    if lacking:
        without = " ".join(f"--skip {name}" for name in lacking)
        raise ConfigError("machine", f"no {'; no '.join(lacking.values())}", f"a machine that has them, or {without}")
    return {version: path for version, path in pythons.items() if path is not None}, AARCH64 not in left_out


def interpreter(version: str) -> str | None:
    """A Python of a version that can make environments: in PATH, or pyenv's.

    :param version: such as 3.10.
    """
    kept = Path.home() / ".pyenv" / "versions"
    pyenv = sorted(kept.glob(f"{version}.*/bin/python"), key=lambda path: int(path.parts[-3].split(".")[2]))
    on_path = shutil.which(f"python{version}")
    for path in ([on_path] if on_path else []) + [str(path) for path in reversed(pyenv)]:
        show = [path, "-I", "-c", "import sys, venv; print('%d.%d' % sys.version_info[:2])"]
        found = subprocess.run(show, capture_output=True, text=True, check=False)  # a pyenv shim may lead nowhere
        if found.stdout.strip() == version:
            return path
    return None
