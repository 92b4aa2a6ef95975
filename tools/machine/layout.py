"""Where things are, and which kind of machine this is."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent.parent
SOURCES = ROOT / "src"
REQUIREMENTS = ROOT / "requirements"
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
BUILD = ROOT / "build"
INSTALL = ROOT / "install"
COLCON_LOG = ROOT / "log"
STATE = ROOT / ".dtsa"
STEP_LOGS = STATE / "log"
VENV_STAMPS = VENV / ".dtsa"

DISTRIBUTION = "jazzy"
EXTRAS = {
    "cflib": "the bridge to Crazyflie quadcopters",
    "benchmark": "independent implementations to compare with",
    "cluster": "experiments on several machines",
    "test": "the test suite",
    "dev": "linting and type checks",
}


class SetupError(Exception):
    """The set-up cannot go on: one line for the user.

    :param message: what is wrong and what to do.
    :param code: exit code; 2 where the user has to change something, 1 where a step failed.
    """

    def __init__(self, message: str, code: int = 1) -> None:
        super().__init__(message)
        self.code = code


def has_ros_installation() -> bool:
    """Whether an installation of ROS 2 Jazzy (apt, conda) is sourced; the wheels are not used then."""
    return os.environ.get("ROS_DISTRO") == DISTRIBUTION


def base_python() -> str:
    """Interpreter outside of the virtual environment, with its environment's modules."""
    if has_ros_installation():
        return shutil.which("python3") or sys.executable
    return str(getattr(sys, "_base_executable", sys.executable))


def python_version() -> str:
    """Version of the interpreter, such as 3.12."""
    return f"{sys.version_info[0]}.{sys.version_info[1]}"


def site_packages() -> Path:
    """The virtual environment's directory of installed packages."""
    return VENV / "lib" / f"python{python_version()}" / "site-packages"


def digest(*parts: str | bytes) -> str:
    """Short digest of texts, for stamps."""
    whole = hashlib.sha256()
    for part in parts:
        data = part.encode() if isinstance(part, str) else part
        whole.update(len(data).to_bytes(8, "little") + data)
    return whole.hexdigest()[:20]


def read(path: Path) -> str:
    """Text of a small file, empty where there is none."""
    try:
        return path.read_text(encoding="utf-8")
    except (FileNotFoundError, NotADirectoryError):
        return ""


def write(path: Path, text: str) -> None:
    """Write a small file in one go, so that nobody reads half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.new")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)
