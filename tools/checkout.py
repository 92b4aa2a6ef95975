"""Sets a checkout up and starts its commands: `tools/dtsa`. Standard library only: runs before anything is installed.

uv makes the environment `.venv` from requirements.txt, aside, and renames it. `.venv/dtsa.json` says what is done; what
is not whole is made anew. An installed ROS is left alone: with it, plain `colcon build` makes the workspace.
"""

from __future__ import annotations

import ast
import fcntl
import hashlib
import importlib.util
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
LOGS = ROOT / ".dtsa"
VERSION = f"{sys.version_info[0]}.{sys.version_info[1]}"
VENV = ROOT / (f".venv-{VERSION}" if os.environ.get("DTSA_PYTHON") else ".venv")
HAS_ROS = (platform.system(), platform.machine(), platform.libc_ver()[0]) == ("Linux", "x86_64", "glibc")  # as wheels
EXTRAS = ("cflib", "cluster", "learning", "dev")
COMMANDS = {
    "setup": f"set the checkout up: [--extra {'|'.join(EXTRAS)}]... [--all]",
    "shell": "a shell with everything sourced; arguments go to bash: -c COMMAND",
    "test": "all tests, on several cores; arguments go to pytest: FILE, -k frame -x",
    "ros2": "a small ros2 command: run, node, topic, param, service, interface, bag",
    "clean": "remove what was compiled; --all: the virtual environments, too",
}
# A file's tests share what it flies. When a worker dies, pytest-xdist would give its files to a new one and lose some.
SIDE_BY_SIDE = ("--dist", "loadfile", "--no-loadscope-reorder", "--max-worker-restart", "0")
CMAKE_OPTIONS = ("-GNinja", "-DBUILD_TESTING=OFF", "-DCMAKE_BUILD_TYPE=Release", "-DDTSA_PYTHON_ONLY=ON")
# Paths of the machine that built them, in the wheels of ROS.
INCLUDE = re.compile(r'[^"\s;]+/(include/python3\.\d+|numpy/(?:_core|core)/include)(?=["\s;])')
OLDEST_UV = (0, 7)
FOREIGN = ("PYTHONPATH", "PYTHONHOME", "CMAKE_PREFIX_PATH", "COLCON_PREFIX_PATH", "LD_LIBRARY_PATH", "ROS_DISTRO")
UV_SETTINGS = {  # names of pip's settings, which uv does not read
    "index-url": "UV_DEFAULT_INDEX", "extra-index-url": "UV_INDEX", "find-links": "UV_FIND_LINKS",
    "cert": "SSL_CERT_FILE", "proxy": "ALL_PROXY", "trusted-host": "UV_INSECURE_HOST", "timeout": "UV_HTTP_TIMEOUT",
}  # fmt: skip
ERROR = re.compile(r"(?i)error\b|\b(fatal|failed|no space left|cannot|denied|no solution)\b")


class SetupError(Exception):
    """The set-up cannot go on: one line for the user; code 2 where the user has to change something."""

    def __init__(self, message: str, code: int = 2) -> None:
        super().__init__(message)
        self.code = code


def main(words: Sequence[str]) -> int:
    """Run one command; most replace this process."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ends the running step as Ctrl-C does
    try:
        return run_command(*(words or ["--help"]))
    except (SetupError, OSError) as error:
        text = f"{error.filename or ROOT}: {error.strerror}" if isinstance(error, OSError) else str(error)
        print(f"dtsa: error: {text}", file=sys.stderr)
        return error.code if isinstance(error, SetupError) else 2
    except KeyboardInterrupt:
        print("\ndtsa: interrupted", file=sys.stderr)
        return 130


def run_command(name: str, *rest: str) -> int:
    """Run a command of the checkout, or of the project, whose names can be read before anything is installed."""
    sys.path.insert(0, str(ROOT / "src/dtsa_bench"))
    from dtsa_dev.registry import COMMANDS as DEVELOPERS

    from dtsa_bench import __version__
    from dtsa_bench.commands.registry import COMMANDS as USERS
    from dtsa_bench.commands.registry import hint

    known = {**USERS, **DEVELOPERS, **COMMANDS}
    if name in ("-h", "--help", "help"):
        print("usage: tools/dtsa COMMAND [ARGUMENTS] | COMMAND --help | --version\n")
        print("\n".join(f"  {each:<16} {text}" for each, text in known.items()))
    elif name == "--version":
        print(f"dtsa {__version__}")
    elif name not in known:
        raise SetupError(f"command: got {name!r}; allowed: {', '.join(known)}{hint(name, list(known))}")
    elif name in COMMANDS and name != "ros2" and rest[:1] in (("-h",), ("--help",)):
        print(f"usage: tools/dtsa {name}: {COMMANDS[name]}")
    elif name == "setup":
        extras = " ".join(rest).replace("--extra=", "--extra ").replace("--extra ", "").split()
        if wrong := [extra for extra in extras if extra not in (*EXTRAS, "--all")]:
            raise SetupError(f"setup: got {wrong[0]!r}; allowed: --extra {'|'.join(EXTRAS)}, --all")
        prepare(set(EXTRAS if "--all" in extras else extras))
        print("dtsa: ready", file=sys.stderr)
    elif name == "clean":
        if not set(rest) <= {"--all"}:
            raise SetupError(f"clean: got {' '.join(rest)!r}; allowed: --all")
        with lock():
            for path in compiled():
                path.unlink()
            for path in (ROOT / each for each in ("build", "install", "log")):
                shutil.rmtree(path, ignore_errors=True)
            for path in ROOT.glob(".venv*") if rest else ():
                if (path / "dtsa.json").exists() or path.suffix in (".new", ".old"):  # others' are left alone
                    discard(path)
    elif name == "test":
        prepare(set(EXTRAS))
        os.chdir(ROOT)
        workers = min(len(os.sched_getaffinity(0)) + 1, 4)  # one more than cores: tests often wait
        start("python3", "-m", "pytest", *(rest or ("-n", str(workers), *SIDE_BY_SIDE)))
    else:
        prepare(set(EXTRAS) if name in DEVELOPERS else set())
        shell = ["bash"] if rest else ["bash", "--rcfile", f"{ROOT}/tools/bashrc"]
        start(*{"shell": shell, "ros2": ["ros2"]}.get(name, ["python3", "-m", "dtsa_dev", name]), *rest)
    return 0


def start(*words: str) -> None:
    """Replace this process by a program that finds the environment."""
    writable("XDG_CACHE_HOME", "~/.cache")
    writable("ROS_LOG_DIR", "~/.ros/log")
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ |= {
        "AMENT_PREFIX_PATH": str(VENV),
        "DTSA_PROGRAM": "tools/dtsa",
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, [VENV / "lib", *sorted(site_packages().glob("ros_*.libs"))])),
        "PATH": os.pathsep.join([f"{ROOT}/tools", f"{VENV}/bin", os.environ.get("PATH", os.defpath)]),
        "PYTHONSAFEPATH": "1",  # what lies in the current folder is no module
        "VIRTUAL_ENV": str(VENV),
    }
    print(end="", flush=True)
    os.execvp(words[0], words)


def prepare(extras: set[str]) -> None:
    """Bring the environment into the state that a command needs; extras that are there stay."""
    for name in FOREIGN:
        os.environ.pop(name, None)
    os.environ["_ROS_WHEELS_BOOTSTRAP_COMPLETE"] = "1"  # else the wheels start every interpreter twice
    if (done := state()).get("key") == keys()[0] and extras <= set(done["extras"]):
        return
    check_system()
    with lock():
        done = state()  # another process may have been at work
        extras |= set(done.get("extras", ()))
        place = VENV if done.get("whole") else VENV.with_name(f"{VENV.name}.new")
        writable("XDG_CACHE_HOME", "~/.cache")
        uv, python = find_uv(), place / "bin/python"
        if place != VENV:
            shutil.rmtree(place, ignore_errors=True)
            base = getattr(sys, "_base_executable", sys.executable)
            run("environment", f"{VENV.name}, Python {VERSION}", [uv, "venv", "--relocatable", "-p", base, place])
        note(place, set(done.get("extras", ())))  # what cannot be installed is not asked for again
        options = ["--group=build", *(["--group=ros"] if HAS_ROS else []), "-p", python]
        options += ["--group=dev" if name == "dev" else f"--extra={name}" for name in sorted(extras)]
        words = [uv, "pip", "install", "--require-hashes", "-r", "pyproject.toml", "-c", "requirements.txt", *options]
        both = ["sh", "-c", '"$@" --offline 2>/dev/null || "$@"', "sh"]  # what is in uv's cache needs no network
        run("packages", ", ".join(["packages", *sorted(extras)]), [*both, *words])
        correct_cmake_files(place)
        note(place, extras, whole=True)
        if place != VENV:
            discard(VENV)
            place.rename(VENV)
        steps: list[list[str | Path]] = []
        if HAS_ROS:
            messages = cached(f"messages-{keys()[1]}-{site_packages().parent.name}", build_messages)
            # Files that a process may use are replaced, not written into.
            steps = [["cp", "-r", "--remove-destination", f"{messages}/.", VENV]]
        for path in compiled():
            path.unlink()
        words = [uv, "pip", "install", "--no-deps", "--no-build-isolation", "--offline", "--reinstall", "-e", ROOT]
        run("package", "compiled modules, commands", *steps, [*words, "-p", VENV / "bin/python"])
        paths = [ROOT / "tools", *(ROOT / "src" / name for name in ("dtsa_agent", "dtsa_channel_sim", "dtsa_bench"))]
        (site_packages() / "dtsa_checkout.pth").write_text("\n".join(map(str, paths)) + "\n", encoding="utf-8")
        note(VENV, extras, whole=True, key=keys()[0])


def correct_cmake_files(place: Path) -> None:
    """Replace the include directories that the wheels of ROS bring along."""
    numpy = f"${{CMAKE_CURRENT_LIST_DIR}}/../../../{site_packages(place).relative_to(place)}/numpy/_core/include"
    for file in place.glob("share/*/cmake/*.cmake"):
        text = file.read_text(encoding="utf-8")
        right = INCLUDE.sub(lambda match: numpy if match[1][0] == "n" else sysconfig.get_path("include"), text)
        if right != text:
            file.unlink()  # a link into uv's cache
            file.write_text(right, encoding="utf-8")


def build_messages(place: Path) -> None:
    """Build dtsa_msgs with the type supports that rclpy needs."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)  # CMake cannot read lists of files below a path that is not ASCII
        for link, target in (("env", VENV), ("source", ROOT / "src/dtsa_msgs"), ("made", place.parent)):
            (work / link).symlink_to(target)
        environment = dict.fromkeys(("VIRTUAL_ENV", "AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"), f"{work}/env")
        environment["PATH"] = f"{work}/env/bin{os.pathsep}{os.environ['PATH']}"
        places = [f"-DPython3_EXECUTABLE={work}/env/bin/python", f"-DCMAKE_INSTALL_PREFIX={work}/made/{place.name}"]
        configure = ["cmake", "-S", work / "source", "-B", work / "build", *CMAKE_OPTIONS, *places]
        build = ["cmake", "--build", work / "build", "--target", "install"]
        run("messages", "messages (dtsa_msgs)", configure, build, environment=environment)


def keys() -> tuple[str, str]:
    """Digests of all that the environment is made of, names of compiled modules included, and of the messages."""

    def digest(*texts: str) -> str:
        return hashlib.sha256(repr(texts).encode()).hexdigest()[:20]

    def read(path: Path) -> str:
        return f"{path.name} {path.read_text(encoding='utf-8')}"

    walk = [Path(folder, name) for folder, _, names in os.walk(ROOT / "src") for name in names]
    paths = sorted(path for path in walk if "build" not in path.relative_to(ROOT).parts)
    sources = [read(path) for path in paths if path.suffix in (".c", ".h", ".cfg") or path.name == "setup.py"]
    messages = [read(path) for path in paths if path.suffix in (".msg", ".srv") or path.name == "CMakeLists.txt"]
    project, pins = (ROOT / "pyproject.toml").read_text(encoding="utf-8"), read(ROOT / "requirements.txt")
    of_messages = digest(*messages, *re.findall("(?m)^(?:ros-|empy|numpy).*", pins), *CMAKE_OPTIONS)
    parts = (str(ROOT), project.partition("\n[tool.ruff]")[0], pins, of_messages, *map(str, compiled()))
    tools = [read(Path(__file__)), read(ROOT / "tools/package/backend.py")]
    return digest(*parts, *sources, *tools), of_messages


def compiled() -> list[Path]:
    """The compiled modules beside the sources."""
    return sorted((ROOT / "src").rglob("*.abi3.so"))


def site_packages(place: Path = VENV) -> Path:
    """An environment's folder of packages."""
    return next(place.glob("lib/python3*/site-packages"))


def state() -> dict[str, Any]:
    """State of the set-up: extras, whether the packages are whole, and the digest of what all was made of."""
    with suppress(OSError, ValueError):
        if (VENV / "bin/python").exists():
            return dict(json.loads((VENV / "dtsa.json").read_text(encoding="utf-8")))
    return {}


def note(place: Path, extras: set[str], **done: Any) -> None:
    """Write what is done, in one go."""
    (place / "dtsa.json.new").write_text(json.dumps({"extras": sorted(extras), **done}), encoding="utf-8")
    os.replace(place / "dtsa.json.new", place / "dtsa.json")


def discard(path: Path) -> None:
    """Remove an environment, none of which is then left under its name."""
    old = path.with_name(f"{path.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    with suppress(FileNotFoundError):
        path.rename(old)
    shutil.rmtree(old, ignore_errors=True)


def check_system() -> None:
    """Name what is missing from the system before anything is touched."""
    compilers = [(os.environ.get(name) or default).split()[0] for name, default in (("CC", "cc"), ("CXX", "c++"))]
    needs = (
        (f"the venv module of Python {VERSION}", f"python{VERSION}-venv", importlib.util.find_spec("ensurepip")),
        ("a C compiler", "gcc", shutil.which(compilers[0])),
        ("a C++ compiler", "g++", shutil.which(compilers[1])),
        ("Python's headers", f"python{VERSION}-dev", Path(sysconfig.get_path("include"), "Python.h").exists()),
    )
    if missing := [(name, package) for name, package, is_there in needs if not is_there]:
        names, packages = zip(*missing, strict=True)
        raise SetupError(f"missing: {', '.join(names)}; on Debian and Ubuntu: sudo apt install {' '.join(packages)}")
    if VENV.exists() and not (VENV / "dtsa.json").exists():
        raise SetupError(f"{VENV} was not made by tools/dtsa; move it away, and run the same command again")


def find_uv() -> str:
    """Path of uv, installed or that of requirements.txt in the cache. It is told of pip's package index."""
    pip, program = [sys.executable, "-I", "-m", "pip"], shutil.which("uv") or ""
    version = subprocess.run(["sh", "-c", f"'{program}' --version"], capture_output=True, text=True, check=False).stdout
    if tuple(map(int, re.findall(r"\d+", version)[:2])) < OLDEST_UV:
        text = (ROOT / "requirements.txt").read_text(encoding="utf-8")
        pin = re.findall(r"(?m)^uv==\S+.*(?:\n +--hash.*)+", text)[0]

        def install(place: Path) -> None:
            (place.parent / "uv.txt").write_text(pin, encoding="utf-8")
            words = [place / "bin/python", "-m", "pip", "install", "--require-hashes", "-r", place.parent / "uv.txt"]
            run("uv", "uv", [sys.executable, "-m", "venv", place], words)

        home = cached(pin.split()[0].replace("==", "-"), install)
        pip, program = [f"{home}/bin/python", "-m", "pip"], f"{home}/bin/uv"
    settings = {"UV_INDEX_STRATEGY": "unsafe-best-match"}  # as pip's; hashes are checked
    listed = subprocess.run([*pip, "config", "list"], capture_output=True, text=True, check=False).stdout
    for line in sorted(listed.splitlines(), key=lambda line: line.startswith(":env:")):
        name, _, value = line.partition("=")
        if variable := UV_SETTINGS.get(name.rpartition(".")[2].removeprefix("default-")):
            settings[variable] = " ".join(ast.literal_eval(value).split())
    os.environ.update({**settings, **os.environ})
    return program


def cached(name: str, make: Callable[[Path], None]) -> Path:
    """Folder in the cache that checkouts share, made aside where it is missing."""
    whole = writable("XDG_CACHE_HOME", "~/.cache") / "dtsa" / name
    if not whole.exists():
        whole.parent.mkdir(exist_ok=True)
        with tempfile.TemporaryDirectory(dir=whole.parent) as part:
            make(Path(part, "made"))
            with suppress(OSError):  # another checkout was faster
                Path(part, "made").rename(whole)
    return whole


def writable(variable: str, default: str) -> Path:
    """Folder that a variable of the environment names; a temporary one, said once, where it cannot be made."""
    try:
        path = Path(os.environ.get(variable) or default).expanduser()
        path.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path).close()
    except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
        path = Path(tempfile.mkdtemp(prefix="dtsa-"))
        reason = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) else error
        print(f"dtsa: {reason}; {variable} is {path} instead", file=sys.stderr)
        os.environ[variable] = str(path)
    return path


@contextmanager
def lock() -> Iterator[None]:
    """One set-up at a time in this checkout. Processes that a killed one left hold the lock, too, until they end."""
    LOGS.mkdir(exist_ok=True)
    with (LOGS / "lock").open("w") as file:
        os.set_inheritable(file.fileno(), True)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            print("dtsa: waiting for another set-up of this checkout ...", file=sys.stderr)
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def run(name: str, title: str, *commands: Sequence[str | Path], environment: Mapping[str, str] | None = None) -> None:
    """Run the commands of a step: says what it does and for how long; their output goes into a log."""
    path, began = LOGS / f"{name}.log", time.monotonic()

    def show(text: str = "") -> None:
        line = f"dtsa: {title} ... {text}"[: shutil.get_terminal_size().columns - 1]
        print(line.rstrip(), file=sys.stderr, flush=True)

    def lines() -> list[str]:
        return path.read_bytes().decode(errors="replace").strip().split("\n")

    show()
    with path.open("wb") as log:
        for words in commands:
            process = subprocess.Popen(
                [str(word) for word in words], env={**os.environ, **(environment or {})}, cwd=ROOT, close_fds=False,
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
            try:
                while process.poll() is None:
                    with suppress(subprocess.TimeoutExpired):
                        process.wait(10.0)
                        break
                    show(f"{time.monotonic() - began:.0f} s: {lines()[-1]}")
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, signal.SIGTERM)
                    process.wait()
            if process.returncode:
                show("failed")
                found = [line for line in lines() if ERROR.search(line) and not line.lower().startswith("warning")]
                # What the system refused, as a full disk, comes last in uv's chain of causes.
                reason = min(found, key=lambda line: "(os error" not in line, default=lines()[-1]).strip()[-300:]
                raise SetupError(f"step '{name}' failed: {reason}; log: {path}", code=1)
    show(f"{time.monotonic() - began:.0f} s")
