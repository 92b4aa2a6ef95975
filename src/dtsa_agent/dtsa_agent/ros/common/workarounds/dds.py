"""Fast DDS on one machine: no socket beyond loopback, and nothing left behind in shared memory.

Upstream: rmw_fastrtps, pull request 653 (adds LOCALHOST, which listens on all interfaces); Fast DDS, issue 6535 (a
sender waits for an idle port in shared memory); Fast DDS, issues 2790, 5053 and 5469 (what killed processes leave in
shared memory, and that a process which is started again hears nothing).
Delete when: rmw_fastrtps binds LOCALHOST to loopback alone, for the profiles; Fast DDS removes what dead processes have
left and opens such ports anew, for `clean_shared_memory`. `test_dds.py` shows each of them.
"""

from __future__ import annotations

import fcntl
import os
import re
import struct
import time
from collections.abc import Iterator, Mapping, MutableMapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
PEERS = "ROS_STATIC_PEERS"
# Fast DDS 2 reads the first, Fast DDS 3 the second.
PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROFILE = Path(__file__).with_name("loopback.xml")
PUNCTUAL = Path(__file__).with_name("loopback_udp.xml")

_SHARED_MEMORY = Path("/dev/shm")
_SEGMENT = re.compile(r"fast(?:rtps|dds)_(?:port\d+|[0-9a-f]{16})")
_LOCKS = ("_el", "_sl")  # exclusive: its one owner's; shared: of all who listen to a port
_YOUNG_S = 1.0  # a lock file that is being made is not locked yet
_ABANDONED_S = 60.0  # a port without any lock file: its listeners have gone in good order, a writer had it open
# Where Fast DDS 2.14 says in a port's memory whether it can be used (its ABI 5): port, listeners, ms of two time limits
# of which the second is a third of the first, capacity, who waits, and flags of which the lowest means "can be used".
_PORT = struct.Struct("<7I")
_MOST_LISTENERS, _FLAGS = 1024, 8


def limit_to_machine(environment: MutableMapping[str, str], shared_memory: bool = True) -> None:
    """Makes ``ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST`` mean loopback, and shared memory, alone.

    rmw_fastrtps adds a UDP transport of its own under LOCALHOST, which listens on all interfaces. With SYSTEM_DEFAULT
    it takes the transports of our profile instead. Another range, peers elsewhere, another middleware, or a profile of
    the user stays.

    Shared memory is faster, but not for what has to be punctual: a process that sends to another one for the first time
    looks whether its port is alive, and if that one is idle sleeps for a third of a second: often in the thread that
    receives. Nothing is heard in that time.

    :param environment: variables of a process that has not used the middleware yet; changed in place.
    :param shared_memory: whether it uses shared memory: not in real time.
    """
    foreign = not environment.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp").startswith("rmw_fastrtps")
    ours = all(environment.get(name) in map(str, (PROFILE, PUNCTUAL)) for name in PROFILES)  # a supervisor's
    plain = environment.get(RANGE) == "LOCALHOST" and not any(name in environment for name in PROFILES)
    if foreign or environment.get(PEERS) or not (ours or plain):
        return
    environment[RANGE] = "SYSTEM_DEFAULT"
    for name in PROFILES:
        environment[name] = str(PROFILE if shared_memory else PUNCTUAL)


def by_udp(environment: Mapping[str, str]) -> bool:
    """Whether a process does without shared memory, or whoever has started it does.

    :param environment: its variables.
    """
    return all(environment.get(name) == str(PUNCTUAL) for name in PROFILES)


def clean_shared_memory(directory: Path = _SHARED_MEMORY) -> list[str]:
    """Removes what Fast DDS participants that are dead have left in shared memory, as after ``kill -9``.

    The kernel holds a lock for every living owner of a segment and every living listener of a port: what nobody has
    locked belongs to nobody. What is young, or another user's, stays.

    The dead one's port may still be open in processes that write to it, and a process that is started again gets a port
    of the same name: the writers would go on writing to the old memory, and the new process would never hear from them.
    So the old memory is marked as unusable, and the writers open the port anew.

    :param directory: where shared memory lies.
    :returns: names of the segments removed.
    """
    removed = []
    for path in sorted(directory.glob("fast*")):
        if not _SEGMENT.fullmatch(path.name):
            continue
        locks = [lock for suffix in _LOCKS if (lock := directory / f"{path.name}{suffix}").exists()]
        with _dead(locks) as dead:
            if not dead and not (not locks and "port" in path.name and _age_s(path) >= _ABANDONED_S):
                continue
            with _memory(path) as memory:
                for file in (path, directory / f"sem.{path.name}_mutex", *locks):
                    with suppress(OSError):
                        file.unlink()
                # Last: a writer that sees the mark finds nothing of the old port, and makes a new one.
                _mark_unusable(memory, path.name)
        removed.append(path.name)
    return removed


@contextmanager
def _memory(path: Path) -> Iterator[int | None]:
    """A descriptor of what lies in shared memory, for as long as the context lasts; None if it cannot be had."""
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        yield None
        return
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _mark_unusable(memory: int | None, name: str) -> None:
    """Tells all who have a port open that it cannot be used any more; nothing happens to what does not look like one.

    :param memory: descriptor of the port's memory.
    :param name: of the port.
    """
    if memory is None or "port" not in name:
        return
    data = os.pread(memory, os.fstat(memory).st_size, 0)
    number = struct.pack("<I", int(name.rpartition("port")[2]))
    at = data.find(number)
    while 0 <= at <= len(data) - _PORT.size:
        _, listeners, limit_ms, pause_ms, capacity, waiting, flags = _PORT.unpack_from(data, at)
        fits = limit_ms and pause_ms == limit_ms // 3 and capacity and max(listeners, waiting) <= _MOST_LISTENERS
        if at % 4 == 0 and fits and flags < _FLAGS:
            os.pwrite(memory, struct.pack("<I", flags & ~1), at + _PORT.size - 4)
            return
        at = data.find(number, at + 1)


def _age_s(path: Path) -> float:
    """How long ago a file was changed last, s; 0 for one that has gone."""
    try:
        return time.time() - path.stat().st_mtime
    except OSError:
        return 0.0


@contextmanager
def _dead(locks: list[Path]) -> Iterator[bool]:
    """Whether nobody holds any of some lock files; while the context lasts, we do."""
    with ExitStack() as stack:
        yield bool(locks) and all(_take(lock, stack) for lock in locks)


def _take(lock: Path, stack: ExitStack) -> bool:
    """Takes a lock file that nobody holds, until the stack is closed; whether that could be done."""
    try:
        descriptor = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
        stack.callback(os.close, descriptor)
        if time.time() - os.fstat(descriptor).st_mtime < _YOUNG_S:  # its owner may be about to lock it
            return False
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Somebody else may have removed it before we had it, and a living process made one of the same name.
        return os.path.samestat(os.fstat(descriptor), os.stat(lock))
    except OSError:  # locked, another user's, or gone meanwhile
        return False
