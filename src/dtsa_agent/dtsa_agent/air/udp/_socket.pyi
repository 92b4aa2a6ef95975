"""A socket as the port of an agent, read with the kernel's times of arrival. Compiled."""

from typing import Any

_Port = Any  # a capsule, see _hearing/port.h

# What `Hearing` reads; the caller keeps the socket open.
def open_port(descriptor: int, address: bytes, number: int, /) -> _Port: ...  # from which this agent sends
def set_address(port: _Port, address: bytes, number: int, /) -> None: ...  # the same, from now on
def counts(port: _Port, /) -> tuple[int, int]: ...  # how often it could not be read; clock steps

# When a datagram arrived, by its stamp (-1: none), after a look at both clocks; for tests.
def stamped(port: _Port, ahead_ns: int, now_ns: int, stamp_ns: int, /) -> int: ...
