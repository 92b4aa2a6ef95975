"""The air between dongles and Crazyflies: the channel model's medium, on each radio channel; and what happens when."""

from __future__ import annotations

import heapq
from collections.abc import Callable

from dtsa_channel_sim.model.config import ChannelConfig
from dtsa_channel_sim.model.medium import Medium, OnAir

from . import esb

_FORGET_NS = 20_000_000  # longer than any packet


class Agenda:
    """What happens when, in the order of times (ns)."""

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, when_ns: int, action: Callable[[], None]) -> None:
        """Do something at a time."""
        self._count += 1
        heapq.heappush(self._heap, (when_ns, self._count, action))

    @property
    def next_ns(self) -> int | None:
        """Time of the next action; None: there is none."""
        return self._heap[0][0] if self._heap else None

    def run(self, until_ns: int) -> None:
        """Do all that is due, up to and with this time."""
        while self._heap and self._heap[0][0] <= until_ns:
            heapq.heappop(self._heap)[2]()


class RadioAir:
    """Transmissions on all channels (0 to 125), which do not disturb each other, and the radios that hear them.

    Ids of radios (dongles and Crazyflies) are 1 to their number. A receiver loses a share of packets to noise.
    """

    def __init__(self, radios: int, loss: float, seed: int) -> None:
        self._config = ChannelConfig(agents=radios, loss=loss, seed=seed)
        self._medium = Medium(self._config)
        self._by_channel: dict[int, list[OnAir]] = {}
        self._judged = 0  # each transmission has random numbers of its own

    def set_loss(self, loss: float) -> None:
        """From now on another share of packets is lost to noise."""
        self._medium = Medium(self._config.changed({"loss": loss}))

    def send(
        self, channel: int, rate: str, sender: int, start_ns: int, length: int, turn_ns: int = esb.TURN_NS
    ) -> OnAir:
        """A transmission (bytes of payload) begins: its radio turns to sending, and hears nothing meanwhile."""
        air = start_ns + turn_ns
        frame = OnAir(sender, start_ns, air, air + esb.on_air_ns(length, rate))
        frames = self._by_channel.setdefault(channel, [])
        if frames and frames[0].end_ns < start_ns - _FORGET_NS:
            frames[:] = [f for f in frames if f.end_ns >= start_ns - _FORGET_NS]
        frames.append(frame)
        return frame

    def heard(self, channel: int, frame: OnAir) -> set[int]:
        """Ids of the radios that can decode a transmission that has ended, if they listen."""
        self._judged += 1
        others = [f for f in self._by_channel[channel] if f is not frame and f.end_ns > frame.start_ns]
        received = self._medium.resolve(self._judged, frame, others).received
        return {int(index) + 1 for index in received.nonzero()[0]}
