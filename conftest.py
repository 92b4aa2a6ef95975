"""Settings of all tests: no property depends on the machine's speed, and CI looks at the same examples each time.

With several workers (`-n`) the tests marked `alone` still have the machine for themselves.
"""

from __future__ import annotations

import fcntl
import os
import signal
import sys
import tempfile
from collections.abc import Generator, Iterator
from contextlib import contextmanager
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
    alone = {item.path for item in items if _is_alone(item)}
    nodes = {item.path for item in items if item.get_closest_marker("ros") or item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path in alone, item.path not in nodes))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A worker's test waits until the machine is free for it; its timeout begins afterwards."""
    worker = _worker_input(item.config)
    if worker is None:
        return (yield)
    with machine(Path(worker[_LOCKS]), alone=_is_alone(item)):
        return (yield)


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


@contextmanager
def machine(locks: Path, alone: bool) -> Iterator[None]:
    """The machine for one test alone, or together with those of other workers that do not mind.

    The locks are POSIX's, which belong to one process: what a worker has forked does not hold them when it has died.

    :param locks: directory of the workers' locks. A worker that waits for `room` holds `turn`, so each gets its turn.
    :param alone: whether no other test may run meanwhile.
    """
    with (locks / "room").open("a+") as room:
        with (locks / "turn").open("a+") as turn:
            fcntl.lockf(turn, fcntl.LOCK_EX)
            fcntl.lockf(room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        yield


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
