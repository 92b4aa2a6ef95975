"""The table of radios of docs/how-to/radios.md, made from the formulas of ports and radios."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import dtsa
from dtsa_agent.air.port import shortest_slot_ns
from dtsa_agent.air.serial_modems import MODEMS, NONE
from dtsa_agent.air.settings import CrazyradioSettings, SerialSettings
from dtsa_agent.core import SwarmConfig
from dtsa_channel_sim.model.airtime import RADIOS

from . import table

_AGENTS, _MOVING, _SEEDS = 12, 4, 20
_GUARD_NS = 70_000  # docs/evidence/league.md, "Shortest slots of this hardware"
_UDP_SLOT_NS = 10_000_000  # flown, on one machine and in network namespaces: no formula says what a network does
_PATIENCE_NS = 1_000_000_000  # an agent that moves is to be heard as often
_MOST = 254  # agents that `lease` can have
_HEAD = (
    "radio", "`lease`: shortest slot", "mean age, all move", f"{_MOVING} of {_AGENTS} move", "largest N",
    "`tdma`, short frames: shortest slot", "mean age", "largest N",
)  # fmt: skip

Slot = Callable[[SwarmConfig], int]  # the shortest that a radio can carry, ns


class _Row(NamedTuple):
    text: str
    slot: Slot


def _on_board(config: SwarmConfig) -> int:
    header = 0 if config.auth else 4  # of a datagram, see docs/reference/network.md
    airtime = RADIOS["crazyflie"].airtime
    return airtime.shortest_slot_ns(header + config.frame_length, guard_ns=_GUARD_NS)


def _rows() -> Iterator[_Row]:
    crazyradio = CrazyradioSettings(uri="radio://0/80/2M").properties
    yield _Row("UDP on a quiet network", lambda config: _UDP_SLOT_NS)
    yield _Row("Crazyflie to Crazyflie, on board", _on_board)
    yield _Row("Crazyradio 2.0, sniffer mode", lambda config: shortest_slot_ns(config, crazyradio))
    for name, modem in MODEMS.items():
        if name != NONE:
            port = SerialSettings(device="modem", baud=modem.baud, modem=name).properties
            yield _Row(f"{modem.text} (`{name}`)", lambda config, port=port: shortest_slot_ns(config, port))  # type: ignore[misc]


def _largest(config: SwarmConfig, slot: Slot) -> int:
    """Of the swarms in which everybody has a turn within a second."""
    for agents in range(2, _MOST + 1):
        if agents * slot(replace(config, agents=agents, moving=None)) > _PATIENCE_NS:
            return agents - 1
    return _MOST


def _age_of_movers() -> float:
    """With `lease`, slots."""
    flights = [
        dtsa.simulate(agents=_AGENTS, moving=_MOVING, policy="lease", slot_ms=50.0, seed=s) for s in range(_SEEDS)
    ]
    return sum(float(flight.summary["waking_age_mean_slots"]) for flight in flights) / _SEEDS


def _ms(ns: float) -> str:
    ms = ns / 1e6
    return f"{ms:.2f} ms" if ms < 10 else f"{ms:.0f} ms"


def radio_table() -> str:
    """Slot length, age and largest swarm of each radio."""
    lease = SwarmConfig(agents=_AGENTS, policy="lease", auth=True, auth_session=1)
    short = replace(lease, policy="tdma")
    all_move, movers = (_AGENTS - 1) / 2, _age_of_movers()
    rows = []
    for text, slot in _rows():
        long_ns, short_ns = slot(lease), slot(short)
        rows.append((
            text, _ms(long_ns), _ms(all_move * long_ns), _ms(movers * long_ns), str(_largest(lease, slot)),
            _ms(short_ns), _ms(all_move * short_ns), str(_largest(short, slot)),
        ))  # fmt: skip
    return table(_HEAD, rows)
