"""Reads what the setting ``losses`` names: a file that `losses` has written, or a table that is replayed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dtsa_agent.core.errors import ConfigError

from .loss_record import pack
from .loss_table import read_table
from .measured import MeasuredLosses

_MOST_BYTES = 1 << 31


def losses_of(value: object, slot_ns: int) -> MeasuredLosses | str:
    """Return the losses that a setting means; empty text: none.

    :param value: path of a file, what :meth:`MeasuredLosses.to_dict` gives, or such losses.
    :param slot_ns: ns, length of a slot: in a table with times it tells the slots.
    :raises ConfigError: naming the part that is wrong.
    """
    if isinstance(value, MeasuredLosses):
        return value
    if isinstance(value, Mapping):
        return MeasuredLosses.from_dict(value)
    if isinstance(value, str | Path):
        return read_losses(Path(value), slot_ns) if str(value) else ""
    raise ConfigError("losses", value, "path of a file of losses (.json) or of a table of them (.csv)")


def read_losses(path: Path, slot_ns: int) -> MeasuredLosses:
    """Return the losses in a file: a table (.csv) is replayed, anything else has chains.

    :param path: the file.
    :param slot_ns: ns, length of a slot, for tables with times.
    :raises ConfigError: when it cannot be used.
    """
    import hashlib  # an agent in flight has the settings of channels in memory, and no need of hashes

    data = _bytes(path)
    digest = hashlib.sha256(data).hexdigest()
    if path.suffix.lower() == ".csv":
        table = read_table(path, slot_ns)
        record = pack(table.slots, table.senders, table.outcome)
        return MeasuredLosses(path.name, digest, table.agents, 0, record=record)
    try:
        content: Any = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ConfigError("losses", str(path), f"a file that `losses` has written: JSON ({error})") from None
    if not isinstance(content, Mapping):
        raise ConfigError("losses", str(path), "a file that `losses` has written: names with values")
    return MeasuredLosses.from_dict({**content, "name": path.name, "sha256": digest})


def _bytes(path: Path) -> bytes:
    try:
        if path.is_file() and path.stat().st_size > _MOST_BYTES:
            raise ConfigError("losses", str(path), f"a file of at most {_MOST_BYTES} bytes")
        return path.read_bytes()
    except OSError as error:
        raise ConfigError("losses", str(path), f"a file that can be read ({error.strerror})") from None
