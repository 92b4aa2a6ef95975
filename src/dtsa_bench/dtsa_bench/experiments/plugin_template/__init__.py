"""A package to begin with: a policy of one's own, its test, and a sweep that sets it against the others."""

from __future__ import annotations

import keyword
import re
import sys
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES
from dtsa_bench.runs.options import write_whole

_FILES = Path(__file__).resolve().parent / "files"
_ALLOWED = "letters, digits and hyphens, beginning with a letter, as in my-policy"


def write_package(name: str, directory: Path) -> list[Path]:
    """Write the package to a directory that does not exist yet; return its files.

    :raises ConfigError: for a name that cannot be used, and a directory that exists or cannot be made.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name) or len(name) > 40 or keyword.iskeyword(name):
        raise ConfigError("NAME", name, _ALLOWED)
    if name in POLICIES.rows or name in POLICIES.plug_ins():
        names = ", ".join((*POLICIES.rows, *sorted(POLICIES.plug_ins())))
        raise ConfigError("NAME", name, f"another name: {names} exist")
    module = name.replace("-", "_")
    _check_free(name, module)
    words = {
        "NAME": name,
        "MODULE": module,
        "CLASS": "".join(part.capitalize() for part in name.split("-")),
        "DIRECTORY": str(directory),
    }
    try:
        (directory / "src" / module).mkdir(parents=True)  # in src: the directory itself is no package of that name
    except OSError as error:
        reason = (
            "a directory that does not exist yet" if directory.exists() else f"one that can be made ({error.strerror})"
        )
        raise ConfigError("out", str(directory), reason) from error
    return [_write(source, directory, words) for source in sorted(_FILES.iterdir())]


def _check_free(name: str, module: str) -> None:
    """Raise ConfigError if the package would be in the way of another one."""
    if module in sys.stdlib_module_names:
        raise ConfigError("NAME", name, f"another name: {module} is a module of Python's own")
    for package in (module, f"dtsa_{module}"):
        spec = find_spec(package)
        if spec is not None and spec.origin is not None:  # a mere directory of that name has no origin
            raise ConfigError("NAME", name, f"another name: a module {package} is installed ({spec.origin})")
    try:
        distribution(f"dtsa-{name}")
    except PackageNotFoundError:
        return
    raise ConfigError("NAME", name, f"another name: a package dtsa-{name} is installed")


def _write(source: Path, directory: Path, words: dict[str, str]) -> Path:
    text = source.read_text(encoding="utf-8")
    target = source.name.removesuffix(".in")
    for word, value in words.items():
        text, target = text.replace(f"@{word}@", value), target.replace(word, value)
    path = directory / "src" / words["MODULE"] / "__init__.py" if target == "policy.py" else directory / target
    write_whole(path, text)
    return path
