"""Apps and engine as libraries for this machine."""

from __future__ import annotations

import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from dtsa_agent.core.errors import ConfigError, DtsaError

from .app import App

_HERE = Path(__file__).parent
FIRMWARE, ENGINE = _HERE / "firmware", _HERE / "native"
#: An app is C as the firmware takes it; fused operations would make other bits than the core's.
FLAGS = ("-shared", "-fPIC", "-std=gnu11", "-g", "-Wall", "-Wno-psabi", "-ffp-contract=off")
_SHOWN = 3  # errors of the compiler that a message repeats


class CompileError(DtsaError):
    """An app does not compile."""


def compiler() -> list[str]:
    """The system's C compiler; ConfigError: there is none."""
    words = shlex.split(os.environ.get("CC", "")) or ["cc"]
    if shutil.which(words[0]) is None:
        raise ConfigError("CC", words[0], "a C compiler (Debian and Ubuntu: apt install gcc)")
    return words


def _run(command: Sequence[str], what: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.splitlines()
        errors = [line for line in lines if "error:" in line or "undefined reference" in line] or lines
        more = f" ... {len(errors) - _SHOWN} more" if len(errors) > _SHOWN else ""
        raise CompileError(f"{what} does not compile: " + " | ".join(errors[:_SHOWN]) + more)
    return done.stderr


def engine_library() -> Path:
    """The engine, from the cache where the same sources have been compiled before."""
    sources = sorted(ENGINE.glob("*.c"))
    command = [*compiler(), "-shared", "-fPIC", "-std=gnu11", "-O2", "-Wl,-Bsymbolic", f"-I{ENGINE}", f"-I{FIRMWARE}"]
    text = b"".join(path.read_bytes() for path in (*sorted(ENGINE.iterdir()), *sorted(FIRMWARE.iterdir())))
    key = hashlib.sha256(text + repr((command, os.uname().machine)).encode()).hexdigest()[:16]
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dtsa-peer-lab"
    library = cache / f"engine-{key}.so"
    if not library.exists():
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as directory:
            made = Path(directory) / library.name
            _run([*command, "-o", str(made), *map(str, sources), "-ldl"], "the engine")
            made.replace(library)
    return library


def compile_app(app: App, library: Path) -> str:
    """Compile an app into a library; the compiler's warnings; CompileError: it does not compile."""
    command = [*compiler(), *FLAGS, "-O1", "-DPEER_LAB", *app.flags]
    command += [f"-I{path}" for path in (*app.include, FIRMWARE)]
    # Its own names come first, whatever else of that name is loaded.
    command += ["-Wl,-Bsymbolic", "-o", str(library), *map(str, app.sources), str(engine_library()), "-lm"]
    if not any(flag.startswith("-fsanitize") for flag in app.flags):
        command.append("-Wl,-z,defs")  # a function that is not there is said now, not in flight
    return _run(command, f"app {app.name}")


def sanitizer_environment(app: App) -> dict[str, str]:
    """What the environment of a process needs that flies an app compiled with `-fsanitize=address`; else nothing."""
    if not any(flag.startswith("-fsanitize") and "address" in flag for flag in app.flags):
        return {}
    asked = [*compiler(), "-print-file-name=libasan.so"]
    library = subprocess.run(asked, capture_output=True, text=True, check=False).stdout.strip()
    # Python leaks, and the apps' stacks are not the process's.
    return {"LD_PRELOAD": library, "ASAN_OPTIONS": "detect_leaks=0:detect_stack_use_after_return=0:handle_segv=0"}
