"""The process that serves the page of a flight; it ends when the flight lets go of it."""

from __future__ import annotations

import argparse
import asyncio
import json
import socket
import sys
from collections.abc import Sequence
from contextlib import suppress

from dtsa_agent.core.errors import DtsaError

from .link import BEGIN, END, MOMENT, give_way, read_record
from .moments import told
from .orders import Order
from .server import ViewServer, new_token
from .track import Track

_BUFFER = 1 << 20  # bytes that have come and are not taken in yet
_LAST_S = 2.0  # for pages to take the end of a flight


class _Orders:
    """Passes orders on to the flight; what it does not take at once is refused.

    :param writer: the connection to it.
    """

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer

    def __call__(self, order: Order) -> str:
        if self._writer.transport.get_write_buffer_size() > 1 << 14:
            return "refused: the flight takes no orders at the moment"
        content = {"kind": order.kind, "agent": order.agent, "value": order.value}
        self._writer.write(json.dumps(content).encode() + b"\n")
        return f"ordered: {order.kind}{f' cf{order.agent}' if order.agent else ''}"


async def _take_in(reader: asyncio.StreamReader, track: Track) -> None:
    """Takes in records until the flight has gone."""
    moving: list[bool] = []
    while True:
        kind, content = await read_record(reader)
        if kind == BEGIN:
            moving = content.get("moving", [])
            track.begin(content)
        elif kind == MOMENT:
            track.add(told(content, moving))
        elif kind == END:
            track.end(content)


async def _serve(connection: socket.socket, port: int, control: bool) -> None:
    reader, writer = await asyncio.open_connection(sock=connection, limit=_BUFFER)
    track = Track("flight")
    server = ViewServer([track], new_token(), _Orders(writer) if control else None)
    try:
        url = await server.start(port)
    except DtsaError as error:
        writer.write(json.dumps({"error": str(error)}).encode() + b"\n")
        await writer.drain()
        return
    writer.write(json.dumps({"url": url}).encode() + b"\n")
    with suppress(asyncio.IncompleteReadError, ConnectionError, ValueError):
        await _take_in(reader, track)
    await server.stop(_LAST_S)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serves until the connection to the flight is closed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--fd", type=int, required=True)
    parser.add_argument("--port", type=int, default=0)
    parser.add_argument("--control", action="store_true")
    args = parser.parse_args(arguments)
    give_way()
    asyncio.run(_serve(socket.socket(fileno=args.fd), args.port, args.control))
    return 0


if __name__ == "__main__":
    sys.exit(main())
