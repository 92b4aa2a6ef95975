"""Coverage-guided fuzzing of the C code: libFuzzer with the sanitizers of addresses and of undefined behaviour."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
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
    path = shutil.which(name)
    if path is None:
        raise NotHere(f"missing: {name}; on Debian and Ubuntu: sudo apt install {package}")
    return path


def sources(library: Path = LIBRARY, without: Sequence[str] = ()) -> list[Path]:
    """The C files of libdtsa."""
    files = [path for path in sorted(library.rglob("*.c")) if path.name not in without]
    if not files:
        raise ConfigError("libdtsa", str(library), "a folder with its sources")
    return files


def compile_program(
    compiler: str,
    out: Path,
    files: Sequence[Path],
    flags: Sequence[str],
    library: Path = LIBRARY,
    links: Sequence[str] = ("-lm",),
) -> Path:
    """Compile and link files, those of libdtsa among them, with its headers in reach; the program.

    `flags` come besides those that keep the bits the same, `links` at the end.
    """
    include = [f"-I{library / 'include'}", f"-I{library}"]
    command = [compiler, *SAME_BITS, *flags, *include, *map(str, files), "-o", str(out), *links]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    if done.returncode:
        raise DtsaError(f"{Path(compiler).name}: {done.stderr.strip()[-2000:]}")
    return out


TARGETS = {"frames": 64, "agents": 1024, "station": 1024}  # largest input, bytes
_FLAGS = ("-g", "-O1", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all")


class FuzzFinding(DtsaError):
    """An input on which libdtsa does what it must not; the message says which."""


@dataclass(frozen=True, slots=True)
class Fuzzed:
    """Result of a run of the fuzzer."""

    runs: int
    covered: int  # edges of the control flow
    features: int


def build(target: str, directory: Path, library: Path = LIBRARY) -> Path:
    """Compile the fuzzer of a target of :data:`TARGETS`."""
    clang = tool("clang", "clang")
    parts = sources(library)
    if target == "frames":
        parts = [path for path in parts if path.name.startswith("frame")]
    try:
        return compile_program(
            clang, directory / f"fuzz_{target}", [HERE / f"fuzz_{target}.c", *parts], _FLAGS, library
        )
    except DtsaError as error:
        if "libclang_rt" in str(error):
            raise NotHere("missing: clang's runtime; on Debian: sudo apt install libclang-rt-14-dev") from error
        raise


def fuzz(program: Path, seconds: float, corpus: Path, seed: int = 0, most: int = -1) -> Fuzzed:
    """Fuzz for a while, or until so many inputs (-1: any number).

    The corpus is a folder of inputs that reach something new: read, and added to. An input on which libdtsa does what
    it must not is kept in its parent.
    """
    target = program.name.removeprefix("fuzz_")
    corpus.mkdir(parents=True, exist_ok=True)
    artifacts = f"-artifact_prefix={corpus.parent}/{target}-"
    options = [f"-max_total_time={max(1, round(seconds))}", f"-max_len={TARGETS[target]}", "-print_final_stats=1"]
    options += [artifacts, f"-seed={seed}", f"-runs={most}", "-timeout=10", "-rss_limit_mb=2048"]
    command = [str(program), str(corpus), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=seconds + 120, errors="replace")
    if done.returncode:
        raise FuzzFinding(f"{target}: {_essence(done.stderr)}")
    status = re.findall(r"cov: (\d+) ft: (\d+)", done.stderr)
    runs = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    covered, features = status[-1] if status else (0, 0)
    return Fuzzed(int(runs[1]) if runs else 0, int(covered), int(features))


def _essence(text: str) -> str:
    lines = [line for line in text.splitlines() if re.search(r"ERROR|runtime error|Test unit|SUMMARY|#[0-4] ", line)]
    return "; ".join(line.strip() for line in lines)[-800:]
