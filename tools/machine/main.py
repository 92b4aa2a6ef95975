"""`tools/dtsa`: the commands that concern the machine; all others are passed on to `python -m dtsa_bench`."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path

from dtsa_dev.registry import COMMANDS as DEVELOPERS
from dtsa_dev.registry import NEEDS

from machine import layout, prepare, processes, wheels, workspace
from machine.layout import SetupError

OWN_COMMANDS = {
    "setup": "set the machine up; --extra NAME adds optional packages",
    "shell": "a shell with everything sourced; arguments go to bash",
    "test": "run the whole test suite; arguments go to pytest",
    "ros2": "the ros2 command, or a small stand-in: run, pkg, interface",
    "clean": "remove what the build made; --all: the virtual environment, too",
}
HELP = ("-h", "--help")
USAGE = {
    "shell": """usage: tools/dtsa shell [BASH ARGUMENTS]

Opens a shell in which the workspace is sourced; `tools/dtsa shell -c COMMAND` runs one command in it.""",
    "test": """usage: tools/dtsa test [PYTEST ARGUMENTS]

Installs what the tests need and runs them: all of them on several cores, or what pytest's arguments say.
  tools/dtsa test -k frame -x                        tests with `frame` in their names, until one fails
  tools/dtsa test -n 0                               all, one after the other
  tools/dtsa test src/dtsa_agent/test/core/test_frame.py  one file
  tools/dtsa shell -c 'python3 -m pytest --help'     pytest's own help""",
    "clean": """usage: tools/dtsa clean [--all]

Removes what the build made for this kind of machine and this Python; what processes use stays.
  --all   the virtual environment, too""",
}
# A file's tests share what it flies.
# When a worker dies, pytest-xdist would give its files to a new one, lose some of them, and wait for those for ever.
SIDE_BY_SIDE = ("--dist", "loadfile", "--no-loadscope-reorder", "--max-worker-restart", "0")
MOST_WORKERS = 4
TEST_EXTRAS = {"test", "dev", "docs", "release", "cflib", "benchmark", "cluster", "learning"}
BENCH = layout.SOURCES / "dtsa_bench"


def main(arguments: list[str]) -> int:
    """Run one command.

    :param arguments: command line without the program's name.
    :returns: exit code; most commands replace this process instead.
    """
    command, rest = (arguments[0], arguments[1:]) if arguments else ("--help", [])
    try:
        if command in (*HELP, "help"):
            print(help_text())
            return 0
        if command == "--version":
            print(f"dtsa {version()}")
            return 0
        if command in USAGE and rest[:1] and rest[0] in HELP:
            print(USAGE[command])
            return 0
        if command in OWN_COMMANDS:
            own = (run_setup, run_shell, run_test, run_ros2, run_clean)
            return dict(zip(OWN_COMMANDS, own, strict=True))[command](rest)
        known = bench_commands()
        if command not in known:
            words = [*known, *OWN_COMMANDS]
            raise SetupError(f"command: got {command!r}; allowed: {', '.join(words)}{_hint(command, words)}", code=2)
        prepare.prepare(set(NEEDS.get(command, ())))
        return start(python(), ["-m", module_of(command), command, *rest])
    except SetupError as error:
        print(f"dtsa: error: {error}", file=sys.stderr)
        return error.code
    except KeyboardInterrupt:
        print("\ndtsa: interrupted", file=sys.stderr)
        return 130


def bench_commands() -> dict[str, str]:
    """Commands of dtsa_bench and of a checkout, with what they do; nothing has to be installed for that."""
    sys.path.insert(0, str(BENCH))
    from dtsa_bench.commands.registry import COMMANDS  # type: ignore[import-not-found, unused-ignore]

    return {**COMMANDS, **DEVELOPERS}


def _hint(word: str, words: list[str]) -> str:
    """What may have been meant; nothing has to be installed for that."""
    from dtsa_bench.commands.registry import hint  # type: ignore[import-not-found, unused-ignore]

    return str(hint(word, words))


def version() -> str:
    """The project's version; nothing has to be installed for that."""
    sys.path.insert(0, str(BENCH))
    import dtsa_bench  # type: ignore[import-not-found, unused-ignore]

    return str(dtsa_bench.__version__)


def help_text() -> str:
    """Usage and all commands."""
    lines = ["usage: tools/dtsa COMMAND [ARGUMENTS] | --version        (tools/dtsa COMMAND --help says more)", ""]
    for title, commands in (("flights and experiments:", bench_commands()), ("machine:", OWN_COMMANDS)):
        lines += [title, *(f"  {name:<16} {text}" for name, text in commands.items()), ""]
    lines += [
        "The first command on a machine makes .venv, installs the pinned packages and builds the workspace;",
        "later ones rebuild only what changed. ROS 2 Jazzy from apt is used where ROS_DISTRO=jazzy is set,",
        "with an environment of its own (.venv-jazzy); so has another Python (.venv-3.12).",
    ]
    return "\n".join(lines)


def python() -> str:
    """Interpreter that the commands run with."""
    return layout.base_python() if layout.has_ros_installation() else str(layout.PYTHON)


def module_of(command: str) -> str:
    """The package that runs a command; completion knows all of a checkout's."""
    return "dtsa_dev" if command in (*DEVELOPERS, "completion") else "dtsa_bench"


def start(program: str, arguments: list[str]) -> int:
    """Replace this process by a program in the workspace's environment, in which `dtsa_dev` can be imported."""
    environment = workspace.environment()
    tools = str(layout.ROOT / "tools")
    environment["DTSA_PROGRAM"] = "tools/dtsa"
    environment["PYTHONPATH"] = os.pathsep.join([tools, *filter(None, [environment.get("PYTHONPATH", "")])])
    path = shutil.which(program, path=environment["PATH"])
    if path is None:
        raise SetupError(f"program: got {program!r}; allowed: a program in PATH", code=2)
    sys.stdout.flush()
    sys.stderr.flush()
    os.execve(path, [program, *arguments], environment)


def run_setup(arguments: list[str]) -> int:
    """`tools/dtsa setup [--extra NAME]... [--all]`."""
    extras: set[str] = set()
    words = iter(arguments)
    allowed = f"--extra {'|'.join(layout.EXTRAS)}, --all"
    for word in words:
        name = next(words, "") if word == "--extra" else word.removeprefix("--extra=")
        if word in HELP:
            print("usage: tools/dtsa setup [--extra NAME]... [--all]\n\nextras:")
            print("\n".join(f"  {name:<16} {text}" for name, text in layout.EXTRAS.items()))
            return 0
        if word == "--all":
            extras |= set(layout.EXTRAS)
        elif name in layout.EXTRAS and word.startswith("--extra"):
            extras.add(name)
        else:
            raise SetupError(f"setup: got {(name or word)!r}; allowed: {allowed}", code=2)
    prepare.prepare(extras)
    workspace.environment()
    print("dtsa: ready", file=sys.stderr)
    return 0


def run_test(arguments: list[str]) -> int:
    """`tools/dtsa test [PYTEST ARGUMENTS]`."""
    prepare.prepare(TEST_EXTRAS)
    os.chdir(layout.ROOT)
    return start(python(), ["-m", "pytest", *(arguments or ["-n", str(workers()), *SIDE_BY_SIDE])])


def workers() -> int:
    """Tests that run side by side when all are run: one more than there are cores, since tests often wait."""
    return min(len(os.sched_getaffinity(0)) + 1, MOST_WORKERS)


def run_shell(arguments: list[str]) -> int:
    """`tools/dtsa shell [BASH ARGUMENTS]`."""
    prepare.prepare(set())
    if arguments:
        return start("bash", arguments)
    start_file = layout.STATE / f"bashrc{layout.SUFFIX}"
    source = "" if layout.kind() == "none" else f". '{layout.INSTALL}/local_setup.bash'\n"
    unless = "command -v ros2 >/dev/null || " if layout.has_ros_installation() else ""
    layout.write(
        start_file,
        "[ -f ~/.bashrc ] && . ~/.bashrc\n"
        f"export PATH='{workspace.environment()['PATH']}'\n"
        f"{source}"
        f"dtsa() {{ '{layout.ROOT}/tools/dtsa' \"$@\"; }}\n"
        f"{unless}ros2() {{ '{layout.ROOT}/tools/dtsa' ros2 \"$@\"; }}\n"
        'PS1="(dtsa) ${PS1-}"\n',
    )
    return start("bash", ["--rcfile", str(start_file), "-i"])


def has_ros2(environment: Mapping[str, str]) -> bool:
    """Whether the real `ros2` is there.

    Beside the wheels, one in the path is of another distribution, and would not find its parts.
    """
    return layout.has_ros_installation() and shutil.which("ros2", path=environment["PATH"]) is not None


def run_ros2(arguments: list[str]) -> int:
    """`tools/dtsa ros2 ...`: the real command where it exists."""
    if layout.kind() == "none":
        raise SetupError("missing: ROS 2 Jazzy (apt or conda), sourced: source /opt/ros/jazzy/setup.bash", code=2)
    prepare.prepare(set())
    environment = workspace.environment()
    if has_ros2(environment):
        return start("ros2", arguments)
    from machine import ros2

    return ros2.main(arguments, environment)


def run_clean(arguments: list[str]) -> int:
    """`tools/dtsa clean [--all]`."""
    if not set(arguments) <= {"--all"}:
        raise SetupError(f"clean: got {' '.join(arguments)!r}; allowed: --all", code=2)
    directories: list[Path] = [layout.BUILD, layout.INSTALL, layout.COLCON_LOG]
    if arguments:
        directories.append(layout.VENV)
    with prepare.lock():
        processes.refuse_if_used(directories)
        workspace.disown(workspace.PACKAGES)
        if arguments:
            wheels.disown_venv()
        for directory in directories:
            shutil.rmtree(directory, ignore_errors=True)
        workspace.remove_kernel()
        if arguments:
            wheels.venv_begun().unlink()
    return 0
