"""The inner loop of a node that lives on one topic: waits and reads; nothing else on the way.

rclpy's executors build their wait set anew for every message, which takes longer than a whole slot of the protocol.
This loop keeps one wait set on one subscription. Whatever else the node has (parameter services, timers) is served by
an ordinary executor a few times a second.
"""

from __future__ import annotations

import ctypes
import gc
import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import cache, partial
from typing import Any

import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

from dtsa_agent.core.errors import LocalProtocolError

from .checks import UNREADABLE, Intake

_POLL_NS = 50_000_000  # a signal is noticed after this time at the latest
_HOUSEKEEPING_S = 0.1
_SPIN_S = 5.0  # an executor looks for rarer things that often
_MOST_DROPPED = 16  # messages thrown away in a row before others get their turn
_SERVING_S, _END_S = 0.5, 2.0


class _NoExecutor(CallbackGroup):
    """Keeps executors away from a subscription."""

    def can_execute(self, entity: Any) -> bool:
        return False


# Who sent a message: rclpy knows, but hands it out with no message. So one function of rcl is called through ctypes,
# with the message information that it fills in. With another middleware or distribution there is no sender.
# Upstream: rclpy, issue 1465 (`publisher_gid` in the information of a message; done in pull request 1466).
# Delete when: the distribution that is used is one after Jazzy whose rclpy has it.
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


class Feed:
    """A subscription whose messages are read by its owner, at its own time.

    :param intake: counts messages that cannot be read or fail the check; None: they are errors.
    :param check: raises BadMessage if a message of a sender is not to be received; only with an intake.
    :param read: makes messages of serialised bytes, in place of rclpy; ``bytes``: they are given as they are.
    """

    def __init__(
        self, node: Node, msg_type: Any, topic: str, qos: QoSProfile, intake: Intake | None = None,
        check: Callable[[Any, bytes | None], None] | None = None, read: Callable[[bytes], Any] | None = None,
    ) -> None:  # fmt: skip
        self.sender: bytes | None = None  # participant of DDS, a process, that sent the last message; None: not known
        self.subscription = node.create_subscription(
            msg_type, topic, self._refuse, qos, callback_group=_NoExecutor(), raw=True
        )
        self.handle = self.subscription.handle
        self._type, self._intake, self._check = msg_type, intake, check
        self._read = read or partial(deserialize_message, message_type=msg_type)
        self._stack = ExitStack()
        self._stack.enter_context(self.handle)
        self._libraries = _libraries()
        if self._libraries is not None:
            rcl, rcutils = self._libraries
            self._bytes, self._information = _Bytes(), _Information()
            allocator = rcutils.rcutils_get_default_allocator()
            rcutils.rcutils_uint8_array_init(ctypes.byref(self._bytes), _FIRST_BYTES, ctypes.byref(allocator))
            self._stack.callback(rcutils.rcutils_uint8_array_fini, ctypes.byref(self._bytes))
            self._take, self._reset = rcl.rcl_take_serialized_message, rcutils.rcutils_reset_error
            places = map(ctypes.addressof, (self._bytes, self._information))
            self._arguments = self.handle.pointer, *places, None
            self._sender_at = ctypes.addressof(self._information) + _Information.publisher.offset

    def _refuse(self, message: Any) -> None:
        raise LocalProtocolError("an executor took a message that is not its own")

    def _take_bytes(self) -> bytes | None:
        """Return a message that is there already, as CDR, or None. RuntimeError: rcl cannot take it."""
        if self._libraries is None:
            taken = self.handle.take_message(None, True)
            return None if taken is None else bytes(taken[0])
        code = self._take(*self._arguments)
        if code:
            if code == _TAKE_FAILED:
                return None
            self._reset()
            raise RuntimeError(f"rcl error {code}")
        self.sender = ctypes.string_at(self._sender_at, _PARTICIPANT_BYTES)
        return ctypes.string_at(self._bytes.buffer, self._bytes.length)

    def take(self) -> Any:
        """Return a message that is there already, or None; also None after many that were not received."""
        for _ in range(_MOST_DROPPED):
            try:
                data = self._take_bytes()
                if data is None:
                    return None
                message = self._read(data)
            except Exception as error:  # rclpy has no common base for what a message can do to it
                if self._intake is None:
                    raise
                self._intake.drop(UNREADABLE, f"no {self._type.__name__}: {(str(error).splitlines() or [''])[0]}")
                continue
            if self._check is None or self._intake is None:
                return message
            with self._intake.guard():
                self._check(message, self.sender)
                return message
        return None

    def close(self) -> None:
        """Give the handles back; no message is taken afterwards."""
        self._stack.close()


class Loop(Feed):
    """Serves one subscription as fast as Python can, and the rest of its node now and then."""

    def __init__(self, node: Node, msg_type: Any, topic: str, qos: QoSProfile, **more: Any) -> None:
        super().__init__(node, msg_type, topic, qos, **more)
        self._node = node
        self._executor: SingleThreadedExecutor | None = None
        context = node.context.handle
        self._stack.enter_context(context)
        self._wait_set = _rclpy.WaitSet(1, 0, 0, 0, 0, 0, context)
        self._next_housekeeping = self._next_spin = 0.0
        gc.freeze()  # nothing made so far is garbage: do not look at it again and again

    def wait(self, timeout_ns: int = _POLL_NS) -> Any:
        """Return the next message, or None after a while."""
        wait_set = self._wait_set
        wait_set.clear_entities()
        wait_set.add_subscription(self.handle)
        wait_set.wait(timeout_ns)
        return self.take()

    def _needs_executor(self) -> bool:
        """Whether anything of the node but this subscription has to be served: an executor takes milliseconds."""
        node = self._node
        entities = {
            "subscription": [s for s in node.subscriptions if not isinstance(s.callback_group, _NoExecutor)],
            "timer": list(node.timers),
            "client": list(node.clients),
            "service": list(node.services),
        }
        subscriptions, timers, clients, services = map(len, entities.values())
        if not subscriptions + timers + clients + services:
            return False
        if time.monotonic() > self._next_spin:
            self._next_spin = time.monotonic() + _SPIN_S
            return True
        with ExitStack() as stack:
            wait_set = _rclpy.WaitSet(subscriptions, 0, timers, clients, services, 0, node.context.handle)
            for kind, group in entities.items():
                for entity in group:
                    stack.enter_context(entity.handle)
                    getattr(wait_set, f"add_{kind}")(entity.handle)
            wait_set.wait(0)
            return any(wait_set.get_ready_entities(kind) for kind in entities)

    def housekeeping(self) -> bool:
        """Serve parameters and timers if it is time; return whether it was: about ten times a second.

        ExternalShutdownException: the node's context has been shut down.
        """
        now = time.monotonic()
        if now < self._next_housekeeping:
            return False
        if not self._node.context.ok():
            raise ExternalShutdownException
        self._next_housekeeping = now + _HOUSEKEEPING_S
        if self._needs_executor():
            if self._executor is None:
                self._executor = SingleThreadedExecutor(context=self._node.context)
                self._executor.add_node(self._node)
                self._stack.callback(self._executor.shutdown, timeout_sec=0)
            for _ in range(2):
                self._executor.spin_once(timeout_sec=0.0)
        return True


class ExecutorThread:
    """Calls the callbacks of a node in a thread of this name until it is closed.

    ``Executor.spin`` in a thread raises when the executor is shut down under it; this ends between two callbacks.
    """

    def __init__(self, node: Node, name: str) -> None:
        self.executor = SingleThreadedExecutor(context=node.context)
        self.executor.add_node(node)
        self._context, self._closed = node.context, threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it: a callback under way is waited for, 2 s at most."""
        self._closed.set()
        self.executor.wake()
        self._thread.join(_END_S)
        self.executor.shutdown(timeout_sec=0)

    def _run(self) -> None:
        with suppress(ExternalShutdownException):
            while self._context.ok() and not self._closed.is_set():
                self.executor.spin_once(timeout_sec=_SERVING_S)
