"""Takes messages as bytes, and says who sent them: rclpy knows, but hands it out with no message.

Called through ``ctypes``: one function of rcl, with the message information that it fills in. Where that cannot be had
(another middleware, another distribution) there is no sender, and its numbers have to tell (:class:`OnePublisher`).

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
    _fields_ = [
        ("buffer", ctypes.c_void_p),
        ("length", ctypes.c_size_t),
        ("capacity", ctypes.c_size_t),
        ("allocator", _Allocator),
    ]


class _Information(ctypes.Structure):
    _fields_ = [
        ("source_timestamp", ctypes.c_int64),
        ("received_timestamp", ctypes.c_int64),
        ("publication_sequence_number", ctypes.c_uint64),
        ("reception_sequence_number", ctypes.c_uint64),
        ("implementation", ctypes.c_char_p),
        ("publisher", ctypes.c_uint8 * 16),
        ("intra_process", ctypes.c_bool),
    ]


@cache
def _libraries() -> tuple[Any, Any] | None:
    """rcl and rcutils of this process; None where the structures above are not theirs."""
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
    """Takes the messages of one subscription; its handle has to be held open meanwhile.

    :param handle: rclpy's handle of the subscription.
    """

    def __init__(self, handle: Any) -> None:
        self.number: int | None = None  # of the message taken last, as its publisher counts
        self.sender: bytes | None = None  # participant that sent it; None: not known
        self._handle, self._libraries = handle, _libraries()
        if self._libraries is not None:
            rcl, rcutils = self._libraries
            self._bytes, self._information = _Bytes(), _Information()
            allocator = rcutils.rcutils_get_default_allocator()
            rcutils.rcutils_uint8_array_init(ctypes.byref(self._bytes), _FIRST_BYTES, ctypes.byref(allocator))
            self._take, self._reset = rcl.rcl_take_serialized_message, rcutils.rcutils_reset_error
            self._words = handle.pointer, ctypes.addressof(self._bytes), ctypes.addressof(self._information), None
            self._sender_at = ctypes.addressof(self._information) + _Information.publisher.offset

    def take(self) -> bytes | None:
        """A message that is there already, as CDR, or None.

        :raises RuntimeError: if rcl cannot take it.
        """
        if self._libraries is None:
            taken = self._handle.take_message(None, True)
            if taken is None:
                return None
            data, information = taken
            self.number = information["publication_sequence_number"]
            return bytes(data)
        code = self._take(*self._words)
        if code:
            if code == _TAKE_FAILED:
                return None
            self._reset()
            raise RuntimeError(f"rcl error {code}")
        self.number = self._information.publication_sequence_number
        self.sender = ctypes.string_at(self._sender_at, _PARTICIPANT_BYTES)
        return ctypes.string_at(self._bytes.buffer, self._bytes.length)

    def close(self) -> None:
        """Frees the buffer."""
        if self._libraries is not None:
            self._libraries[1].rcutils_uint8_array_fini(ctypes.byref(self._bytes))
            self._take = lambda *words: _TAKE_FAILED
