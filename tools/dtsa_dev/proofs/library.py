"""Where libdtsa's sources are, and how they are compiled by other compilers than the build's."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import dtsa_agent
from dtsa_agent.core.errors import ConfigError, DtsaError

HERE = Path(__file__).resolve().parent
LIBRARY = Path(dtsa_agent.__file__).resolve().parent / "libdtsa"
# Bits do not depend on compiler and machine.
SAME_BITS = ("-std=c11", "-fno-fast-math", "-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi")


class NotHere(DtsaError):
    """A tool that is not on this machine; the message says which, and how to get it."""


def tool(name: str, package: str) -> str:
    """The path of a program; ``package`` is the Debian package that has it."""
    found = shutil.which(name)
    if found is None:
        raise NotHere(f"missing: {name}; on Debian and Ubuntu: sudo apt install {package}")
    return found


def sources(library: Path = LIBRARY, without: Sequence[str] = ()) -> list[Path]:
    """The C files of libdtsa."""
    found = [path for path in sorted(library.rglob("*.c")) if path.name not in without]
    if not found:
        raise ConfigError("libdtsa", str(library), "a folder with its sources")
    return found


def compile_program(
    compiler: str,
    out: Path,
    files: Sequence[Path],
    flags: Sequence[str],
    library: Path = LIBRARY,
    links: Sequence[str] = ("-lm",),
) -> Path:
    """Compile and link files, those of libdtsa among them, with its headers in reach; the program.

    :param flags: besides those that keep the bits the same.
    :param links: options of the linker, at the end.
    """
    include = [f"-I{library / 'include'}", f"-I{library}"]
    command = [compiler, *SAME_BITS, *flags, *include, *map(str, files), "-o", str(out), *links]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    if done.returncode:
        raise DtsaError(f"{Path(compiler).name}: {done.stderr.strip()[-2000:]}")
    return out
