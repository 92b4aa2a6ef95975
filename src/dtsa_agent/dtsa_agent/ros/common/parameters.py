"""ROS parameters made from the settings classes, and the swarm that a node belongs to."""

from __future__ import annotations

import dataclasses
import difflib
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import pairwise
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import InvalidNamespaceException
from rclpy.node import Node
from rclpy.validate_namespace import validate_namespace

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting, Settings, format_values, settings_of
from dtsa_agent.yaml_file import read_yaml

from . import names

_UNBOUNDED = 2.0**62
_NOTHING = -1  # stands for None in a parameter that may be left open


def descriptor(setting: Setting, read_only: bool) -> ParameterDescriptor:
    """Return the description that ``ros2 param describe`` shows; ``read_only``: fixed once the node runs."""
    result = ParameterDescriptor(description=setting.description, read_only=read_only)
    low = -_UNBOUNDED if setting.minimum is None else setting.minimum
    high = _UNBOUNDED if setting.maximum is None else setting.maximum
    if setting.optional:
        low = _NOTHING
        result.description += f"; {_NOTHING}: the default"
    if setting.kind == "int":
        result.integer_range = [IntegerRange(from_value=int(low), to_value=min(int(high), 2**63 - 1), step=0)]
    elif setting.kind == "float":
        result.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)]
    elif setting.kind == "vector":
        result.additional_constraints = setting.allowed
    elif setting.choices:
        result.additional_constraints = "one of: " + ", ".join(setting.choices)
    result.dynamic_typing = setting.kind in ("float", "vector")  # `-p slot_ms:=10` shall do as well as 10.0
    return result


def declare_settings(
    node: Node, cls: type[Settings], skip: Iterable[str] = (), changeable: bool = False,
    defaults: Mapping[str, Any] | None = None, prefix: str = "",
) -> dict[str, Any]:  # fmt: skip
    """Declare a parameter for every setting of a class; return the values that the node was started with, by name.

    :param skip: fields that become no parameter.
    :param changeable: settings that say so may be changed while the node runs; all others are read-only.
    :param defaults: values that replace the settings' defaults.
    :param prefix: stands before the settings' names in the parameters'.
    :raises ConfigError: for a value of the wrong type or out of range.
    """
    values: dict[str, Any] = {}
    for setting in settings_of(cls):
        if setting.kind == "structure" or setting.name in skip:
            continue
        own = dataclasses.replace(setting, default=(defaults or {}).get(setting.name, setting.default))
        values[setting.name] = declare_setting(node, own, prefix, not (changeable and setting.changeable))
    return values


def declare_setting(node: Node, setting: Setting, prefix: str = "", read_only: bool = True) -> Any:
    """Declare one parameter; as :func:`declare_settings`."""
    name = prefix + setting.name
    default = _NOTHING if setting.default is None else to_parameter(setting, setting.default)
    value = _declare(node, name, default, descriptor(setting, read_only), setting.allowed)
    return from_parameter(setting, value)


def declare_list(node: Node, name: str, default: list[Any], description: str) -> list[Any]:
    """Declare a parameter that is a list of numbers of its default's kind; return its value, or raise as above."""
    kind = "whole numbers" if isinstance(default[0], int) else "numbers with a decimal point"
    info = ParameterDescriptor(description=description, read_only=True)
    return list(_declare(node, name, default, info, f"a list of {kind}, as {default}"))


def _declare(node: Node, name: str, default: Any, info: ParameterDescriptor, allowed: str) -> Any:
    try:
        return node.declare_parameter(name, default, info).value
    except Exception as error:  # rclpy has no common base for wrong types and values out of range
        given = node._parameter_overrides.get(name)
        raise ConfigError(name, default if given is None else given.value, allowed) from error


def check_parameters(node: Node) -> None:
    """Check that the node has all parameters that it was given; called when it has declared them.

    ConfigError: one on the command line is none of its. One in a file may be meant for other nodes: it is only warned
    of, as is a file with nothing for this node.
    """
    given, logger = node._parameter_overrides, node.get_logger()
    known = list(node.get_parameters_by_prefix(""))
    options = list(pairwise(sys.argv))
    typed = {word.partition(":=")[0].rpartition(":")[2] for option, word in options if option in ("-p", "--param")}
    for name in sorted(given.keys() - set(known)):
        if name.startswith("qos_overrides."):
            continue
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
        hint = f"; did you mean {near[0]}?" if near else ""
        if name in typed:
            raise ConfigError(name, given[name].value, f"a parameter of this node{hint}")
        logger.warning(f"parameter {name}: this node has none of this name{hint}")
    for path in [word for option, word in options if option == "--params-file"]:
        with suppress(ConfigError):  # rclpy has said what is wrong with it
            sections = dict(_sections(read_yaml(path, "parameters")))
            names = {name for section in sections.values() for name in section}
            if names and not any(full.partition(".")[0] in names or full in names for full in given):
                logger.warning(f"{path}: nothing in it is for this node; it is for {', '.join(sections)}")


def _sections(content: Any, place: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Give the parts of a file of parameters, by the nodes that they are for."""
    for name, value in content.items() if isinstance(content, Mapping) else ():
        if name == "ros__parameters":
            yield place, value if isinstance(value, Mapping) else {}
        else:
            yield from _sections(value, f"{place}/{str(name).strip('/')}")


def from_parameter(setting: Setting, value: Any) -> Any:
    """Return the setting's value from that of its parameter; ConfigError: it is none."""
    if setting.optional and value == _NOTHING:
        return None
    if setting.kind == "values":
        return setting.parse(value)
    if setting.kind == "vector":
        return tuple(value) if isinstance(value, Iterable) else value
    if setting.kind == "float" and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value


def to_parameter(setting: Setting, value: Any) -> Any:
    """Return the value of the parameter that stands for a setting's value; the inverse of :func:`from_parameter`."""
    if setting.kind == "values" and isinstance(value, Mapping):
        return format_values(value)
    return list(value) if setting.kind == "vector" else value


def to_parameters(values: Mapping[str, Any], cls: type[Settings]) -> dict[str, Any]:
    """Return parameters that make a node read back settings, given as the class's ``to_dict`` gives them."""
    return {
        setting.name: to_parameter(setting, values[setting.name])
        for setting in settings_of(cls)
        if setting.kind != "structure" and values.get(setting.name) is not None
    }


def declare_swarm_namespace(node: Node) -> str:
    """Declare the parameter ``swarm_namespace`` and return its value; ConfigError: it is no namespace.

    Default is the namespace that the node was started in, without the agent's own part: a node in ``/north`` or in
    ``/north/cf3`` belongs to swarm ``/north``, one in ``/swarm`` or ``/cf3`` to ``/swarm``.
    """
    default = re.sub(r"/cf\d+$|/$", "", node.get_namespace()) or names.SWARM
    text = "namespace of what the whole swarm shares; default: the node's own, without the agent's part"
    setting = Setting("swarm_namespace", "text", default, text)
    value = declare_setting(node, setting)
    space = "/" + value.strip("/")
    try:
        validate_namespace(space)
    except InvalidNamespaceException as error:
        raise ConfigError(setting.name, value, "a namespace as /north") from error
    return names.SWARM if space == "/" else space


def swarm_wide_node(name: str, options: Mapping[str, Any] | None = None) -> tuple[Node, str]:
    """Return a node that belongs to a whole swarm, made with further options for ``Node``, and the swarm's namespace.

    ConfigError: the parameter ``swarm_namespace`` is no namespace.
    """
    node = Node(name, namespace=names.SWARM, **(options or {}))
    try:
        space = declare_swarm_namespace(node)
        if space != node.get_namespace() == names.SWARM:  # the parameter names it, not the command line
            node.destroy_node()
            node = Node(name, namespace=space, **(options or {}))
            declare_swarm_namespace(node)
    except BaseException:
        node.destroy_node()
        raise
    return node, space
