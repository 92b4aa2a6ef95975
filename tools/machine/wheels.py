"""The virtual environment and the pinned packages in it.

Wheels are kept in pip's cache directory (`dtsa-wheels`), because pip's own cache is of no use without a
network: pip asks the index for the list of files first. With the directory filled, no step of the set-up
needs a network.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from machine import cmake_paths, layout, processes
from machine.layout import SetupError
from machine.progress import Step, step

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
    base = ["runtime"] if layout.has_ros_installation() else ["ros", "runtime"]
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


def make_venv() -> None:
    """Make the virtual environment; one without a stamp that fits this Python is taken over as it is.

    :raises SetupError: if the one that is there does not fit, and is in use.
    """
    with step("venv", f"virtual environment ({layout.VENV.name})") as current:
        environment = clean_environment()
        if not usable():
            processes.refuse_if_used([layout.VENV])
            command = [layout.base_python(), "-m", "venv", "--clear"]
            if layout.has_ros_installation():
                command.append("--system-site-packages")
            current.run([*command, layout.VENV], environment)
        layout.write(layout.VENV_STAMPS / "venv", venv_key())


def usable() -> bool:
    """Whether an environment without our stamp may be used: same Python, made at this place, with pip."""
    stamped = layout.VENV_STAMPS / "venv"
    if layout.has_ros_installation() or stamped.exists() or not layout.PYTHON.exists():
        return False
    pip = layout.VENV / "bin" / "pip"
    show = [str(layout.PYTHON), "-I", "-S", "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    result = subprocess.run(show, stdout=subprocess.PIPE, text=True, check=False)
    first_line = layout.read(pip).partition("\n")[0]
    return result.stdout.strip() == layout.python_version() and str(layout.VENV) in first_line


def install(names: list[str]) -> None:
    """Install sets of requirements as pinned, wheels first from the local store.

    :param names: the sets.
    """
    environment = clean_environment()
    present = system_distributions(str(layout.PYTHON)) if layout.has_ros_installation() else set()
    for name in names:
        lines = [line for line in pinned(name) if line.split("==")[0] not in present]
        if lines:
            with step(f"install-{name}", f"{len(lines)} packages of requirements/{name}.txt") as current:
                install_set(current, lines, environment)
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


def install_set(current: Step, lines: list[str], environment: Mapping[str, str]) -> None:
    """Fetch what the store lacks, then install from the store alone."""
    pip = [str(layout.PYTHON), "-m", "pip", "--disable-pip-version-check", "--no-input"]
    store = wheel_store(environment)
    if store is None:
        current.run([*pip, "install", "--no-deps", "--progress-bar", "off", *lines], environment)
        return
    options = ["--no-deps", "--progress-bar", "off", "--find-links", str(store)]
    lacking = [line for line in lines if not stored(store, line)]
    for start in range(0, len(lacking), BATCH):
        current.note = f"(fetching {start} of {len(lacking)})"
        current.show()
        batch = lacking[start : start + BATCH]
        # Other checkouts use the store as well: a wheel gets into it whole, in one go.
        with tempfile.TemporaryDirectory(prefix=".part-", dir=store) as part:
            fetch = ["wheel", *options, "--no-cache-dir", "--wheel-dir", part]
            current.run([*pip, *fetch, *batch], environment)
            for wheel in Path(part).glob("*.whl"):
                os.replace(wheel, store / wheel.name)
    current.note = ""
    current.run([*pip, "install", *options, "--no-index", *lines], environment)


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
