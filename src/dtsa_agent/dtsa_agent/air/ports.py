"""The kinds of port by name: what `--air NAME` and the parameter ``air`` of a node choose from."""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

from dtsa_agent.core.errors import ConfigError

from .port import DatagramPort, Listener, PortSettings


class _Kind(NamedTuple):
    """Where a kind of port is, below this package: only what is chosen is imported."""

    settings: str  # a Settings class, whose objects are PortSettings
    port: str  # made with these: a DatagramPort
    listener: str  # ... a Listener


_KINDS = {
    "udp": _Kind("udp.settings.UdpSettings", "udp.port.UdpPort", "udp.port.UdpPort"),
    "crazyradio": _Kind(
        "crazyradio.settings.CrazyradioSettings", "crazyradio.port.CrazyradioPort", "crazyradio.port.CrazyradioPort"
    ),
    "serial": _Kind("serial.settings.SerialSettings", "serial.port.SerialPort", "serial.port.SerialPort"),
}
AIRS = tuple(_KINDS)


def _load(path: str) -> Any:
    module, _, name = path.rpartition(".")
    return getattr(import_module(f"dtsa_agent.air.{module}"), name)


def settings_class(air: str) -> Any:
    """The settings class of a kind of port; its objects are :class:`.port.PortSettings`.

    :raises ConfigError: if there is none of this name.
    """
    if air not in _KINDS:
        raise ConfigError("air", air, ", ".join(AIRS))
    return _load(_KINDS[air].settings)


def make_settings(air: str, values: dict[str, Any]) -> PortSettings:
    """The settings of a port.

    :raises ConfigError: for a kind, a setting or a value that cannot be.
    """
    made: PortSettings = settings_class(air).from_dict(values)
    return made


def open_port(settings: PortSettings) -> DatagramPort:
    """The port of an agent.

    :raises ConfigError: if it cannot be used.
    """
    port: DatagramPort = _load(_KINDS[settings.properties.name].port)(settings)
    return port


def open_listener(settings: PortSettings) -> Listener:
    """What hears a swarm and sends nothing.

    :raises ConfigError: if it cannot be used.
    """
    listener: Listener = _load(_KINDS[settings.properties.name].listener)(settings)
    return listener
