"""Pops messages as bytes, and says which process sent them: rclpy knows, but hands it out with no message.

Called through ``ctypes``: one function of rcl, with the message information that it fills in. Where that cannot be had
(another middleware, another distribution) there is no sender.

Upstream: rclpy, issue 1465 (`publisher_gid` in the information of a message; done in pull request 1466).
Delete when: the distribution that is used is one after Jazzy whose rclpy has it.
"""

from __future__ import annotations

import ctypes
import os
from functools import cache
from typing import Any

import rclpy

_MIDDLEWARE = "rmw_fastrtps"  # ids of its publishers begin with that of their participant: one a process
_DISTRIBUTION = "jazzy"  # whose structures these are
_PARTICIPANT_BYTES = 12
_TAKE_FAILED = 401  # RCL_RET_SUBSCRIPTION_TAKE_FAILED: there is no message
_FIRST_BYTES = 4096  # the buffer grows with the messages


class _Allocator(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in ("allocate", "deallocate", "reallocate", "zero_allocate", "state")]


class _Bytes(ctypes.Structure):
    _fields_ = [("buffer", ctypes.c_void_p), *((n, ctypes.c_size_t) for n in ("length", "capacity")), ("_", _Allocator)]


class _Information(ctypes.Structure):
    _fields_ = [
        *((n, ctypes.c_uint64) for n in ("sent", "received", "publication_number", "reception_number")),
        ("implementation", ctypes.c_char_p), ("publisher", ctypes.c_uint8 * 16), ("intra_process", ctypes.c_bool),
    ]  # fmt: skip


@cache
def _libraries() -> tuple[Any, Any] | None:
    """Return rcl and rcutils of this process; None where the structures above are not theirs."""
    known = rclpy.get_rmw_implementation_identifier().startswith(_MIDDLEWARE)
    if not known or os.environ.get("ROS_DISTRO", _DISTRIBUTION) != _DISTRIBUTION:
        return None
    try:
        rcl, rcutils = ctypes.CDLL("librcl.so"), ctypes.CDLL("librcutils.so")
        rcl.rcl_take_serialized_message.argtypes = [ctypes.c_void_p] * 4
        rcutils.rcutils_get_default_allocator.restype = _Allocator
        rcutils.rcutils_uint8_array_init.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p]
        rcutils.rcutils_uint8_array_fini.argtypes = [ctypes.c_void_p]
    except (OSError, AttributeError):
        return None
    return rcl, rcutils


class Taker:
    """Pops the messages of one subscription; its handle, rclpy's, has to be held open meanwhile."""

    def __init__(self, handle: Any) -> None:
        self.sender: bytes | None = None  # participant that sent the last message; None: not known
        self._handle, self._libraries = handle, _libraries()
        if self._libraries is not None:
            rcl, rcutils = self._libraries
            self._bytes, self._information = _Bytes(), _Information()
            allocator = rcutils.rcutils_get_default_allocator()
            rcutils.rcutils_uint8_array_init(ctypes.byref(self._bytes), _FIRST_BYTES, ctypes.byref(allocator))
            self._take, self._reset = rcl.rcl_take_serialized_message, rcutils.rcutils_reset_error
            self._arguments = handle.pointer, ctypes.addressof(self._bytes), ctypes.addressof(self._information), None
            self._sender_at = ctypes.addressof(self._information) + _Information.publisher.offset

    def take(self) -> bytes | None:
        """Return a message that is there already, as CDR, or None.

        :raises RuntimeError: if rcl cannot take it.
        """
        if self._libraries is None:
            taken = self._handle.take_message(None, True)
            return None if taken is None else bytes(taken[0])
        code = self._take(*self._arguments)
        if code:
            if code == _TAKE_FAILED:
                return None
            self._reset()
            raise RuntimeError(f"rcl error {code}")
        self.sender = ctypes.string_at(self._sender_at, _PARTICIPANT_BYTES)
        return ctypes.string_at(self._bytes.buffer, self._bytes.length)

    def close(self) -> None:
        """Free the buffer."""
        if self._libraries is not None:
            self._libraries[1].rcutils_uint8_array_fini(ctypes.byref(self._bytes))
            self._take = lambda *arguments: _TAKE_FAILED
