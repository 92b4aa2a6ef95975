"""The page of a flight or a mission: `dtsa view` as a process of its own on its ROS domain."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from dtsa_agent.core.errors import DtsaError
from dtsa_bench.runs.program import end_process

_START_S = 30.0
_END_S = 5.0
# A process group of its own: Ctrl-C in the terminal reaches the flight alone, which then ends the page.
_OWN_GROUP: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"preexec_fn": os.setpgrp}


@dataclass(frozen=True, slots=True)
class PageOptions:
    """The page that is wanted."""

    port: int = 0  # 0: any that is free
    control: bool = False  # whether it may kill and start agents, land all, stop all motors and change the channel


@contextmanager
def view_process(domain: int, environment: Mapping[str, str], page: PageOptions) -> Iterator[subprocess.Popen[str]]:
    """Serve a page of a ROS domain while the context lasts, and print its address; no flight depends on it.

    :param environment: further variables of its process.
    :raises DtsaError: if it does not start.
    """
    arguments = ["view", "--domain", str(domain), "--port", str(page.port), *(["--control"] if page.control else [])]
    process = subprocess.Popen(
        [sys.executable, "-m", "dtsa_bench", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
        **_OWN_GROUP,
    )
    assert process.stdout is not None
    try:
        address, deadline = "", time.monotonic() + _START_S
        while not address and process.poll() is None and time.monotonic() < deadline:
            if select.select([process.stdout], [], [], 0.1)[0]:
                address = process.stdout.readline().strip()
        if not address:
            raise DtsaError("the view's server does not start")
        print(f"view: {address}", file=sys.stderr, flush=True)
        yield process
    finally:
        end_process(process, _END_S, signal.SIGTERM)
        process.stdout.close()
