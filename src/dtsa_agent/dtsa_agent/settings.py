"""What the fields of the configuration dataclasses say about themselves: for ROS parameters and command lines alike."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import ConfigError, range_text

_KINDS = {"int": "int", "float": "float", "bool": "bool", "str": "text"}
_WORDS = {"int": "a whole number", "float": "a number", "bool": "true or false"}
_TRUE, _FALSE = ("true", "yes", "on", "1"), ("false", "no", "off", "0")


@dataclass(frozen=True, slots=True)
class Setting:
    """One field of a configuration."""

    name: str
    kind: str  # "int", "float", "bool", "text", "values" (pairs name=number) or "structure" (files only)
    default: Any
    help: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    optional: bool = False  # None is allowed: the value then follows from the other settings
    changeable: bool = False  # while the node runs

    @property
    def description(self) -> str:
        """The help text with the unit and the words allowed."""
        text = f"{self.help} ({self.unit})" if self.unit and self.unit != "1" else self.help
        return f"{text}: {', '.join(self.choices)}" if self.choices else text

    def parse(self, text: str) -> Any:
        """The value that a text means. Ranges are checked by the configuration itself.

        :param text: as the user typed it.
        :raises ConfigError: if it is of another kind.
        """
        if self.kind == "text":
            return text
        try:
            if self.kind == "int":
                return int(text)
            if self.kind == "float":
                return float(text)
            if self.kind == "values":
                return parse_values(text)
            if self.kind == "bool" and text.lower() in _TRUE + _FALSE:
                return text.lower() in _TRUE
        except ValueError:
            pass
        allowed = _WORDS.get(self.kind, "name=number, separated by commas")
        raise ConfigError(self.name, text, allowed + self._range())

    def _range(self) -> str:
        if self.minimum is None and self.maximum is None:
            return ""
        return ", " + range_text(self.minimum, self.maximum)


def settings_of(cls: type) -> tuple[Setting, ...]:
    """The settings of a configuration dataclass, in the order of its fields.

    :param cls: a dataclass whose fields carry metadata with ``help`` and, where there are, ``unit``, ``minimum``,
        ``maximum``, ``choices``, ``kind``, ``changeable``.
    """
    return tuple(_setting(spec) for spec in dataclasses.fields(cls) if spec.metadata)


def _setting(spec: dataclasses.Field[Any]) -> Setting:
    meta, type_name = spec.metadata, str(spec.type)
    base = type_name.split("|")[0].strip()
    kind = meta.get("kind") or _KINDS.get(base) or ("values" if base.startswith("Mapping") else "structure")
    default = None if spec.default is dataclasses.MISSING else spec.default
    if spec.default_factory is not dataclasses.MISSING:
        default = spec.default_factory()
    return Setting(
        spec.name,
        kind,
        default,
        meta["help"],
        meta.get("unit", ""),
        meta.get("minimum"),
        meta.get("maximum"),
        tuple(meta.get("choices") or ()),
        "None" in type_name,
        bool(meta.get("changeable")),
    )


def parse_values(text: str) -> dict[str, float]:
    """Reads ``name=number, name=number``.

    :raises ValueError: if it is not of this form.
    """
    result = {}
    for part in filter(None, (piece.strip() for piece in text.split(","))):
        name, equals, value = part.partition("=")
        if not equals or not name.strip():
            raise ValueError(part)
        result[name.strip()] = float(value)
    return result


def format_values(values: Mapping[str, float]) -> str:
    """The text that :func:`parse_values` reads back."""
    return ", ".join(f"{name}={value!r}" for name, value in values.items())
