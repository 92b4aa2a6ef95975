"""Live agents on virtual time: N stations in one process, one medium, clocks, ports, and faults drawn from one seed.

The stations are those that fly (``libdtsa/station``); the flight is ``libdtsa_sim/live.c``. Checked at every step: no
two agents that are in step send in one slot, and none flies without a quorum for longer than it takes to notice. After
the faults all must be in step, hear each other and fly within :func:`bound_ns`. The same seed gives the same bytes, as
``LiveResult.hash`` shows. Memory is fixed: a station lives in the ``dtsa_station_bytes`` that it begins with.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Any

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.kernel import ffi, fields_of, lib

MS, S = 1_000_000, 1_000_000_000
FAULTS = (
    "loss", "jitter", "delay", "duplicate", "corrupt", "replay", "forge", "one-way", "partition", "mute", "deaf",
    "refuse", "stall", "suspend", "step", "crash", "leave", "same-id",
)  # fmt: skip
VIOLATIONS = ("", "two senders in a slot", "flies without a quorum", "not together in time", "does not come to rest")
_KEY = bytes(range(16))
_AGENTS_MAX = lib.LIVE_HOSTS_MAX - 2  # and two processes of an id that is there already
_CLOCKS_S = 10**6  # clocks show anything up to this when a flight begins


@dataclass(frozen=True, slots=True)
class LiveFault:
    """Something that happens to an agent, or to all of them."""

    kind: str  # of FAULTS
    at_ns: int
    lasts_ns: int
    agent: int = 0  # index
    group: int = 0  # bits of agents
    amount: float = 0.0  # see libdtsa_sim/live.h


@dataclass(frozen=True, slots=True)
class LiveFlight:
    """A swarm of live agents and what happens to it."""

    seed: int
    agents: int = 4
    policy: str = "lease"
    slot_ns: int = 10 * MS
    signed: bool = False
    names: int = 4  # heard agents that a datagram names
    latency_ns: int = 100_000
    jitter_ns: int = 0
    airtime_ns: int = 0  # frames that overlap are lost; 0: they do not disturb each other
    drift_ppm: int = 0  # of clocks, either way
    starts_ns: tuple[int, ...] = ()  # of the processes; empty: at once
    first_slot: int = 0  # all begin together with this slot; 0: they listen first
    goal_every_ns: int = 0
    lasts_ns: int = 10 * S  # until the faults are over
    faults: tuple[LiveFault, ...] = ()

    def __post_init__(self) -> None:
        ranges = {
            "seed": (self.seed, 0, 2**63 - 1), "agents": (self.agents, 1, _AGENTS_MAX), "slot_ns": (self.slot_ns, 1, S),
            "names": (self.names, 0, 4), "drift_ppm": (self.drift_ppm, 0, 100_000),
            "faults": (len(self.faults), 0, lib.LIVE_FAULTS_MAX),
            **{f"faults[{k}].agent": (fault.agent, 0, self.agents - 1) for k, fault in enumerate(self.faults)},
        }  # fmt: skip
        for name, (value, least, most) in ranges.items():
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
                raise ConfigError(name, value, f"{least} to {most}")
        if self.policy not in ("lease", "tdma"):
            raise ConfigError("policy", self.policy, "lease, tdma")
        for fault in self.faults:
            if fault.kind not in FAULTS:
                raise ConfigError("kind", fault.kind, ", ".join(FAULTS))

    @property
    def anchor_every(self) -> int:
        """Rounds within which each agent sends, if it moves."""
        return 3 if self.policy == "lease" else 5

    @property
    def main_every(self) -> int:
        """Rounds within which each agent sends, if it rests."""
        return 15 if self.policy == "lease" else 5


@dataclass(frozen=True, slots=True)
class LiveResult:
    """What came of a flight."""

    violation: str  # of VIOLATIONS; empty: none
    agent: int
    other: int
    at_ns: int
    together_ns: int | None  # after the faults; None: not at all
    hash: int  # of every byte sent, and when
    agent_s: float
    sent: int
    flown: int  # slots
    hovered: int
    restarts: int
    shifts: int


def bound_ns(flight: LiveFlight) -> int:
    """Within this time after the last fault all are in step, hear each other and fly.

    12 K M N slots: an agent that restarts listens for up to 2 M N, is on probation for up to 2 K M N, is heard by all
    others within K M N, and all have named it K M N later for each list; at least 20 s, since frames may be lost.
    """
    return max(12 * flight.main_every * flight.agents * flight.slot_ns, 20 * S)


def fly(flight: LiveFlight, observer: Callable[[Any], None] | None = None) -> LiveResult:
    """Fly, and check; ``observer`` gets each call of a station, a ``live_call``."""
    c, kept = _c_flight(flight)
    result = ffi.new("live_result *")
    handle = ffi.new_handle(observer) if observer is not None else ffi.NULL
    if not lib.live_fly(c, result, lib.live_called if observer is not None else ffi.NULL, handle):
        raise MemoryError("a live flight cannot be made")
    del kept
    together_ns = result.together_ns if result.together_ns >= 0 else None
    values = {field.name: getattr(result, field.name) for field in fields(LiveResult)}
    return LiveResult(**values | {"violation": VIOLATIONS[result.violation], "together_ns": together_ns})


@ffi.def_extern(name="live_called")
def _called(context: Any, call: Any) -> None:
    ffi.from_handle(context)(call)


def _c_flight(flight: LiveFlight) -> tuple[Any, list[Any]]:
    """The flight as C has it, and what its memory needs alive."""
    n, lease, draw = flight.agents, flight.policy == "lease", random.Random(flight.seed)
    # Two thirds of them fly between two places, the others rest.
    start = ffi.new("double[]", [2.0 * k for k in range(n)] + [0.0] * (2 * n))
    away = ffi.new("double[]", [2.0 * k + (k % 3 != 2) for k in range(n)] + [0.0] * (2 * n))
    key = ffi.new("uint8_t[]", _KEY)
    config = ffi.new("dtsa_config *", {
        "agents": n, "slot_s": flight.slot_ns / S, "steps": 1, "c_r": 1, "position_step": 0.002, "key": 5,
        "policy": lib.DTSA_POLICY_LEASE if lease else lib.DTSA_POLICY_TDMA,
        "profile": lib.DTSA_PROFILE_EXTENDED if lease else lib.DTSA_PROFILE_PAPER,
        "estimator": lib.DTSA_ESTIMATE_LINEAR, "avoider": lib.DTSA_AVOID_NONE, "r_min": 0.3, "targets_known": 1,
        "gossip": 1, "avoid": {"v_max": 1.0, "gain": 2.0}, "start": start, "target": away,
        "lease": {
            "anchor_every": flight.anchor_every, "main_every": 15, "open_every": 11, "adoption": 1, "depth_rate": 0.5,
            "share": 1.0,
        },
    })  # fmt: skip
    station = {
        "agents": n, "anchor_every": flight.anchor_every, "main_every": flight.main_every,
        "slot_cycle": lib.dtsa_slot_cycle(config), "extended": lease,
        "frame_length": 56 if lease else 19, "position_step": 0.002, "slot_ns": flight.slot_ns,
        "seed": draw.randrange(1000), "quorum": lib.DTSA_QUORUM_ALL_BUT_ONE, "early_count": 64,
        "key": key if flight.signed else ffi.NULL, "key_length": 16, "session": 77,
        "link": {
            "header": b"DT\x01\x00live", "header_length": 8, "says_late": 1, "names": flight.names,
            "flight_ns": flight.latency_ns + flight.airtime_ns, "trust_ns": MS,
        },
    }  # fmt: skip
    starts, ppb = (*(flight.starts_ns or (0,) * n), 0, 0), 1000 * flight.drift_ppm
    hosts = [
        {"start_ns": start, "clock_ns": draw.randrange(_CLOCKS_S * S), "drift_ppb": draw.randint(-ppb, ppb)}
        for start in starts
    ]
    faults = [fields_of("live_fault", fault, kind=FAULTS.index(fault.kind)) for fault in flight.faults]
    over = max([flight.lasts_ns, *(fault.at_ns + fault.lasts_ns for fault in flight.faults)])
    c = ffi.new("live_flight *", {
        "config": config[0], "station": station, "seed": draw.randrange(1 << 62), "wake_ns": 60_000,
        "latency_ns": flight.latency_ns + flight.airtime_ns, "jitter_ns": flight.jitter_ns,
        "airtime_ns": flight.airtime_ns, "heal_ns": over + 30 * MS, "bound_ns": bound_ns(flight),
        "first_slot": flight.first_slot, "goal_every_ns": flight.goal_every_ns, "hosts": hosts,
        "fault_count": len(faults), "faults": faults,
    })  # fmt: skip
    return c, [start, away, key, config]


def draw_flight(seed: int) -> LiveFlight:
    """Return a flight with anything that can happen to it."""
    LiveFlight(seed)
    draw = random.Random(seed)
    agents, slot_ns = draw.choice([2, 3, 4, 5, 6, 8, 12]), draw.choice([5, 10, 10, 20, 33]) * MS
    lasts_ns = draw.choice([5, 20, 60]) * S
    airtime_ns = draw.choice([0, 0, 0, 300_000, slot_ns // 3])
    spread_ns = draw.choice([0, 50 * MS, 50 * agents * slot_ns])
    first = draw.random() < 0.05  # slot numbers at the end of their cycle
    flight = LiveFlight(
        seed, agents, draw.choice(["tdma", "lease", "lease"]), slot_ns, draw.random() < 0.3,
        draw.choice([4, 4, 4, 1, 0]), draw.choice([20_000, 100_000, 500_000]),
        draw.choice([0, 50_000] if airtime_ns > slot_ns // 4 else [0, 50_000, 300_000]), airtime_ns,
        draw.choice([0, 20, 100]), tuple(draw.randrange(spread_ns + 1) for _ in range(agents)),
        goal_every_ns=draw.choice([0, 2, 7]) * S, lasts_ns=lasts_ns,
    )  # fmt: skip
    if first:
        flight = replace(flight, starts_ns=(), first_slot=2**32 - draw.randrange(40 * agents * flight.main_every))
    faults = tuple(_draw_fault(draw, flight) for _ in range(draw.choice([0, 1, 2, 3, 4, 6])))
    return replace(flight, faults=faults)


def _draw_fault(draw: random.Random, flight: LiveFlight) -> LiveFault:
    kind = draw.choice(FAULTS)
    amounts = {
        "loss": (0.05, 0.3, 0.7), "jitter": (1 * MS, 5 * MS, 10 * MS, 20 * MS), "delay": (1 * MS, 5 * MS, 20 * MS),
        "duplicate": (0.3,), "corrupt": (0.1,), "replay": (10, 100), "forge": (10, 100),
        "step": (-S, -50 * MS, -2 * MS, 2 * MS, 50 * MS, S),
    }  # fmt: skip
    at_ns = draw.randrange(flight.lasts_ns)
    lasts_ns = min(draw.choice([20 * MS, 300 * MS, 1500 * MS, 5 * S, 60 * S]), flight.lasts_ns - at_ns)
    group = draw.randrange(1, 2**flight.agents - 1) if flight.agents > 1 else 0
    return LiveFault(kind, at_ns, lasts_ns, draw.randrange(flight.agents), group, draw.choice(amounts.get(kind, (0,))))


def shrink(flight: LiveFlight) -> LiveFlight:
    """A simpler flight with the same violation: as few faults, as short, as can be found one step at a time."""
    violation = fly(flight).violation
    while simpler := next((other for other in _simpler(flight) if fly(other).violation == violation), None):
        flight = simpler
    return flight


def _simpler(flight: LiveFlight) -> Iterator[LiveFlight]:
    for k, fault in enumerate(flight.faults):
        others = flight.faults[:k] + flight.faults[k + 1 :]
        yield replace(flight, faults=others)
        if fault.lasts_ns > 10 * MS:
            yield replace(flight, faults=(*others, replace(fault, lasts_ns=fault.lasts_ns // 2)))
    for name, plain in (("jitter_ns", 0), ("airtime_ns", 0), ("drift_ppm", 0), ("goal_every_ns", 0), ("starts_ns", ())):
        if getattr(flight, name) != plain:
            yield replace(flight, **{name: plain})
    last = max([S, *(fault.at_ns + fault.lasts_ns for fault in flight.faults)])
    if last < flight.lasts_ns:
        yield replace(flight, lasts_ns=last)


def command_of(flight: LiveFlight) -> str:
    """Return the command that flies a flight again, and prints its result."""
    return f'python -c "from {__name__} import *; print(fly({flight!r}))"'


def report_failure(seed: int) -> str:
    """Fly a seed; what is wrong, with the command of the simplest flight that shows it, or an empty text."""
    flight = draw_flight(seed)
    result = fly(flight)
    if not result.violation:
        return ""
    where = f"{result.violation}, agents {result.agent}, {result.other}, at {result.at_ns / S:.3f} s"
    return f"seed {seed}: {where}; shrunk:\n{command_of(shrink(flight))}"
