"""A bag that needs no ROS: MCAP with JSON messages, whose schemas are in the file."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import Any, TypeVar

from mcap.writer import CompressionType, Writer

from dtsa_bench import __version__
from dtsa_bench.recordings.bag.errors import BagError

_FLUSH_S = 0.5
_CHUNK = 1 << 18  # bytes
_encode = json.JSONEncoder(separators=(",", ":")).encode
AnyBag = TypeVar("AnyBag", bound="JsonBag")


def described(title: str, **fields: tuple[str, str]) -> dict[str, Any]:
    """The JSON schema of a message."""
    properties = {name: {"type": kind, "description": text} for name, (kind, text) in fields.items()}
    return {"title": title, "type": "object", "properties": properties}


class JsonBag:
    """One file being recorded. A context manager.

    When it cannot be written any more it keeps still, and ``failure`` says why: a full disk does not end a flight.

    :raises BagError: if the file cannot be made.
    """

    def __init__(self, path: Path, topics: Mapping[str, dict[str, Any]], name: str, about: Mapping[str, str]) -> None:
        self.path = path
        try:
            self._stream = path.open("xb")
            self._mcap = Writer(self._stream, chunk_size=_CHUNK, compression=CompressionType.ZSTD)
        except OSError as error:
            raise BagError(f"cannot record to {path}: {error.strerror or error}") from error
        self._mcap.start(profile="", library=f"dtsa {__version__}")
        self._mcap.add_metadata(name, {"version": __version__, **about})
        self._channels = {
            topic: self._mcap.register_channel(
                topic, "json", self._mcap.register_schema(schema["title"], "jsonschema", json.dumps(schema).encode())
            )
            for topic, schema in topics.items()
        }
        self._counts = dict.fromkeys(self._channels, 0)
        self._next_flush = monotonic() + _FLUSH_S
        self.failure = ""

    def write(self, topic: str, time_ns: int, values: Mapping[str, Any]) -> None:
        """Records a message."""
        self._counts[topic] += 1
        data = _encode(values).encode()
        at = max(0, time_ns)
        self._try(self._mcap.add_message, self._channels[topic], at, data, at, self._counts[topic])

    def flush_if_due(self) -> bool:
        """Twice a second: hands everything to the operating system; whether it did."""
        if monotonic() < self._next_flush:
            return False
        self._next_flush = monotonic() + _FLUSH_S
        self._try(self._mcap.flush)
        return True

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Records what is known at the end."""
        self._try(self._mcap.add_metadata, name, dict(values))

    def _try(self, act: Callable[..., object], *arguments: Any) -> None:
        """Writes, unless writing has failed before."""
        if self.failure:
            return
        try:
            act(*arguments)
        except OSError as error:
            self.failure = f"recording to {self.path} stopped: {error.strerror or error}"

    def __enter__(self: AnyBag) -> AnyBag:
        return self

    def __exit__(self, *unused: object) -> None:
        self._try(self._mcap.finish)
        self._try(self._stream.close)
