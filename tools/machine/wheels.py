"""The virtual environment and the pinned packages in it.

Wheels are kept in pip's cache directory (`dtsa-wheels`), because pip's own cache is of no use without a
network: pip asks the index for the list of files first. With the directory filled, no step of the set-up
needs a network.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

from machine import cmake_paths, layout, leftovers, processes
from machine.layout import SetupError
from machine.progress import Step, step

UNFINISHED = "unfinished"  # the stamp of a set while pip installs it
PART = ".part-"  # begins the names of unfinished downloads
PART_AGE_S = 86400.0  # an unfinished download that is older belongs to nobody
BATCH = 24  # packages in one call of pip: shows progress, and keeps what came before an interruption
SYSTEM_PACKAGES = {
    "numpy": "python3-numpy",
    "matplotlib": "python3-matplotlib",
    "pandas": "python3-pandas",
    "pyyaml": "python3-yaml",
}
PROBE = """
import importlib.metadata as metadata
names = {each.metadata["Name"] or "" for each in metadata.distributions()}
print(*{name.lower().replace("_", "-").replace(".", "-") for name in names})
"""


def clean_environment() -> dict[str, str]:
    """Environment for pip and the build: nothing of another Python or ROS installation leaks in."""
    dropped = {"PYTHONPATH", "PYTHONHOME", "PIP_USER", "PIP_TARGET", "PIP_PREFIX", "__PYVENV_LAUNCHER__"}
    kept = {key: value for key, value in os.environ.items() if key not in dropped}
    # Packages without a wheel are built apart, with tools of their own: pip before 23.1 wants those of the environment.
    return kept | {"PIP_USE_PEP517": "1"}


def venv_key() -> str:
    """Changes when the environment has to be made anew: other Python, other place, other kind of machine."""
    return f"{layout.python_version()} {layout.kind()} {layout.ROOT}"


def required_sets(extras: set[str]) -> list[str]:
    """Sets to install: those that every machine needs, those asked for, and those installed before."""
    base = {"system": ["runtime"], "wheels": ["ros", "runtime"], "none": ["build", "runtime"]}[layout.kind()]
    before = {name for name in layout.EXTRAS if (layout.VENV_STAMPS / name).exists()}
    return base + sorted(extras | before)


def set_key(name: str) -> str:
    """Changes when the pinned versions of a set change."""
    return layout.digest(layout.read(layout.REQUIREMENTS / f"{name}.txt"))


def missing_sets(extras: set[str]) -> list[str]:
    """Sets that are not installed as pinned."""
    return [name for name in required_sets(extras) if layout.read(layout.VENV_STAMPS / name) != set_key(name)]


def has_venv() -> bool:
    """Whether the virtual environment is there and is this one."""
    return layout.PYTHON.exists() and layout.read(layout.VENV_STAMPS / "venv") == venv_key()


def venv_begun() -> Path:
    """A file that is there while the environment is made or removed: what is there of it then is of no use."""
    return layout.STATE / f"venv{layout.SUFFIX}"


def disown_venv() -> None:
    """Note that the environment is about to be made or removed, before anything of it changes."""
    layout.write(venv_begun(), "")
    (layout.VENV_STAMPS / "venv").unlink(missing_ok=True)


def make_venv() -> None:
    """Make the virtual environment; one without a stamp that fits this Python is taken over as it is.

    :raises SetupError: if the one that is there does not fit, and is in use.
    """
    with step("venv", f"virtual environment ({layout.VENV.name})") as current:
        environment = clean_environment()
        if not usable():
            processes.refuse_if_used([layout.VENV])
            disown_venv()
            command = [layout.base_python(), "-m", "venv", "--clear"]
            if layout.has_ros_installation():
                command.append("--system-site-packages")
            current.run([*command, layout.VENV], environment)
        layout.write(layout.VENV_STAMPS / "venv", venv_key())
        venv_begun().unlink(missing_ok=True)


def usable() -> bool:
    """Whether an environment without our stamp may be used: same Python, made at this place, with pip."""
    ours = (layout.VENV_STAMPS / "venv").exists() or venv_begun().exists()
    if layout.has_ros_installation() or ours or not layout.PYTHON.exists():
        return False
    pip = layout.VENV / "bin" / "pip"
    show = [str(layout.PYTHON), "-I", "-S", "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    result = subprocess.run(show, stdout=subprocess.PIPE, text=True, check=False)
    first_line = layout.read(pip).partition("\n")[0]
    return result.stdout.strip() == layout.python_version() and str(layout.VENV) in first_line


def note_interruption(extras: set[str]) -> None:
    """Where pip was interrupted without a stamp that says so, all sets are unfinished.

    :param extras: sets of requirements beyond those of every machine.
    """
    names = required_sets(extras)
    if leftovers.found({leftovers.canonical(pin.split("==")[0]) for name in names for pin in pinned(name)}):
        for name in names:
            layout.write(layout.VENV_STAMPS / name, UNFINISHED)


def install(names: list[str]) -> None:
    """Install sets of requirements as pinned, wheels first from the local store.

    Where an interruption left a set unfinished, half packages are removed first: pip would take them for installed.

    :param names: the sets.
    """
    environment = clean_environment()
    unfinished = [name for name in names if layout.read(layout.VENV_STAMPS / name) == UNFINISHED]
    if unfinished:
        leftovers.remove([pin for name in unfinished for pin in pinned(name)])
    present = system_distributions(str(layout.PYTHON)) if layout.has_ros_installation() else set()
    for name in names:
        lines = [line for line in pinned(name) if line.split("==")[0] not in present]
        if lines:
            with step(f"install-{name}", f"{len(lines)} packages of requirements/{name}.txt") as current:
                options = fetch(current, lines, environment)
                layout.write(layout.VENV_STAMPS / name, UNFINISHED)
                current.run([*pip(), "install", *options, *lines], environment)
                if name == "ros":
                    mend_cmake_files(environment)
        layout.write(layout.VENV_STAMPS / name, set_key(name))


def pinned(name: str) -> list[str]:
    """Requirements `name==version` of a set, for this Python."""
    return applicable(layout.read(layout.REQUIREMENTS / f"{name}.txt"))


def system_distributions(python: str) -> set[str]:
    """Names of the packages that a Python, with the installed ROS, has already.

    :param python: the interpreter.
    """
    command = [python, "-c", PROBE]
    return set(subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True).stdout.split())


def check_system_packages(extras: set[str]) -> None:
    """Beside an installed ROS, NumPy and what is built on it come from the system: its messages are built with it.

    :param extras: sets of requirements beyond those of every machine.
    :raises SetupError: with the packages that are missing.
    """
    if not layout.has_ros_installation():
        return
    present = system_distributions(layout.base_python())
    names = {line.split("==")[0] for part in required_sets(extras) for line in pinned(part)}
    needed = [package for name, package in SYSTEM_PACKAGES.items() if name in names - present]
    if needed:
        raise SetupError(f"missing beside ROS 2 Jazzy: sudo apt install {' '.join(needed)}", code=2)


def applicable(text: str) -> list[str]:
    """Pinned requirements `name==version` of a file that hold for this Python."""
    lines = []
    for line in text.splitlines():
        requirement, _, marker = line.partition(";")
        holds = not marker or f'"{layout.python_version()}"' in marker
        if holds and requirement.strip() and not requirement.startswith("#"):
            lines.append(requirement.strip())
    return lines


def pip() -> list[str]:
    """Words that run the environment's pip."""
    return [str(layout.PYTHON), "-m", "pip", "--disable-pip-version-check", "--no-input"]


def fetch(current: Step, lines: list[str], environment: Mapping[str, str]) -> list[str]:
    """Fetch what the store lacks.

    :param lines: requirements `name==version`.
    :returns: options with which pip then installs: from the store alone, or from the index where there is no store.
    """
    options = ["--no-deps", "--progress-bar", "off"]
    store = wheel_store(environment)
    if store is None:
        return options
    options += ["--find-links", str(store)]
    remove_parts(store)
    lacking = [line for line in lines if not stored(store, line)]
    for start in range(0, len(lacking), BATCH):
        current.note = f"(fetching {start} of {len(lacking)})"
        current.show()
        batch = lacking[start : start + BATCH]
        # Other checkouts use the store as well: a wheel gets into it whole, in one go.
        with tempfile.TemporaryDirectory(prefix=PART, dir=store) as part:
            command = ["wheel", *options, "--no-cache-dir", "--wheel-dir", part]
            current.run([*pip(), *command, *batch], environment)
            for wheel in Path(part).glob("*.whl"):
                os.replace(wheel, store / wheel.name)
    current.note = ""
    return [*options, "--no-index"]


def remove_parts(store: Path) -> None:
    """Remove unfinished downloads that a kill left in the store."""
    for part in store.glob(f"{PART}*"):
        if time.time() - part.lstat().st_mtime > PART_AGE_S:
            shutil.rmtree(part, ignore_errors=True)


def wheel_store(environment: Mapping[str, str]) -> Path | None:
    """Directory of the wheels in pip's cache; None where pip has no cache that can be written."""
    command = [str(layout.PYTHON), "-m", "pip", "cache", "dir"]
    result = subprocess.run(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=dict(environment),
        check=False,
    )
    if result.returncode != 0 or not result.stdout.strip():
        return None
    store = Path(result.stdout.strip(), "dtsa-wheels")
    try:
        store.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return store if os.access(store, os.W_OK) else None


def stored(store: Path, requirement: str) -> bool:
    """Whether the store has a wheel of `name==version` that this Python can install."""
    name, _, version = requirement.partition("==")
    python = f"{sys.version_info[0]}{sys.version_info[1]}"
    distribution = re.sub(r"[-_.]+", "[-_.]+", name)
    tag = rf"(?:(?:\w+\.)*py3(?:\.\w+)*|cp{python}|cp3\d+-abi3|py2\.py3|py3\d?)"
    pattern = re.compile(rf"{distribution}-{re.escape(version)}-(?:\d\w*-)?{tag}-.*\.whl", re.IGNORECASE)
    return any(pattern.fullmatch(entry) for entry in os.listdir(store))


def mend_cmake_files(environment: Mapping[str, str]) -> None:
    """See :mod:`machine.cmake_paths`."""
    show = [str(layout.PYTHON), "-I", "-S", "-c", "import sysconfig; print(sysconfig.get_path('include'))"]
    include = subprocess.run(show, stdout=subprocess.PIPE, text=True, env=dict(environment), check=True).stdout.strip()
    cmake_paths.mend(layout.VENV / "share", include, str(layout.site_packages() / "numpy" / "_core" / "include"))
