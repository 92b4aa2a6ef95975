"""Reading YAML settings with errors that a user can act on."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dtsa_agent.core.errors import ConfigError


class _Loader(yaml.SafeLoader):
    """YAML with numbers as 1e-3, which PyYAML alone takes for text, and without doubled keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.value in seen:
                line = key_node.start_mark.line + 1
                raise ConfigError(str(key_node.value), f"line {line}", "every setting once in its mapping")
            seen.add(key_node.value)
        result: dict[Any, Any] = super().construct_mapping(node, deep)
        return result


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+"), list("-+0123456789")
)


def read_yaml(path: str | Path, name: str) -> Any:
    """What a YAML file holds.

    :param path: the file.
    :param name: what errors call it.
    :raises ConfigError: if it cannot be read or is not YAML.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise ConfigError(name, str(path), f"a readable YAML file ({reason})") from None
    try:
        return yaml.load(text, _Loader)  # a SafeLoader, see above
    except ConfigError:
        raise
    except (yaml.YAMLError, LookupError, RecursionError, TypeError, ValueError) as error:  # also of its constructors
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or next(iter(str(error).splitlines()), "syntax error")
        raise ConfigError(name, f"{path}{where}", f"valid YAML ({problem})") from None


def read_mapping(path: str | Path, section: str) -> dict[str, Any]:
    """The mapping in a YAML file, or the one under ``section`` where there is such a key.

    :param path: the file.
    :param section: name of the part of interest in a larger file.
    :raises ConfigError: if the file cannot be read, is not YAML, or holds no mapping.
    """
    content = read_yaml(path, f"{section} file")
    if isinstance(content, Mapping) and isinstance(content.get(section), Mapping):
        content = content[section]
    if content is None:
        content = {}
    if not isinstance(content, Mapping):
        raise ConfigError(f"{section} file", str(path), f"a mapping of settings, or one under the key {section!r}")
    return dict(content)
