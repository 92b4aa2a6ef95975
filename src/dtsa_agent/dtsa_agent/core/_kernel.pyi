"""The compiled core: libdtsa and the layer above. Arrays are C-contiguous buffers; headers say shapes and units."""

from collections.abc import Mapping
from typing import Any, TypeAlias

Array: TypeAlias = Any  # whatever offers the buffer protocol

NAMES: dict[str, tuple[str, ...]]
VERSION: int  # of libdtsa
FRAME_MAX: int
FRAME_RECORD: int  # bytes of a frame's structure
EXTENDED_RECORD: int
EXTENDED_LENGTH: int
EXTENDED_HEAD: int
EXTENDED_SENDER_MAX: int
LEASE_OPEN: int
PRESENT_LEAVING: int
METRICS_CRASHED: int
METRICS_ARRIVED: int

# Agents in slots (libdtsa_sim/swarm.h), on arrays that core/swarm.py owns.

class Swarm: ...  # an opaque handle

def swarm(parameters: dict[str, Any], arrays: dict[str, Array], /) -> Swarm: ...
def decide(swarm: Swarm, slot: int, /) -> None: ...
def emit(swarm: Swarm, slot: int, /) -> tuple[int, ...]: ...
def begin(swarm: Swarm, slot: int, /) -> tuple[int, ...]: ...
def fly(swarm: Swarm, slot: int, /) -> None: ...
def steer(swarm: Swarm, slot: int, step: int, estimate: int, /) -> None: ...
def move(swarm: Swarm, step: int, /) -> None: ...
def estimate(swarm: Swarm, slot: int, step: int, /) -> None: ...
def hear(swarm: Swarm, slot: int, data: bytes, mask: Array | None, /) -> bool: ...
def end(swarm: Swarm, slot: int, /) -> None: ...
def frame(swarm: Swarm, index: int, /) -> bytes: ...
def restart(swarm: Swarm, index: int, /) -> None: ...
def reset(swarm: Swarm, /) -> None: ...

# -> probation, deaf, woke, alive, absent, silent slots
def lease_status(swarm: Swarm, index: int, /) -> tuple[bool, bool, int, int, int, int]: ...

# Sums over a flight (libdtsa_sim/metrics.h), on arrays that dtsa_bench/metrics.py owns.

class Metrics: ...

def metrics(values: dict[str, Any], arrays: dict[str, Array], /) -> Metrics: ...
def update(metrics: Metrics, slot: int, track: Array, tables: Swarm | None, /) -> int: ...

# Frames: a record is the structure of libdtsa/frame.h; its size says which one.

def encode(record: Array, position_step: float, /) -> bytes: ...  # none: not encodable
def decode(data: Array, position_step: float, record: Array, /) -> int: ...  # 0, or a negative fault
def frame_length(profile: int, /) -> int: ...  # 0 for an unknown profile
def lease_state_bytes(agents: int, anchor_every: int, /) -> int: ...

# Parts that need no swarm.

def priority(position: Array, velocity: Array, slot_s: float, out: Array, scratch: Array, /) -> None: ...
def select(
    g: Array, counter: Array, in_ap: Array, epsilon: float, selection: int, candidates: Array, /
) -> tuple[int, int]: ...  # index, reason
def avoid_command(
    kind: int,
    params: Mapping[str, float],
    self_index: int,
    position: Array,
    velocity: Array,
    goal: Array,
    others_p: Array,
    others_v: Array,
    age_s: Array | None,
    command: Array,
    /,
) -> None: ...

# All N agents from one table of beliefs; arrays (3, N), age_s (N,).
def avoid_all(
    kind: int,
    params: Mapping[str, float],
    position: Array,
    velocity: Array,
    goal: Array,
    others_p: Array,
    others_v: Array,
    age_s: Array | None,
    command: Array,
    /,
) -> None: ...
def vehicle_step(tau: float, a_max: float, dt: float, position: Array, velocity: Array, command: Array, /) -> None: ...

# Instructions in use: 0 baseline, 1 AVX2; same bits either way. A level sets it, bounded by the machine.
def vector_level(level: int = -1, /) -> int: ...
