"""A package to begin with: a policy of one's own, its test, and a sweep that sets it against the others."""

from __future__ import annotations

import keyword
import re
from pathlib import Path

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.registry import POLICIES

from ..batch.table import write_whole

_FILES = Path(__file__).resolve().parent / "files"
_ALLOWED = "letters, digits and hyphens, beginning with a letter, as in my-policy"


def write_package(name: str, directory: Path) -> list[Path]:
    """Writes the package.

    :param name: what the policy will be called: letters, digits and hyphens.
    :param directory: where the package goes; must not exist.
    :returns: its files.
    :raises ConfigError: for a name that cannot be used, and a directory that exists or cannot be made.
    """
    if not re.fullmatch(r"[a-z][a-z0-9]*(-[a-z0-9]+)*", name) or len(name) > 40 or keyword.iskeyword(name):
        raise ConfigError("NAME", name, _ALLOWED)
    if name in POLICIES.rows or name in POLICIES.plug_ins():
        taken = ", ".join((*POLICIES.rows, *sorted(POLICIES.plug_ins())))
        raise ConfigError("NAME", name, f"another name: {taken} exist")
    module = name.replace("-", "_")
    words = {
        "NAME": name,
        "MODULE": module,
        "CLASS": "".join(part.capitalize() for part in name.split("-")),
        "DIRECTORY": str(directory),
    }
    try:
        (directory / module).mkdir(parents=True)
    except OSError as error:
        reason = (
            "a directory that does not exist yet" if directory.exists() else f"one that can be made ({error.strerror})"
        )
        raise ConfigError("out", str(directory), reason) from error
    return [_write(source, directory, words) for source in sorted(_FILES.iterdir())]


def _write(source: Path, directory: Path, words: dict[str, str]) -> Path:
    text = source.read_text(encoding="utf-8")
    target = source.name.removesuffix(".in")
    for word, value in words.items():
        text, target = text.replace(f"@{word}@", value), target.replace(word, value)
    path = directory / words["MODULE"] / "__init__.py" if target == "policy.py" else directory / target
    write_whole(path, text)
    return path
