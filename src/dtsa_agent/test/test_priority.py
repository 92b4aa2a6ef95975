"""Real-time priority of a process: for all its threads, where that is granted."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

PRIORITY = """
import os, resource, sys, threading
from dtsa_agent.priority import set_ordinary_thread, use_last_processor, set_realtime
if len(sys.argv) > 1:  # an ordinary user with that limit
    resource.setrlimit(resource.RLIMIT_RTPRIO, (int(sys.argv[1]),) * 2)
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
over = threading.Event()
threading.Thread(target=over.wait).start()
why = set_realtime(7)
policies = {os.sched_getscheduler(int(task)) for task in os.listdir("/proc/self/task")}
assert why or policies == {os.SCHED_RR}, policies
use_last_processor()
assert {len(os.sched_getaffinity(int(task))) for task in os.listdir("/proc/self/task")} == {1}
set_ordinary_thread()
assert os.sched_getscheduler(0) == os.SCHED_OTHER
over.set()
print(why)
"""


def take_all(*arguments: str) -> str:
    command = [sys.executable, "-c", PRIORITY, *arguments]
    result = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_real_time_priority_is_taken_by_all_threads_or_refused_with_a_word() -> None:
    assert take_all() in ("\n", "Operation not permitted; see ulimit -r\n")


def may_raise_limits() -> bool:
    status = Path("/proc/self/status").read_text()
    capabilities = int(next(line.split()[1] for line in status.splitlines() if line.startswith("CapEff")), 16)
    return bool(capabilities >> 24 & 1)  # CAP_SYS_RESOURCE


ORDINARY = pytest.mark.skipif(os.geteuid() != 0, reason="only root can become somebody else")


@ORDINARY
def test_an_ordinary_user_without_a_grant_gets_no_real_time_priority() -> None:
    assert take_all("0") == "Operation not permitted; see ulimit -r\n"


@ORDINARY
def test_an_ordinary_user_gets_the_real_time_priority_that_is_granted_and_no_more() -> None:
    if take_all() != "\n" or not may_raise_limits():
        pytest.skip("this root may not do that either")
    assert take_all("50") == take_all("7") == "\n"
    assert take_all("6") == "Operation not permitted; see ulimit -r\n"
