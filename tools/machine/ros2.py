"""A small stand-in for the `ros2` command, for machines with the wheels of ROS only.

It knows what a user of this workspace needs first: `run`, `pkg executables|list|prefix` and
`interface show|list`. Packages are looked up in the ament index (`share/ament_index/resource_index`), as the
real command does.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path

from machine.layout import SetupError

INDEX = Path("share", "ament_index", "resource_index")
USAGE = """usage: tools/dtsa ros2 run PACKAGE EXECUTABLE [ARGUMENTS]
       tools/dtsa ros2 pkg executables [PACKAGE]
       tools/dtsa ros2 pkg list | prefix PACKAGE
       tools/dtsa ros2 interface show PACKAGE/msg/NAME
       tools/dtsa ros2 interface list"""
BASIC = re.compile(r"^(bool|byte|char|u?int(8|16|32|64)|float(32|64)|w?string)$")


def packages(environment: Mapping[str, str], resource: str = "packages") -> dict[str, Path]:
    """Registered packages and their prefixes; the first prefix counts."""
    found: dict[str, Path] = {}
    for prefix in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        directory = Path(prefix, INDEX, resource)
        if prefix and directory.is_dir():
            for name in os.listdir(directory):
                found.setdefault(name, Path(prefix))
    return dict(sorted(found.items()))


def executables(package: str, environment: Mapping[str, str]) -> list[Path]:
    """Executables of a package: what lies in `lib/<package>` and may be executed.

    :raises SetupError: when there is no such package.
    """
    directory = prefix_of(package, environment) / "lib" / package
    if not directory.is_dir():
        return []
    files = (Path(folder, name) for folder, _, names in os.walk(directory) for name in names)
    return sorted(file for file in files if os.access(file, os.X_OK))


def prefix_of(package: str, environment: Mapping[str, str]) -> Path:
    """Prefix of a package.

    :raises SetupError: when there is no such package.
    """
    known = packages(environment)
    if package not in known:
        ours = [name for name in known if name.startswith("dtsa_")]
        raise SetupError(f"package: got {package!r}; allowed: {', '.join(ours)}, ... (ros2 pkg list)", code=2)
    return known[package]


def run(package: str, name: str, arguments: list[str], environment: Mapping[str, str]) -> int:
    """Replace this process by an executable of a package.

    :raises SetupError: when there is none of this name.
    """
    found = {path.name: path for path in executables(package, environment)}
    if name not in found:
        raise SetupError(f"executable: got {name!r}; allowed: {', '.join(found) or 'none in ' + package}", code=2)
    sys.stdout.flush()
    os.execve(found[name], [str(found[name]), *arguments], dict(environment))


def interfaces(environment: Mapping[str, str]) -> list[str]:
    """All messages, services and actions: `package/msg/Name`."""
    names = []
    for package, prefix in packages(environment, "rosidl_interfaces").items():
        for line in (prefix / INDEX / "rosidl_interfaces" / package).read_text().splitlines():
            if line.endswith((".msg", ".srv", ".action")):
                names.append(f"{package}/{line.rsplit('.', 1)[0]}")
    return sorted(names)


def show(name: str, environment: Mapping[str, str], indent: str = "") -> list[str]:
    """Text of an interface, with the fields of nested messages indented below.

    :param name: `package/msg/Name`, or `package/Name` for a message.
    :raises SetupError: when there is no such interface.
    """
    package, _, rest = name.partition("/")
    kind, _, short = rest.rpartition("/")
    kind = kind or "msg"
    file = packages(environment).get(package, Path("none")) / "share" / package / kind / f"{short}.{kind}"
    if not file.is_file():
        raise SetupError(f"interface: got {name!r}; allowed: one of ros2 interface list", code=2)
    lines = []
    for line in file.read_text(encoding="utf-8").splitlines():
        if indent and (not line.strip() or line.lstrip().startswith("#")):
            continue
        lines.append(indent + line)
        field = re.match(r"^([A-Za-z]\w*(?:/\w+)*)(?:\[[^]]*\])?\s+\w+", line)
        if field and not BASIC.match(field[1]):
            nested = field[1] if "/" in field[1] else f"{package}/{field[1]}"
            lines += show(nested, environment, indent + "\t")
    return lines


def main(arguments: list[str], environment: Mapping[str, str]) -> int:
    """Run one command of the stand-in.

    :param arguments: command line after `ros2`.
    :param environment: environment with `AMENT_PREFIX_PATH`.
    :returns: exit code.
    """
    lines: list[str]
    if arguments[:1] == ["run"] and len(arguments) >= 3 and not arguments[1].startswith("-"):
        return run(arguments[1], arguments[2], arguments[3:], environment)
    if arguments[:2] == ["pkg", "executables"] and len(arguments) <= 3:
        chosen = arguments[2:] or packages(environment)
        lines = [f"{package} {path.name}" for package in chosen for path in executables(package, environment)]
    elif arguments == ["pkg", "list"]:
        lines = list(packages(environment))
    elif arguments[:2] == ["pkg", "prefix"] and len(arguments) == 3:
        lines = [str(prefix_of(arguments[2], environment))]
    elif arguments == ["interface", "list"]:
        lines = interfaces(environment)
    elif arguments[:2] == ["interface", "show"] and len(arguments) == 3:
        lines = show(arguments[2], environment)
    elif not arguments or arguments[0] in ("-h", "--help"):
        lines = [USAGE]
    else:
        raise SetupError(
            f"ros2: got {' '.join(arguments)!r}; allowed without an installation of ROS 2 Jazzy: run PACKAGE "
            "EXECUTABLE, pkg executables|list|prefix, interface show|list",
            code=2,
        )
    print("\n".join(lines))
    return 0
