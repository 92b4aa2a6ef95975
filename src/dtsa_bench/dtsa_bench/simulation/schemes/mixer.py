"""Mixer: rounds in which all states reach all agents, through packets that combine what their senders have heard."""

from __future__ import annotations

import numpy as np

from dtsa_agent.core import SwarmConfig
from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.plugins import Table
from dtsa_bench.simulation.unslotted import Radio
from dtsa_channel_sim.model.airtime import Airtime

#: us between packets that are no airtime; an assumption.
GUARD_US = 31.0
#: Bytes of a packet beside the combination and its two vectors: hash, slot, sender, flags.
HEADER = 8


class FrameSolver:
    """Solves for the frames of one round: rows of bits that say which frames a combination is the sum of, modulo 2."""

    def __init__(self) -> None:
        self.rows: dict[int, tuple[int, int]] = {}  # by the highest bit of the vector: vector, sum of the frames

    def add(self, vector: int, mixed: int) -> None:
        """Add the sum of some frames, modulo 2; bit k - 1 of ``vector``: that of agent k is in it."""
        while vector:
            first = vector.bit_length() - 1
            row = self.rows.get(first)
            if row is None:
                self.rows[first] = (vector, mixed)
                return
            vector, mixed = vector ^ row[0], mixed ^ row[1]

    def solved(self) -> dict[int, int]:
        """Frames that are known, by id."""
        known: dict[int, tuple[int, int]] = {}
        for first in sorted(self.rows):  # rows below have been reduced already
            vector, mixed = self.rows[first]
            for lower, (other, frame) in known.items():
                if vector >> lower & 1:
                    vector, mixed = vector ^ other, mixed ^ frame
            known[first] = (vector, mixed)
        return {first + 1: mixed for first, (vector, mixed) in known.items() if vector == 1 << first}


class Mixer:
    """Rounds of packets; each packet is a random sum, modulo 2, of the frames that its sender has heard of.

    A round begins with a slot, and carries the states of that instant. It has ``mixer.slots_per_agent`` (2) N slots of
    its own, each as long as one packet (``mixer.slot_us``: what a packet takes an nRF, and 31 us); agents own them in
    turn. An agent's first packet contains its own frame for certain. Frames are received at the end of the round, as
    far as what was heard can be solved for them. ``mixer.period_ms``: from round to round, whole slots; as many packets
    as TDMA has frames.

    Mixer (arXiv 1804.08986), DMPC-Swarm (arXiv 2508.20553: 5.2 slots an agent for several hops). Not here: synchronous
    transmissions, requests for missing frames, the early end of a round.
    """

    options = ("period_ms", "slot_us", "slots_per_agent")
    may_join = True
    port = ("send", "received")

    def __init__(self, config: SwarmConfig, agent: int) -> None:
        share = config.options.get("mixer.slots_per_agent", 2.0)
        if not 1.0 <= share <= 100.0:
            raise ConfigError("mixer.slots_per_agent", share, "1 to 100")
        self._agent, self._count, self._length = agent, config.agents, config.frame_length
        self._width = -(-config.agents // 8)  # bytes of a vector
        self.packet = HEADER + 2 * self._width + self._length
        nrf_us = Airtime().total_ns(self.packet) / 1e3 + GUARD_US
        self.slot_ns = max(1, round(config.options.get("mixer.slot_us", nrf_us) * 1e3))
        slots = round(share * config.agents)
        self.round_ns = slots * self.slot_ns
        period_ns = round(config.options.get("mixer.period_ms", slots * config.slot_ms) * 1e6)
        self._period_slots = -(-max(period_ns, self.round_ns) // config.slot_ns)  # of the flight
        self.period_ns = self._period_slots * config.slot_ns
        self._random = np.random.default_rng([config.seed, 18040, agent])
        self._due_ns = 0  # when there is something to do: a round begins or ends, or it owns a slot
        self._round = -1  # that it takes part in
        self._heard = FrameSolver()
        self._said = self._news = False  # in this round: a packet sent; something heard and not taken in yet

    def wake(self, table: Table, now_ns: int, radio: Radio) -> int:
        """Begins rounds, sends in its own slots, and takes frames in when a round is over."""
        if now_ns > self._due_ns + 1:  # it was switched off, and waits for the next round
            self._round, self._due_ns = -1, (now_ns // self.period_ns + 1) * self.period_ns
        if self._over(now_ns) and self._news:
            self._news = False
            for agent, frame in sorted(self._heard.solved().items()):
                if agent != self._agent:
                    radio.receive_frame(frame.to_bytes(self._length, "little"), self._round * self._period_slots)
        if now_ns >= self._due_ns:
            self._act(radio)
        return max(now_ns + 1, self._due_ns)

    def received(self, table: Table, now_ns: int, sender: int, note: bytes) -> int:
        """Takes a combination in, after the end of its round, too: packets come some time after they were sent."""
        if len(note) == self.packet and self._round >= 0 and note[0] == self._round % 256:
            vectors = HEADER + self._width
            vector = int.from_bytes(note[HEADER:vectors], "little") & ((1 << self._count) - 1)
            self._heard.add(vector, int.from_bytes(note[vectors + self._width :], "little"))
            self._news = True
        return now_ns + 1 if self._news and self._over(now_ns) else max(now_ns + 1, self._due_ns)

    def _over(self, now_ns: int) -> bool:
        return self._round >= 0 and now_ns - self._round * self.period_ns >= self.round_ns

    def _act(self, radio: Radio) -> None:
        number, since_ns = divmod(self._due_ns, self.period_ns)
        if since_ns == 0:
            self._round, self._said, self._news, self._heard = number, False, False, FrameSolver()
            self._heard.add(1 << (self._agent - 1), int.from_bytes(radio.frame(), "little"))
        slot = since_ns // self.slot_ns
        if since_ns < self.round_ns and slot % self._count == self._agent - 1:
            radio.send_note(self._mix())
        own = slot + 1 + (self._agent - 2 - slot) % self._count
        ends_ns = [own * self.slot_ns, self.round_ns] if since_ns < self.round_ns else []
        self._due_ns = number * self.period_ns + min([*ends_ns, self.period_ns])

    def _mix(self) -> bytes:
        """A packet: the sum of a random half of what it has heard; in its first one, its own frame for certain."""
        rows = self._heard.rows
        vector = mixed = 0
        while not vector:
            drawn = self._random.random(len(rows)) < 0.5
            for taken, (first, row) in zip(drawn, rows.items(), strict=True):
                if taken or (first == self._agent - 1 and not self._said):
                    vector, mixed = vector ^ row[0], mixed ^ row[1]
        self._said = True
        vectors = vector.to_bytes(self._width, "little") + bytes(self._width)
        return bytes((self._round % 256, *bytes(HEADER - 1))) + vectors + mixed.to_bytes(self._length, "little")
