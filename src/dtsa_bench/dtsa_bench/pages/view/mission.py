"""The page of a mission: `dtsa view` as a process of its own on the mission's ROS domain."""

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
from dtsa_bench.runs.processes import end_process

from .link import OWN_GROUP

_START_S = 30.0
_END_S = 5.0


@dataclass(frozen=True, slots=True)
class PageOptions:
    """The page that is wanted."""

    port: int = 0  # 0: any that is free
    control: bool = False  # whether it may land all, stop all motors and change the channel


@contextmanager
def mission_page(domain: int, environment: Mapping[str, str], page: PageOptions | None) -> Iterator[None]:
    """Serves a page for as long as the context lasts, and says where; the mission does not depend on it.

    :param domain: ROS domain.
    :param environment: further variables of its process.
    :param page: None: no page.
    :raises DtsaError: if it does not start.
    """
    if page is None:
        yield
        return
    words = ["view", "--domain", str(domain), "--port", str(page.port), *(["--control"] if page.control else [])]
    process = subprocess.Popen(
        [sys.executable, "-m", "dtsa_bench", *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
        **OWN_GROUP,
    )
    try:
        print(f"view: {_address(process)}", file=sys.stderr, flush=True)
        yield
    finally:
        _end(process)


def _address(process: subprocess.Popen[Any]) -> str:
    """The address of the page, which its process tells first."""
    assert process.stdout is not None
    end = time.monotonic() + _START_S
    while time.monotonic() < end:
        if select.select([process.stdout], [], [], 0.1)[0]:
            line = process.stdout.readline().strip()
            if line:
                return str(line)
            break
    raise DtsaError("the view's server does not start")


def _end(process: subprocess.Popen[Any]) -> None:
    end_process(process, _END_S, signal.SIGTERM)
    if process.stdout is not None:
        process.stdout.close()
