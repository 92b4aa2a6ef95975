"""Debian's Python for aarch64, unpacked into a directory, and `dtsa` for it; both run in QEMU.

The machine's own packages and its list of architectures stay as they are: apt gets lists and a state of its own.
"""

from __future__ import annotations

from pathlib import Path

from .build import ReleaseError, _must
from .parts import QEMU
from .running import Runner, clean_environment
from .smoke import Installed

_PACKAGES = ("python3", "libstdc++6")
_GLIBC_OLDEST, _GLIBC_NEWEST = 17, 28  # of the wheels that are installed: Debian's own is newer
# QEMU runs one program; it must not become another one, which the kernel would start without it.
_ENTRY = "import sys; from dtsa_bench.commands.cli import main; sys.exit(main(sys.argv[1:]))"


def unpack(runner: Runner, root: Path, work: Path) -> str:
    """Debian's Python for aarch64.

    :param runner: runs programs.
    :param root: where to; what is there already is used.
    :param work: for what apt needs meanwhile.
    :returns: its version, such as 3.11.
    :raises ReleaseError: if it cannot be had.
    """
    python = root / "usr" / "bin" / "python3"
    if not python.exists():
        runner.say("Debian's Python for aarch64")
        for part in ("lists/partial", "cache/archives/partial"):
            (work / part).mkdir(parents=True)
        (work / "status").touch()
        options = {
            "APT::Architecture": "arm64", "APT::Architectures": "arm64", "APT::Sandbox::User": "root",
            "Acquire::Languages": "none", "Debug::NoLocking": "1", "Dir::State": work,
            "Dir::State::lists": work / "lists", "Dir::State::status": work / "status", "Dir::Cache": work / "cache",
        }  # fmt: skip
        apt: list[str | Path] = ["apt-get", "-q", "-y", *(f"-o{key}={value}" for key, value in options.items())]
        _must(runner.run([*apt, "update"], work), "apt-get update for arm64")
        install = [*apt, "--no-install-recommends", "--download-only", "install", *_PACKAGES]
        _must(runner.run(install, work), "Debian's Python for arm64")
        for package in sorted((work / "cache" / "archives").glob("*.deb")):
            _must(runner.run(["dpkg-deb", "-x", package, root], work), package.name)
    show = [QEMU, "-L", root, python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    return _must(runner.run(show, work), "Debian's Python in QEMU").stdout.strip()


def install(runner: Runner, root: Path, version: str, wheel: Path, work: Path, pip: str) -> Installed:
    """`dtsa` and what it depends on, as wheels for aarch64.

    :param version: of the Python there.
    :param wheel: what is installed.
    :param work: where to.
    :param pip: a Python whose pip does it.
    """
    site = work / "site"
    platforms = ["manylinux2014_aarch64"]
    platforms += [f"manylinux_2_{minor}_aarch64" for minor in range(_GLIBC_OLDEST, _GLIBC_NEWEST + 1)]
    words = [pip, "-m", "pip", "install", "--target", site, "--only-binary=:all:", "--python-version", version]
    words += [word for platform in platforms for word in ("--platform", platform)]
    done = runner.run([*words, wheel], work)
    if done.code != 0:
        raise ReleaseError(f"wheels for aarch64: {done.reason()}")
    python = (QEMU, "-L", str(root), str(root / "usr" / "bin" / "python3"))
    environment = {**clean_environment(), "PYTHONPATH": str(site)}
    return Installed((*python, "-c", _ENTRY), python, environment, jobs=1)
