"""From a flight to the process that serves its page: records one way, orders the other, and nobody ever waits."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
import time
from asyncio import StreamReader
from collections.abc import Sequence
from contextlib import suppress
from itertools import accumulate
from typing import Any

from dtsa_agent.core.errors import DtsaError

from .moments import Gathered

BEGIN, MOMENT, END = 0, 1, 2  # kinds of records
HEAD = struct.Struct("<BI9I")  # kind, slot, bytes of text and of what is gathered of a moment
LONGEST = 64 << 20  # bytes of a record
_START_S = 30.0
_ORDERS_BYTES = 1 << 16  # of orders that wait; what sends more is not our page
_NICE = 10
OWN_GROUP: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"preexec_fn": os.setpgrp}


def record(kind: int, content: Any, slot: int = 0, parts: Sequence[bytes] = (b"",) * 8) -> bytes:
    """A record as it goes to the server.

    :param kind: BEGIN, MOMENT or END.
    :param content: what goes as JSON; of a moment, `Gathered.more`.
    :param slot: of a moment.
    :param parts: of a moment, the other fields of :class:`Gathered`.
    """
    text = json.dumps(content, separators=(",", ":")).encode()
    return b"".join((HEAD.pack(kind, slot, len(text), *map(len, parts)), text, *parts))


async def read_record(reader: StreamReader) -> tuple[int, Any]:
    """The next record: its kind, and its content; of a moment, a :class:`Gathered`.

    :param reader: the connection to the flight.
    :raises IncompleteReadError: if no more comes.
    :raises ValueError: if it is none.
    """
    kind, slot, *sizes = HEAD.unpack(await reader.readexactly(HEAD.size))
    if sum(sizes) > LONGEST:
        raise ValueError(f"a record of {sum(sizes)} bytes")
    data = await reader.readexactly(sum(sizes))
    ends = list(accumulate(sizes))
    text, *parts = [data[end - size : end] for size, end in zip(sizes, ends, strict=True)]
    content = json.loads(text)
    return kind, Gathered(slot, *parts, content) if kind == MOMENT else content


class ViewLink:
    """A server process, and the connection to it.

    What it cannot take at once waits as one record; what comes meanwhile is dropped and counted.

    :param port: where it listens; 0: any port that is free.
    :param control: whether the page may order something.
    :raises DtsaError: if it does not start.
    """

    def __init__(self, port: int = 0, control: bool = False) -> None:
        self.control = control
        self.dropped = 0
        self.gone = False  # whether the server has ended
        self._waiting = memoryview(b"")
        self._orders = b""
        self._socket, other = socket.socketpair()
        words = ["-m", "dtsa_bench.pages.view.child", "--fd", str(other.fileno()), "--port", str(port)]
        with other:
            self._process = subprocess.Popen(
                [sys.executable, *words, *(["--control"] if control else [])],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[other.fileno()],
                **OWN_GROUP,
            )
        try:
            self.url = self._hello()
        except BaseException:
            self.close()
            raise

    def _hello(self) -> str:
        """The address of the page, which the server tells first."""
        self._socket.settimeout(_START_S)
        data = b""
        with suppress(OSError):
            while not data.endswith(b"\n") and (part := self._socket.recv(4096)):
                data += part
        self._socket.setblocking(False)
        told = json.loads(data) if data.endswith(b"\n") else {}
        if "url" not in told:
            raise DtsaError(f"the view's server does not start: {told.get('error', 'it ended at once')}")
        return str(told["url"])

    def ready(self) -> bool:
        """Whether the server can take a record now."""
        return self._flush() and not self.gone

    def offer(self, data: bytes) -> bool:
        """Sends a record if the server can take it; whether it could."""
        if not self.ready():
            self.dropped += 1
            return False
        self._waiting = memoryview(data)
        self._flush()
        return True

    def _flush(self) -> bool:
        """Sends on what waits; whether nothing is left."""
        while self._waiting:
            try:
                sent = self._socket.send(self._waiting)
            except BlockingIOError:
                return False
            except OSError:  # the flight goes on without it
                self._waiting, self.gone = memoryview(b""), True
                return True
            self._waiting = self._waiting[sent:]
        return True

    def orders(self) -> list[Any]:
        """What the page has ordered since the last call, as decoded JSON."""
        with suppress(BlockingIOError, OSError):
            while len(self._orders) < _ORDERS_BYTES and (part := self._socket.recv(4096)):
                self._orders += part
        *lines, self._orders = self._orders.split(b"\n")
        found = []
        for line in lines:
            with suppress(ValueError):
                found.append(json.loads(line))
        return found

    def moment(self, gathered: Gathered) -> bool:
        """Offers what a moment is made of; whether it was taken."""
        one = gathered
        parts = (one.frames, one.at, one.place, one.chosen, one.digest, one.in_ap, one.sent_slot, one.estimate)
        return self.offer(record(MOMENT, one.more, one.slot, parts))

    def last(self, data: bytes, patience_s: float = 1.0) -> None:
        """Sends the last records; waits a moment for a server that is behind.

        :param data: records.
        :param patience_s: s, longest wait.
        """
        deadline = time.monotonic() + patience_s
        while not self._flush() and time.monotonic() < deadline:
            time.sleep(0.01)
        self.offer(data)
        while not self._flush() and time.monotonic() < deadline:
            time.sleep(0.01)

    @property
    def process_id(self) -> int:
        """Of the server."""
        return self._process.pid

    def alive(self) -> bool:
        """Whether the server runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """Ends the server."""
        self._socket.close()
        try:
            self._process.wait(3.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def give_way() -> None:
    """The server gives way to whatever flies on this machine."""
    with suppress(OSError):
        os.nice(_NICE)
