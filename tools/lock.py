#!/usr/bin/env python3
"""Renews the pinned requirements: `requirements/*.in` say what is wanted, `*.txt` what is installed.

Usage: tools/lock.py [--keep] PYTHON3.10 PYTHON3.11 PYTHON3.12 PYTHON3.13

With --keep what is pinned keeps its version, and only what is new is chosen.

Each interpreter lets pip choose versions for everything together, so that all sets fit each other. A
version that differs between interpreters becomes one line for each, with a marker.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

REQUIREMENTS = Path(__file__).resolve().parent.parent / "requirements"
SETS = ("ros", "build", "runtime", "test", "dev", "cflib", "benchmark", "cluster", "learning", "docs", "release")

# Runs in a fresh environment: names, versions and dependencies (by the markers of this interpreter) as JSON.
RESOLVE = """
import json, subprocess, sys
from pip._vendor.packaging.requirements import Requirement
from pip._vendor.packaging.utils import canonicalize_name
from pip._vendor.packaging.markers import default_environment

sets = {name: [line.strip() for line in open(path) if line.strip() and not line.startswith("#")]
        for name, path in json.loads(sys.argv[1]).items()}
everything = [line for lines in sets.values() for line in lines]
pip = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--report", "-"]
pip += sys.argv[2:]
out = subprocess.run([*pip, *everything], check=True, stdout=subprocess.PIPE).stdout
metadata = [item["metadata"] for item in json.loads(out)["install"]]
chosen = {canonicalize_name(each["name"]): each for each in metadata}

def closure(lines):
    todo, seen = [Requirement(line) for line in lines], set()
    while todo:
        wanted = todo.pop()
        key = (canonicalize_name(wanted.name), frozenset(wanted.extras))
        if key in seen:
            continue
        seen.add(key)
        for line in chosen[key[0]].get("requires_dist", []):
            needed = Requirement(line)
            extras = ["", *wanted.extras]
            here, marker = default_environment(), needed.marker
            if marker is None or any(marker.evaluate({**here, "extra": each}) for each in extras):
                todo.append(needed)
    return {name: chosen[name]["version"] for name, _ in seen}

json.dump({name: closure(lines) for name, lines in sets.items()}, sys.stdout)
"""


def resolve(interpreter: str, keep: bool) -> tuple[str, dict[str, dict[str, str]]]:
    """Let one interpreter choose.

    :param interpreter: path of a Python that has pip and venv.
    :param keep: whether pinned versions stay.
    :returns: its version, such as 3.12, and for each set the chosen version of each package.
    """
    show = "import sys; print('%d.%d' % sys.version_info[:2])"
    version = subprocess.run([interpreter, "-c", show], check=True, stdout=subprocess.PIPE, text=True).stdout.strip()
    with tempfile.TemporaryDirectory() as directory:
        subprocess.run([interpreter, "-m", "venv", directory], check=True)
        files = json.dumps({name: str(REQUIREMENTS / f"{name}.in") for name in SETS})
        command = [f"{directory}/bin/python", "-c", RESOLVE, files]
        for name in SETS if keep else ():
            if (pinned := REQUIREMENTS / f"{name}.txt").exists():
                command += ["--constraint", str(pinned)]
        chosen = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return version, chosen


def lines(name: str, versions: dict[str, dict[str, dict[str, str]]]) -> Iterable[str]:
    """Lines of one set's pinned file.

    :param name: the set.
    :param versions: interpreter version -> set -> package -> version.
    """
    packages: dict[str, dict[str, list[str]]] = defaultdict(lambda: defaultdict(list))
    for python, sets in versions.items():
        for package, version in sets[name].items():
            packages[package][version].append(python)
    for package in sorted(packages):
        for version, pythons in packages[package].items():
            marker = " or ".join(f'python_version == "{python}"' for python in pythons)
            yield f"{package}=={version}" + ("" if len(pythons) == len(versions) else f" ; {marker}")


def main() -> int:
    keep = "--keep" in sys.argv
    interpreters = [word for word in sys.argv[1:] if word != "--keep"]
    if not interpreters:
        print(__doc__, file=sys.stderr)
        return 2
    versions = {}
    for interpreter in interpreters:
        print(f"resolving with {interpreter} ...", file=sys.stderr, flush=True)
        version, chosen = resolve(interpreter, keep)
        versions[version] = chosen
    for name in SETS:
        head = f"# Written by tools/lock.py from {name}.in for Python {', '.join(versions)}. Do not edit.\n"
        (REQUIREMENTS / f"{name}.txt").write_text(head + "".join(f"{line}\n" for line in lines(name, versions)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
