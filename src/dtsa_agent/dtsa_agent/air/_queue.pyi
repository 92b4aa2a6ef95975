"""A queue as the port of an agent: a thread that reads a device puts in what has arrived. Compiled."""

from typing import Any

_Port = Any  # a capsule, see _hearing/port.h

# It ends with the capsule.
def open_queue() -> _Port: ...

# A datagram has arrived, CLOCK_MONOTONIC; whether there was room. ``own``: this very agent has sent it.
def put(port: _Port, data: bytes, arrival_ns: int, own: bool, /) -> bool: ...

# What has arrived, 16 at most, for a listener; an agent's hearing reads the port itself.
def get(port: _Port, /) -> list[tuple[bytes, int, bool]]: ...
def descriptor(port: _Port, /) -> int: ...  # for ``select``: readable when something has arrived
def overflowed(port: _Port, /) -> int: ...  # datagrams for which there was no room
