"""Settings of all tests: no property depends on the machine's speed, and CI looks at the same examples each time.

With several workers (`-n`) the tests marked `alone` still have the machine for themselves. One marked `realtime` that
fails beside others runs once more, alone, and that result counts (the summary lists it). No test skips for load.
"""

from __future__ import annotations

import fcntl
import os
import signal
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "dtsa",
    deadline=None,
    derandomize=bool(os.environ.get("CI")),
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],  # says something about the machine only
)
settings.load_profile("dtsa")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a script; what tests start would ignore Ctrl-C, too.
    signal.signal(signal.SIGINT, signal.default_int_handler)

_TOOLS = str(Path(__file__).parent / "tools")
if _TOOLS not in os.environ.get("PYTHONPATH", "").split(os.pathsep):  # what tests start imports `dtsa_dev`, too
    os.environ["PYTHONPATH"] = os.pathsep.join([_TOOLS, *filter(None, [os.environ.get("PYTHONPATH", "")])])

_LOCKS = "dtsa_locks"  # what workers are told about: the directory of their locks


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Workers begin with the files that start nodes, which take long; those with tests marked `alone` come last."""
    if _worker_input(config) is None:
        return
    for item in items:
        if item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.flaky(reruns=1))
    alone = {item.path for item in items if _is_alone(item)}
    nodes = {item.path for item in items if item.get_closest_marker("ros") or item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path in alone, item.path not in nodes))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A worker's test waits until the machine is free for it; its timeout begins afterwards."""
    worker = _worker_input(item.config)
    if worker is None:
        return (yield)
    with Machine(Path(worker[_LOCKS])) as item.stash[_MACHINE]:
        item.stash[_MACHINE].occupy(_is_alone(item))
        return (yield)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Reserve the machine for a test that runs again."""
    if getattr(item, "execution_count", 1) > 1 and _MACHINE in item.stash:
        item.stash[_MACHINE].occupy(alone=True)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Names a test that failed at once; a run that is ended from outside never comes to its list of failures."""
    if report.failed and "PYTEST_XDIST_WORKER" not in os.environ:
        crash = getattr(report.longrepr, "reprcrash", None)
        why = str(report.longrepr if crash is None else crash.message).splitlines()
        print(f"\n{report.nodeid}: {why[0] if why else 'failed'}", file=sys.__stderr__, flush=True)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Tells a worker of pytest-xdist where the locks are."""
    node.workerinput[_LOCKS] = _lock_directory(node.config)


@pytest.hookimpl(tryfirst=True)
def pytest_keyboard_interrupt(excinfo: pytest.ExceptionInfo[BaseException]) -> None:
    """Where Ctrl-C found a test is said at once; each worker would take a second to write down how it came there.

    A worker ends what it has started, and has itself ended two seconds later whatever it does.
    """
    excinfo.traceback = excinfo.traceback[-1:]
    if "PYTEST_XDIST_WORKER" in os.environ:
        signal.alarm(2)


class Machine:
    """The machine, shared by the tests of several workers or reserved for one of them; a context manager.

    The locks are POSIX's, which belong to one process: what a worker has forked does not hold them when it has died.
    A worker that waits for `room` holds `turn`, so each gets its turn.

    :param locks: directory of the workers' locks.
    """

    def __init__(self, locks: Path) -> None:
        self._locks = locks

    def __enter__(self) -> Machine:
        self._room = (self._locks / "room").open("a+")
        return self

    def __exit__(self, *unused: object) -> None:
        self._room.close()

    def occupy(self, alone: bool) -> None:
        """Wait until the machine is free for this test; what it held before is given back first."""
        fcntl.lockf(self._room, fcntl.LOCK_UN)
        with (self._locks / "turn").open("a+") as turn:
            fcntl.lockf(turn, fcntl.LOCK_EX)
            fcntl.lockf(self._room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)


def _is_alone(item: pytest.Item) -> bool:
    return item.get_closest_marker("alone") is not None


def _worker_input(config: pytest.Config) -> dict[str, Any] | None:
    """What a worker of pytest-xdist was told; None: not a worker."""
    return getattr(config, "workerinput", None)


def _lock_directory(config: pytest.Config) -> str:
    """The directory of a run's locks; it is removed when the run ends."""
    if _LOCK_DIRECTORY not in config.stash:
        directory = tempfile.TemporaryDirectory(prefix="dtsa-test-")
        config.add_cleanup(directory.cleanup)
        config.stash[_LOCK_DIRECTORY] = directory.name
    return config.stash[_LOCK_DIRECTORY]


_LOCK_DIRECTORY = pytest.StashKey[str]()
_MACHINE = pytest.StashKey[Machine]()
