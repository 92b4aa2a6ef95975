"""The soaks by name. Each is imported when it is wanted."""

from __future__ import annotations

from importlib import import_module

from .item import Soak

SOAKS = {
    "recorder": "the recorder killed at random moments of flights in both modes; its bags recovered and verified",
    "faults": "every row of the table of faults, docs/evidence/faults.md, against real processes",
    "memory": "an hour of lockstep and ten minutes of real time: no process grows",
    "reference": "200 random flights on the compiled core and on the specification: equal bit for bit",
    "safer": "300 settings drawn at random: crashes and ages of `lease` beside TDMA and TDMA with gossip",
    "fuzz": "an hour of coverage-guided fuzzing of decoders and event streams of libdtsa (needs clang)",
    "crazyflie": "missions of twelve, gaps of the air, streams of commands: over UDP and simulated radios with losses",
    "air": "agents on hosts of their own over a switch that is the medium: cold starts, losses, drifts, faults",
    "twelve": "the paper's experiment from twelve apps on board, beside the simulator and agents over UDP",
    "serial": "agents over simulated modems: cold starts, losses, kills, partitions, modems unplugged, slow adapters",
    "board": "twelve apps on board in the laboratory, an hour of virtual time with faults",
    "league": "every entry of league-1 flown again, whole; entries with one number changed are found",
    "ns3": "the simulated channel beside ns-3's, the same loads (needs a Python with ns-3's wheel)",
    "mutants": "small random changes of the source, each of which the tests should find",
    "load": "12 and 18 agents at 10 ms beside six busy loops: flights end by themselves and by Ctrl-C",
}


def soak_named(name: str) -> Soak:
    """A soak.

    :param name: a key of SOAKS.
    """
    found: Soak = import_module(f"dtsa_dev.soak.{name}").SOAK
    return found
