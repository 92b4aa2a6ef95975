"""Settings that describe themselves: validation, plain values, texts, ROS parameters and tables come from this.

A settings class is a frozen dataclass that inherits :class:`Settings` and whose fields are made with :func:`setting`.
Everything else asks :func:`settings_of`: command line, parameters of nodes, YAML files, bags, documentation.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from dtsa_agent.core.errors import SETTING_NAMES, ConfigError, range_text

#: The default of a setting that has none.
REQUIRED: Any = dataclasses.MISSING

_KIND_OF_TYPE = {"int": "int", "float": "float", "bool": "bool", "str": "text", "Vector": "vector"}
_NUMBERS = ("int", "float")
_WORDS = {
    "int": "a whole number", "float": "a number", "bool": "true or false", "text": "a text", "vector": "three numbers",
    "values": "name=number, separated by commas",
}  # fmt: skip
_NAME = re.compile(r"[A-Za-z0-9_.-]+")
_BOOLS = {**dict.fromkeys(("true", "yes", "on", "1"), True), **dict.fromkeys(("false", "no", "off", "0"), False)}

T = TypeVar("T", bound="Settings")


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting: all that is needed to check it, to ask for it and to explain it."""

    name: str  # of the dataclass's field
    kind: str  # int, float, bool, text; vector: three numbers; values: numbers by name; file: a path; structure: others
    default: Any  # value used when nothing is given; None if there is none
    help: str  # one line for the user
    unit: str = ""  # of the numbers; empty or "1": none
    minimum: float | None = None  # smallest number allowed
    maximum: float | None = None
    choices: tuple[Any, ...] = ()  # the values allowed; empty: any of the kind and the range
    open_choices: bool = False  # other words are allowed too: they name plug-ins
    required: bool = False  # there is no default
    optional: bool = False  # None is allowed: the value then follows from the other settings
    changeable: bool = False  # in flight
    custom: bool = False  # the settings class checks it itself
    section: type[Settings] | None = None  # the settings class of a nested section
    group: str = ""  # heading under which the documentation lists it, and those that follow

    @property
    def description(self) -> str:
        """The help text with the unit and the words allowed."""
        text = f"{self.help} ({self.unit})" if self.unit not in ("", "1") else self.help
        return f"{text}: {', '.join(map(str, self.choices))}" if self.choices else text

    @property
    def range(self) -> str:
        """The range in words; empty if there is none."""
        has_range = self.minimum is not None or self.maximum is not None
        return range_text(self.minimum, self.maximum, self.unit) if has_range else ""

    @property
    def allowed(self) -> str:
        """What may be given, in words."""
        if self.choices:
            return ", ".join(map(str, self.choices))
        words = _WORDS.get(self.kind, self.help)
        if self.custom or self.kind in ("file", "structure"):
            return self.help
        if self.kind == "vector" and self.unit:
            return f"{words}: x, y, z in {self.unit}"
        if self.kind not in _NUMBERS:
            return words
        if self.range:
            return self._number_range if self._is_bare else f"{words}, {self.range}"
        return f"{words}, {self.unit}" if self.unit else words

    @property
    def _is_bare(self) -> bool:
        return self.kind == "float" and self.unit in ("", "1")

    @property
    def _number_range(self) -> str:
        """The range; "0 to 1" of numbers without a unit would be read as two whole numbers."""
        return f"a number from {self.range}" if self._is_bare and self.minimum is not None else self.range

    def check(self, value: Any, name: str | None = None) -> Any:
        """The value as the configuration keeps it: whole numbers become floats where floats are meant.

        NumPy scalars are welcome, True is not a number. ``name``: how the user calls the setting, if not so itself.

        :raises ConfigError: if it has the wrong type or is out of range.
        """
        if value is None and self.optional:
            return None
        name = name or self.name
        if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
            value = value.item()
        if self.kind == "values":
            return _checked_values(value, name)
        if self.section and not isinstance(value, self.section):
            raise ConfigError(name, value, "names with values")
        if self.kind == "int" and isinstance(value, float) and value.is_integer():
            value = int(value)
        if not _IS_KIND.get(self.kind, lambda _: True)(value):
            raise ConfigError(name, value, self.allowed)
        if self.kind in _NUMBERS:
            low, high = (value if bound is None else bound for bound in (self.minimum, self.maximum))
            if not (_is_finite(value) and low <= value <= high):
                raise ConfigError(name, value, self._number_range or self.allowed)
        if self.choices and not self.open_choices and value not in self.choices:
            raise ConfigError(name, value, self.allowed)
        return _KEPT[self.kind](value) if self.kind in _KEPT else value

    def parse(self, text: str) -> Any:
        """The value that a text means. Its range is checked by the configuration itself."""
        try:
            return _READERS[self.kind](text)
        except (KeyError, ValueError):
            raise ConfigError(self.name, text, self.allowed) from None

    def read(self, text: str) -> Any:
        """The value that a text means, checked."""
        try:
            return self.check(self.parse(text))
        except ConfigError:
            raise ConfigError(self.name, text, self.allowed) from None


def setting(
    default: Any, help: str, unit: str = "", minimum: float | None = None, maximum: float | None = None, *,
    kind: str = "", choices: tuple[Any, ...] = (), **more: Any,
) -> Any:  # fmt: skip
    """A field of a settings class; without ``kind`` that of its annotation. ``more``: fields of :class:`Setting`."""
    metadata = {"setting": Setting("", kind, None, help, unit, minimum, maximum, choices, **more)}
    if isinstance(default, dict):
        return dataclasses.field(default_factory=dict, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def nested(section: type[Settings], help: str, group: str = "") -> Any:
    """A field that holds a section of settings, by default with that section's defaults."""
    metadata = {"setting": Setting("", "structure", None, help, section=section, group=group)}
    return dataclasses.field(default_factory=section, metadata=metadata)


_described: dict[type, tuple[Setting, ...]] = {}  # what settings_of has found, by class


def settings_of(cls: type) -> tuple[Setting, ...]:
    """The settings of a settings class, in the order of its fields."""
    if cls in _described:
        return _described[cls]
    result: list[Setting] = []
    for spec in dataclasses.fields(cls):
        own = spec.metadata.get("setting")
        if own is None:
            continue
        base = str(spec.type).split("|")[0].strip()
        kind = own.kind or _KIND_OF_TYPE.get(base) or ("values" if base.startswith("Mapping") else "structure")
        default = spec.default if spec.default_factory is dataclasses.MISSING else spec.default_factory()
        result.append(
            dataclasses.replace(
                own, name=spec.name, kind=kind, default=None if default is REQUIRED else default,
                required=default is REQUIRED, optional="None" in str(spec.type),
                group=own.group or (result[-1].group if result else ""),
            )
        )  # fmt: skip
    return _described.setdefault(cls, tuple(result))


class Settings:
    """Base of all settings classes.

    :raises ConfigError: at creation, naming the field, the value and what is allowed.
    """

    __slots__ = ()

    def __post_init__(self) -> None:
        check(self)

    def __repr__(self) -> str:
        """The settings that differ from their defaults, for classes whose dataclass leaves it to this one."""
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in self.not_default().items())})"

    def not_default(self) -> dict[str, Any]:
        """The settings that have no default, and those that differ from it."""
        values = ((spec, getattr(self, spec.name)) for spec in settings_of(type(self)))
        return {spec.name: value for spec, value in values if spec.required or value != spec.default}

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain values; :meth:`from_dict` reads them back."""
        return {spec.name: plain(getattr(self, spec.name)) for spec in settings_of(type(self))}

    @classmethod
    def from_dict(cls: type[T], values: Mapping[str, Any]) -> T:
        """Build settings from plain values by name; those that are left out keep their defaults.

        :raises ConfigError: for unknown names and values that are not allowed.
        """
        specs = {spec.name: spec for spec in settings_of(cls)}
        arguments = dict(names_with_values(values, "settings"))
        for name, value in arguments.items():
            if name not in specs:
                raise ConfigError(str(name), value, SETTING_NAMES + ", ".join(specs))
            section = specs[name].section
            if section and isinstance(value, Mapping):
                with named(name):
                    arguments[name] = section.from_dict(value)
        for spec in specs.values():
            if spec.required and spec.name not in arguments:
                raise ConfigError(spec.name, None, spec.allowed)
        return cls(**arguments)


def check(config: Any) -> None:
    """Check all settings of an object, in its ``__post_init__``, and store what :meth:`Setting.check` gives."""
    for spec in settings_of(type(config)):
        if not spec.custom:
            value = getattr(config, spec.name)
            checked = spec.check(value)
            if checked is not value:
                object.__setattr__(config, spec.name, checked)


@contextmanager
def named(prefix: str) -> Iterator[None]:
    """Errors of settings within are named with a prefix and a dot: where the settings stand, as ``robots.cf3``."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(f"{prefix}.{error.field}", error.value, error.allowed) from None


def names_with_values(value: object, name: str) -> Mapping[str, Any]:
    """The value, if it is a mapping; else a ConfigError."""
    if not isinstance(value, Mapping):
        raise ConfigError(name, value, "names with values")
    return value


def plain(value: Any) -> Any:
    """A value as JSON and YAML have it."""
    if isinstance(value, (str, int, float)) or value is None:
        return value
    if isinstance(value, Mapping):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [plain(item) for item in value]
    return value.to_dict() if hasattr(value, "to_dict") else value


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number that no float reaches
        return False


def _is_vector(value: Any) -> bool:
    is_triple = isinstance(value, (list, tuple)) and len(value) == 3
    return is_triple and all(_is_number(x) and _is_finite(x) for x in value)


_IS_KIND: dict[str, Callable[[Any], bool]] = {
    "int": lambda value: isinstance(value, int) and not isinstance(value, bool), "float": _is_number,
    "bool": lambda value: isinstance(value, bool), "text": lambda value: isinstance(value, str), "vector": _is_vector,
}  # fmt: skip
_KEPT: dict[str, Callable[[Any], Any]] = {"float": float, "int": int, "vector": lambda value: tuple(map(float, value))}


def _checked_values(value: object, name: str) -> dict[str, float]:
    values = names_with_values(value, name)
    for key, number in values.items():
        if not isinstance(key, str) or not _NAME.fullmatch(key):
            raise ConfigError(name, key, "names of letters, digits, dots, dashes and underscores")
        if not _is_number(number) or not _is_finite(number):
            raise ConfigError(f"{name}.{key}", number, "a number")
    return {key: float(number) for key, number in values.items()}


def parse_values(text: str) -> dict[str, float]:
    """Read ``name=number, name=number``; ValueError: it is not of this form."""
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


_READERS: dict[str, Callable[[str], Any]] = {
    "text": str, "file": str, "int": int, "float": float, "values": parse_values,
    "bool": lambda text: _BOOLS[text.lower()],
}  # fmt: skip
