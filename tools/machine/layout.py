"""Where things are, and which kind of machine this is."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import sys
from pathlib import Path

DISTRIBUTION = "jazzy"
EXTRAS = {
    "cflib": "the bridge to Crazyflie quadcopters",
    "benchmark": "independent implementations to compare with",
    "cluster": "experiments on several machines",
    "learning": "environments for learning",
    "test": "the test suite",
    "dev": "linting and type checks",
    "docs": "the documentation as a site",
    "release": "making the distribution",
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


def has_ros_wheels() -> bool:
    """Whether there are wheels of ROS for this machine; `DTSA_ROS=none`: they are not wanted."""
    here = platform.system(), platform.machine(), platform.libc_ver()[0]
    return here == ("Linux", "x86_64", "glibc") and os.environ.get("DTSA_ROS") != "none"


def kind() -> str:
    """Where ROS comes from: `system` (apt, conda), `wheels`, or `none`: commands that need it say so."""
    return "system" if has_ros_installation() else "wheels" if has_ros_wheels() else "none"


def suffix(root: Path) -> str:
    """Ending of the names of everything that is made for this kind of machine and this Python.

    The first kind in a checkout has plain names (`.venv`, `build`); an installed ROS has `-jazzy`, a machine without it
    `-no-ros`; another Python than the one that is there has its version added. No kind takes away what another uses.

    :param root: the checkout.
    """
    plain = {"system": f"-{DISTRIBUTION}", "wheels": "", "none": "-no-ros"}[kind()]
    made_for = owner(root / f".venv{plain}")
    return plain if made_for in ((), (python_version(),), (python_version(), kind())) else f"{plain}-{python_version()}"


def owner(venv: Path) -> tuple[str, ...]:
    """What a virtual environment was made for: version of Python and kind, as far as it is known.

    :param venv: its directory.
    :returns: nothing where there is none, or where its interpreter is gone.
    """
    if not (venv / "bin" / "python").exists():
        return ()
    stamped = read(venv / ".dtsa" / "venv").split()
    if len(stamped) >= 2:
        return stamped[0], stamped[1]
    fields = dict(
        (part.strip() for part in line.split("=", 1)) for line in read(venv / "pyvenv.cfg").splitlines() if "=" in line
    )
    version = fields.get("version", fields.get("version_info", ""))
    return (".".join(version.split(".")[:2]),) if version else ()


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


ROOT = Path(__file__).resolve().parent.parent.parent
SOURCES = ROOT / "src"
REQUIREMENTS = ROOT / "requirements"
SUFFIX = suffix(ROOT)
VENV = ROOT / f".venv{SUFFIX}"
PYTHON = VENV / "bin" / "python"
BUILD = ROOT / f"build{SUFFIX}"
INSTALL = ROOT / f"install{SUFFIX}"
COLCON_LOG = ROOT / f"log{SUFFIX}"
STATE = ROOT / ".dtsa"
STEP_LOGS = STATE / f"log{SUFFIX}"
VENV_STAMPS = VENV / ".dtsa"
