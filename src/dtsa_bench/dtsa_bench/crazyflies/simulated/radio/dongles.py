"""Simulated Crazyradios on an air of their own: no Crazyflies."""

from __future__ import annotations

import selectors

from .settings import RadioSettings
from .side import RadioSide

_PATIENCE_S = 0.05


class Dongles:
    """Serves the hosts that connect to the socket.

    :param settings: dongles and air.
    :raises ConfigError: the socket cannot be made.
    """

    def __init__(self, settings: RadioSettings) -> None:
        self.side = RadioSide(settings, lambda index, packet, t: None, lambda index, up: True)
        self._stopped = False

    def stop(self) -> None:
        """Ends :meth:`run`; also from a signal's handler."""
        self._stopped = True

    def run(self) -> None:
        """Serves until it is stopped."""
        selector = selectors.SelectSelector()  # waits to the microsecond; epoll to the millisecond
        selector.register(self.side.listener, selectors.EVENT_READ, None)
        try:
            while not self._stopped:
                due = self.side.wait_s()
                for key, _ in selector.select(_PATIENCE_S if due is None else min(due, _PATIENCE_S)):
                    self.side.take(key.data, selector)
                self.side.run()
        finally:
            for key in list(selector.get_map().values()):
                if key.data is not None:
                    self.side.leave(key.data)
            self.side.close()
