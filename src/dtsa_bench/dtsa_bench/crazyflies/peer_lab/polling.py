"""A ground station on the air: a simulated Crazyradio that asks each vehicle for news, as cflib does."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from dtsa_agent.crazyflie.addresses import parse_address
from dtsa_bench.crazyflies.simulated.fleet_config import RadioSettings
from dtsa_bench.crazyflies.simulated.radio.air import RATE_NAMES, RadioAir
from dtsa_bench.crazyflies.simulated.radio.dongle import SET_ADDRESS, SET_CHANNEL, SET_RATE, DongleModel
from dtsa_bench.crazyflies.simulated.radio.receiver import NULL, RadioReceiver

from .app import LabSettings

_POLL = bytes((NULL | 0x0C,))  # an empty packet
_STREAM = 0x706F6C6C  # of random numbers, besides those of losses and starts


class Polling:
    """One dongle that polls all vehicles in turn; `heard` gets an id and the time (s) when its radio has a packet."""

    def __init__(self, air: RadioAir, settings: LabSettings, heard: Callable[[int, float], None]) -> None:
        count = settings.agents
        self.answered = 0
        self._agenda = air.agenda
        for agent in range(1, count + 1):
            station = parse_address(f"radio://0/{settings.channel}/{settings.rate}/E7E7E7E7{agent:02X}")
            receiver = RadioReceiver(station, lambda packet, t: None)
            receiver.on_packet = partial(heard, agent)
            air.receivers[agent] = receiver
        self._receivers = list(air.receivers.values())
        self._dongle = DongleModel(count + 1, RadioSettings(seed=settings.seed, request_ms=0.0), air)
        self._dongle.request(SET_CHANNEL, settings.channel, b"", 0)
        self._dongle.request(SET_RATE, RATE_NAMES.index(settings.rate), b"", 0)
        self._gap_ns = round(1e9 / (settings.polls * count))
        self._next = 0
        self._busy = False
        self._random = np.random.default_rng([settings.seed, _STREAM])
        self._due_ns = self._gap_ns
        self._agenda.at(self._due_ns, self._poll)

    def _poll(self) -> None:
        """The next vehicle's turn; one transfer at a time, so a dongle that is behind skips turns."""
        now = self._due_ns
        # A computer asks when its threads come to it: polls in step with slots would hit all frames, or none.
        self._due_ns += round(self._gap_ns * self._random.uniform(0.5, 1.5))
        self._agenda.at(self._due_ns, self._poll)
        if self._busy:
            return
        receiver = self._receivers[self._next]
        self._next = (self._next + 1) % len(self._receivers)
        self._busy = True
        self._dongle.request(SET_ADDRESS, 0, receiver.address, now)
        self._dongle.transfer(_POLL, now, self._answer)

    def _answer(self, data: bytes) -> None:
        self._busy = False
        self.answered += bool(data and data[0] & 1)
