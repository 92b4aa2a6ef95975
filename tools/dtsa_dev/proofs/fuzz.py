"""Coverage-guided fuzzing of the C code: libFuzzer with the sanitizers of addresses and of undefined behaviour."""

from __future__ import annotations

import re
import subprocess
from dataclasses import dataclass
from pathlib import Path

from dtsa_agent.core.errors import DtsaError

from .library import HERE, LIBRARY, NotHere, compile_program, sources, tool

TARGETS = {"frames": 64, "agents": 1024, "station": 1024}  # largest input, bytes
_FLAGS = ("-g", "-O1", "-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=all")


class Found(DtsaError):
    """An input on which libdtsa does what it must not; the message says which."""


@dataclass(frozen=True, slots=True)
class Fuzzed:
    """What a run of the fuzzer did."""

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
        raise Found(f"{target}: {_essence(done.stderr)}")
    status = re.findall(r"cov: (\d+) ft: (\d+)", done.stderr)
    runs = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    covered, features = status[-1] if status else (0, 0)
    return Fuzzed(int(runs[1]) if runs else 0, int(covered), int(features))


def _essence(text: str) -> str:
    lines = [line for line in text.splitlines() if re.search(r"ERROR|runtime error|Test unit|SUMMARY|#[0-4] ", line)]
    return "; ".join(line.strip() for line in lines)[-800:]
