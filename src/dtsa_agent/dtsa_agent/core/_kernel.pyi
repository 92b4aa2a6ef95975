"""The compiled core: libdtsa and the layer above. Headers say shapes and units."""

from typing import Any

VERSION: int  # of libdtsa
FRAME_MAX: int
FRAME_RECORD: int  # bytes of a frame's structure
EXTENDED_RECORD: int
SWARM_IMAGE: int  # bytes of the images that core/binding.py makes
METRICS_IMAGE: int

# Agents in slots (libdtsa_sim/swarm.h), on arrays that core/swarms/swarm.py owns.

class Swarm: ...  # an opaque handle

def swarm(image: bytes, arrays: Any, /) -> Swarm: ...  # keeps the arrays alive
def decide(swarm: Swarm, slot: int, /) -> None: ...
def emit(swarm: Swarm, slot: int, /) -> tuple[int, ...]: ...
def begin(swarm: Swarm, slot: int, /) -> tuple[int, ...]: ...  # decides and emits
def fly(swarm: Swarm, slot: int, /) -> None: ...
def steer(swarm: Swarm, slot: int, step: int, estimate: int, /) -> None: ...
def move(swarm: Swarm, step: int, /) -> None: ...
def estimate(swarm: Swarm, slot: int, step: int, /) -> None: ...
def hear(swarm: Swarm, slot: int, data: bytes, mask: bytes | None, /) -> bool: ...
def end(swarm: Swarm, slot: int, /) -> None: ...
def frame(swarm: Swarm, index: int, /) -> bytes: ...
def policy_bytes(policy: int, agents: int, anchor_every: int, /) -> int: ...  # of an agent's state
def restart(swarm: Swarm, index: int, /) -> None: ...
def reset(swarm: Swarm, /) -> None: ...

# -> probation, deaf, woke, alive, absent, silent slots
def lease_status(swarm: Swarm, index: int, /) -> tuple[bool, bool, int, int, int, int]: ...

# Sums over a flight (libdtsa_sim/metrics.h), on arrays that dtsa_bench/runs/metrics.py owns.

class Metrics: ...

def metrics(image: bytes, arrays: Any, /) -> Metrics: ...
def update(metrics: Metrics, slot: int, track: bytes, tables: Swarm | None, /) -> int: ...

# Frames: a record is the structure of libdtsa/frame.h; its size says which one.

def encode(record: bytes, position_step: float, /) -> bytes: ...  # none: not encodable

# -> the record, or a negative fault
def decode(data: bytes, position_step: float, extended: bool, /) -> bytes | int: ...

# Parts that need no swarm. Arrays are bytes: doubles unless said; (3, N) of N agents.

def priority(position: bytes, velocity: bytes, slot_s: float, /) -> bytes: ...

# counter: 64-bit whole numbers; in_ap: bytes. -> index, reason, who was a candidate
def select(g: bytes, counter: bytes, in_ap: bytes, epsilon: float, selection: int, /) -> tuple[int, int, bytes]: ...
def avoid_command(
    kind: int,
    params: bytes,
    self_index: int,
    position: bytes,
    velocity: bytes,
    goal: bytes,
    others_p: bytes,
    others_v: bytes,
    age_s: bytes | None,
    /,
) -> bytes: ...  # params: core/binding.py, AVOID

# -> positions, then velocities
def vehicle_step(tau: float, a_max: float, dt: float, position: bytes, velocity: bytes, command: bytes, /) -> bytes: ...

# Instructions in use: 0 baseline, 1 AVX2; same bits either way. A level sets it, bounded by the machine; -1: leaves it.
def vector_level(level: int, /) -> int: ...

# Of what has numbers: the list's name, then the names in it; empty after the last list.
def names(index: int, /) -> tuple[str, ...]: ...
