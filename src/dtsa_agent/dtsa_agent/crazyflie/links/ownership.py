"""A Crazyflie belongs to one bridge at a time: two that send to it would both believe to be alone."""

from __future__ import annotations

import fcntl
import hashlib
import os
import tempfile
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from dtsa_agent.core.errors import ConfigError

from .link import SIMULATED_RADIO


class Ownership:
    """Locks on the addresses of Crazyflies, among the processes of a machine. They end with the process, too.

    :param robots: name and URI of each.
    :raises ConfigError: another bridge has one of them.
    """

    def __init__(self, robots: Iterable[tuple[str, str]]) -> None:
        self._files: list[int] = []
        directory = Path(tempfile.gettempdir()) / f"dtsa-crazyflies-{os.getuid()}"
        with suppress(FileExistsError):
            directory.mkdir(mode=0o700)
        for name, uri in robots:
            air = os.environ.get(SIMULATED_RADIO, "") if uri.startswith("radio://") else ""  # one of several
            address = air + uri.partition("?")[0].lower()
            file = os.open(directory / hashlib.sha256(address.encode()).hexdigest(), os.O_CREAT | os.O_RDWR, 0o600)
            self._files.append(file)
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                self.release()
                raise ConfigError(f"robots.{name}.uri", uri, "a Crazyflie that no other bridge here uses") from None

    def release(self) -> None:
        """Others may have them."""
        while self._files:
            os.close(self._files.pop())
