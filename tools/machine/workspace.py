"""Builds the colcon workspace: only the packages whose inputs changed.

The workspace is built with `--symlink-install`: a changed Python file needs no build at all. What does need
one are the messages, the C sources, and the files that say what is installed.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path

from machine import layout, wheels
from machine.layout import SetupError
from machine.progress import Step, step

PACKAGES = ("dtsa_msgs", "dtsa_agent", "dtsa_channel_sim", "dtsa_bench")
INSTALLED_FILES = {"package.xml", "setup.py", "setup.cfg", "CMakeLists.txt"}
INSTALLED_DIRECTORIES = ("resource", "launch", "config", "msg", "srv", "action")
COMPILED_SUFFIXES = (".c", ".h")
PREFIX_PATHS = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH")
JOBS = re.compile(r"(?:^|\s)(?:-?j|--jobs\b)")  # in MAKEFLAGS
SETTINGS = "symlink-install ninja 1"  # changes when the way to build changes


def inputs(package: str) -> Iterator[Path]:
    """Files of a package that need a build when they change."""
    root = layout.SOURCES / package
    for entry in os.scandir(root):
        if entry.name in INSTALLED_FILES:
            yield Path(entry.path)
        elif entry.name in INSTALLED_DIRECTORIES and entry.is_dir():
            yield from (Path(file.path) for file in os.scandir(entry.path) if file.is_file())
        elif entry.name == package:
            for directory, directories, files in os.walk(entry.path):
                directories[:] = [name for name in directories if name != "__pycache__"]
                yield from (Path(directory, name) for name in files if name.endswith(COMPILED_SUFFIXES))


def stamp_file(package: str) -> Path:
    return layout.INSTALL / package / ".dtsa.json"


def build_key() -> str:
    """Changes when everything has to be built anew: other tools, other place, other kind of machine."""
    tools = {"system": "system", "wheels": wheels.set_key("ros"), "none": wheels.set_key("build")}[layout.kind()]
    return layout.digest(SETTINGS, wheels.venv_key(), tools)


def signature(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_mtime_ns, status.st_size]


def is_built(package: str) -> bool:
    """Whether a package is built from the files that are there now."""
    text = layout.read(stamp_file(package))
    if not text or not products(package):
        return False
    stamp = json.loads(text)
    known: dict[str, list[object]] = stamp["files"]
    files = {str(path.relative_to(layout.ROOT)): path for path in inputs(package)}
    if stamp["key"] != build_key() or set(files) != set(known):
        return False
    for name, path in files.items():
        *times, content = known[name]
        if signature(path) != times and layout.digest(path.read_bytes()) != content:
            return False
    return True


def products(package: str) -> bool:
    """Whether what the build made is still there, and made by us and not by a plain `colcon build`."""
    installed = layout.INSTALL / package
    if layout.kind() == "none":
        return package != "dtsa_agent" or all(made.exists() for made in compiled())
    if not (layout.BUILD / package).is_dir() or not (installed / "share" / package / "package.sh").exists():
        return False
    if package == "dtsa_msgs":
        return True
    if package == "dtsa_agent" and not all(made.exists() for made in compiled()):
        return False
    return any((installed / "lib").glob("python*/site-packages/*.egg-link"))


def stamp(package: str) -> None:
    """Remember what a package was built from."""
    files = {
        str(path.relative_to(layout.ROOT)): [*signature(path), layout.digest(path.read_bytes())]
        for path in inputs(package)
    }
    layout.write(stamp_file(package), json.dumps({"key": build_key(), "files": files}))


def disown(packages: Iterable[str]) -> None:
    """Forget what packages were built from, before anything of them changes."""
    for package in packages:
        stamp_file(package).unlink(missing_ok=True)


def changed_packages() -> list[str]:
    """Packages that have to be built, in order; messages have no use without ROS."""
    wanted = PACKAGES[1:] if layout.kind() == "none" else PACKAGES
    return [package for package in wanted if not is_built(package)]


def build_environment() -> dict[str, str]:
    """Environment of `colcon build`."""
    environment = wheels.clean_environment()
    # Without a number of jobs colcon adds a limit of the load (`-j2 -l2`): ninja then stands still for as long as
    # others keep the machine busy.
    jobs = len(os.sched_getaffinity(0))
    if not JOBS.search(environment.get("MAKEFLAGS", "")):
        environment["MAKEFLAGS"] = f"{environment.get('MAKEFLAGS', '')} -j{jobs}".strip()
    environment.setdefault("CMAKE_BUILD_PARALLEL_LEVEL", str(jobs))
    if layout.has_ros_installation():
        if "PYTHONPATH" in os.environ:
            environment["PYTHONPATH"] = os.environ["PYTHONPATH"]
        return environment
    for name in ("CMAKE_PREFIX_PATH", "AMENT_PREFIX_PATH"):
        environment[name] = str(layout.VENV)
    environment.pop("COLCON_PREFIX_PATH", None)
    environment["VIRTUAL_ENV"] = str(layout.VENV)
    environment["PATH"] = f"{layout.VENV / 'bin'}{os.pathsep}{environment.get('PATH', os.defpath)}"
    return environment


def colcon() -> str:
    """The build tool.

    :raises SetupError: where an installed ROS lacks it.
    """
    if not layout.has_ros_installation():
        return str(layout.VENV / "bin" / "colcon")
    found = shutil.which("colcon")
    if found is None:
        raise SetupError("missing: colcon; on Ubuntu: sudo apt install python3-colcon-common-extensions", code=2)
    return found


def build(packages: list[str]) -> None:
    """Build packages; what another kind of build left behind is removed first.

    :param packages: names, in order.
    """
    with step("build", f"workspace: {', '.join(packages)}") as current:
        for package in packages:
            text = layout.read(stamp_file(package))
            if not text or json.loads(text)["key"] != build_key() or not products(package):
                shutil.rmtree(layout.BUILD / package, ignore_errors=True)
                shutil.rmtree(layout.INSTALL / package, ignore_errors=True)
                if package == "dtsa_agent":
                    remove_kernel()
        disown(packages)  # after an interruption they are built from the beginning: half a library looks like a new one
        remove_kernel("cpython-*.so")  # made for one Python: Python looks for these first
        (layout.INSTALL / ".dtsa-environment.json").unlink(missing_ok=True)
        if layout.kind() == "none":
            for package in packages:
                build_in_place(current, package)
            return
        arguments = ["--base-paths", str(layout.SOURCES), "--symlink-install", "--packages-select", *packages]
        arguments += ["--build-base", str(layout.BUILD), "--install-base", str(layout.INSTALL)]
        arguments += ["--event-handlers", "console_cohesion+"]
        cmake = ["--cmake-args", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release"]
        if not layout.has_ros_installation():
            cmake += ["-GNinja", f"-DPython3_EXECUTABLE={layout.PYTHON}"]
        current.run([colcon(), "--log-base", str(layout.COLCON_LOG), "build", *arguments, *cmake], build_environment())
        for package in packages:
            stamp(package)


def build_in_place(current: Step, package: str) -> None:
    """Builds a package as colcon does with `--symlink-install`, without what ROS would need of it.

    :param current: the step.
    :param package: its name.
    """
    where = layout.BUILD / package
    layout.write(where / "setup.cfg", f"[build]\nbuild_base = {where}\n")  # else in the sources
    develop = "import os, runpy, sys; os.chdir(sys.argv.pop(1)); runpy.run_path('setup.py')"
    words = [str(layout.PYTHON), "-c", develop, str(layout.SOURCES / package), "develop", "--no-deps"]
    current.run(words, build_environment() | {"DIST_EXTRA_CONFIG": str(where / "setup.cfg")})
    stamp(package)


def kernel() -> Path:
    """The compiled kernel, the same for every Python; `--symlink-install` puts it into the source tree."""
    return layout.SOURCES / "dtsa_agent" / "dtsa_agent" / "core" / "_kernel.abi3.so"


def compiled() -> list[Path]:
    """All that is compiled: the kernel, what agents on a network hear, what the middleware's waits need."""
    package = layout.SOURCES / "dtsa_agent" / "dtsa_agent"
    return [
        kernel(),
        package / "air" / "_hearing.abi3.so",
        package / "air" / "_queue.abi3.so",
        package / "air" / "udp" / "_socket.abi3.so",
        package / "ros" / "common" / "workarounds" / "_endless.abi3.so",
    ]


def remove_kernel(ending: str = "*.so") -> None:
    """Remove what is compiled from the source tree.

    :param ending: pattern of what follows the modules' names.
    """
    for path in compiled():
        for made in path.parent.glob(f"{path.name.partition('.')[0]}.{ending}"):
            made.unlink(missing_ok=True)


def environment() -> dict[str, str]:
    """Environment in which everything runs: the workspace, ROS, the packages of the virtual environment."""
    cache = layout.INSTALL / ".dtsa-environment.json"
    text = layout.read(cache)
    if text:
        stored: dict[str, str] = json.loads(text)
    else:
        stored = capture()
        layout.write(cache, json.dumps(stored))
    result = dict(os.environ)
    # Beside the wheels nothing of another installation of ROS may stay in the search paths.
    dropped = set() if layout.has_ros_installation() else set(PREFIX_PATHS)
    if dropped and "ROS_DISTRO" in os.environ:
        dropped |= {"LD_LIBRARY_PATH", "PYTHONPATH"}
    for name, value in stored.items():
        before = "" if name in dropped else os.environ.get(name, "")
        parts = dict.fromkeys(part for part in (value + os.pathsep + before).split(os.pathsep) if part)
        result[name] = os.pathsep.join(parts)
    result.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    if not layout.has_ros_installation():
        result["VIRTUAL_ENV"] = str(layout.VENV)
        # What the wheels' start-up hook does by starting every interpreter twice.
        result["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"
    return result


def capture() -> dict[str, str]:
    """Source the workspace once and keep the search paths that it adds."""
    if layout.kind() == "none":
        return {"PATH": str(layout.VENV / "bin")}
    script = '. "$1" && python3 -I -S -c "import json, os; print(json.dumps(dict(os.environ)))"'
    bare = {"PATH": f"{layout.VENV / 'bin'}:/usr/bin:/bin", "HOME": os.environ.get("HOME", "/")}
    setup = layout.INSTALL / "local_setup.bash"
    command = ["bash", "-c", script, "bash", str(setup)]
    result = subprocess.run(command, env=bare, stdout=subprocess.PIPE, check=False)
    if result.returncode != 0:
        raise SetupError(f"{setup} cannot be sourced; build again after: tools/dtsa clean")
    sourced = json.loads(result.stdout.splitlines()[-1])
    added = {
        name: sourced.get(name, "").split(os.pathsep)
        for name in (*PREFIX_PATHS, "LD_LIBRARY_PATH", "PATH", "PYTHONPATH")
    }
    added["PATH"] = [part for part in added["PATH"] if str(layout.ROOT) in part]
    if layout.has_ros_installation():
        added["PYTHONPATH"].append(str(layout.site_packages()))
    else:
        libraries = sorted(layout.site_packages().glob("ros_*.libs"))
        added["LD_LIBRARY_PATH"] += [str(layout.VENV / "lib"), *map(str, libraries)]
        added["AMENT_PREFIX_PATH"].append(str(layout.VENV))
        added["CMAKE_PREFIX_PATH"].append(str(layout.VENV))
    return {name: os.pathsep.join(dict.fromkeys(filter(None, parts))) for name, parts in added.items()}
