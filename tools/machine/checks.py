"""What the machine has to bring along; says which Debian package is missing."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import subprocess
import sysconfig
import tempfile
from pathlib import Path

from machine import layout
from machine.layout import SetupError

COMPILE = "#include <Python.h>\n#include <stdlib.h>\n"


def check() -> None:
    """Look at everything that the set-up needs from the system.

    :raises SetupError: with all that is missing, in one line.
    """
    missing: list[str] = []
    packages: list[str] = []
    version = layout.python_version()
    if not layout.has_ros_installation():
        check_platform()
    if any(character.isspace() for character in str(layout.ROOT)):
        raise SetupError(f"path: got {str(layout.ROOT)!r}; allowed: a checkout in a path without spaces", code=2)
    if importlib.util.find_spec("venv") is None or importlib.util.find_spec("ensurepip") is None:
        missing.append(f"the venv module of Python {version}")
        packages.append(f"python{version}-venv")
    for variable, names, language, package in (
        ("CC", ("cc", "gcc"), "C", "gcc"),
        ("CXX", ("c++", "g++"), "C++", "g++"),
    ):
        compiler = find_compiler(variable, names)
        if compiler is None:
            missing.append(f"a {language} compiler ({names[1]})")
            packages.append(package)
        elif language == "C" and (reason := try_compiler(compiler)):
            what, package = reason
            missing.append(what)
            packages.append(package)
    if missing:
        raise SetupError(
            f"missing: {', '.join(missing)}; on Debian and Ubuntu: sudo apt install {' '.join(packages)}",
            code=2,
        )


def check_platform() -> None:
    """Agents wait, and read arrival times, as Linux lets them; the packages exist for glibc.

    Wheels of ROS exist for x86_64 alone: elsewhere only the commands that need it say so.

    :raises SetupError: on other systems.
    """
    system, machine = platform.system(), platform.machine()
    libc = platform.libc_ver()[0]
    if system != "Linux" or libc != "glibc":
        raise SetupError(
            f"machine: got {system} {machine} {libc}; allowed: Linux with glibc, or any machine on "
            "which ROS 2 Jazzy is installed (apt or conda) and sourced: source /opt/ros/jazzy/setup.bash",
            code=2,
        )


def find_compiler(variable: str, names: tuple[str, ...]) -> list[str] | None:
    """Command of a compiler: what the environment variable says, or the first name that exists."""
    words = os.environ.get(variable, "").split()
    if words:
        return words if shutil.which(words[0]) else None
    return next(([name] for name in names if shutil.which(name)), None)


def try_compiler(compiler: list[str]) -> tuple[str, str] | None:
    """Compile a file that needs Python's and the C library's headers.

    :returns: None, or what is missing and the Debian package that has it.
    """
    include = sysconfig.get_path("include")
    if not Path(include, "Python.h").exists():
        return f"Python.h of Python {layout.python_version()}", f"python{layout.python_version()}-dev"
    with tempfile.TemporaryDirectory() as directory:
        source = Path(directory, "check.c")
        source.write_text(COMPILE)
        command = [*compiler, f"-I{include}", "-c", str(source), "-o", str(source.with_suffix(".o"))]
        result = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    if result.returncode == 0:
        return None
    if "stdlib.h" in result.stdout:
        return "the headers of the C library", "libc6-dev"
    reason = next((line for line in result.stdout.splitlines() if "error" in line), "no reason given")
    return f"a working C compiler ({compiler[0]}: {reason.strip()})", "build-essential"
