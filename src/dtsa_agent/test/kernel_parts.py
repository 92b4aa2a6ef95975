"""Parts of the compiled core that swarms use from within: priorities, selection and avoiders, on plain arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dtsa_agent.core.kernel import NAMES, ffi, lib, memory
from dtsa_agent.core.settings.flight_models import FlightModel


def priority(position: ArrayLike, velocity: ArrayLike, slot_s: float) -> NDArray[np.float64]:
    """Priorities g of all agents, (N,) (eq:permission_d_p_ang), from positions and velocities, (N, 3)."""
    p, v = (np.ascontiguousarray(np.asarray(values, dtype=np.float64).T) for values in (position, velocity))
    agents = p.shape[1]
    g, scratch = np.zeros(agents), np.empty(lib.priority_scratch_doubles(agents))
    lib.priority_values(agents, slot_s, *map(memory, (p, v, g, scratch)))
    return g


def select(
    g: ArrayLike, counter: ArrayLike, in_ap: ArrayLike, epsilon: float = 0.5, selection: str = "candidates"
) -> tuple[int, NDArray[np.bool_], int]:
    """Index of the next sender (-1: nobody) (eq:pfs, eq:secondary), the candidates (N,), and index into REASONS."""
    kinds = ((g, np.float64), (counter, np.int64), (in_ap, np.uint8))
    arrays = [np.ascontiguousarray(values, dtype=kind) for values, kind in kinds]
    candidates, reason = np.zeros(len(arrays[0]), dtype=np.bool_), ffi.new("int *")
    number = NAMES["selections"].index(selection)
    index = lib.select_sender(
        len(candidates), number, epsilon, *map(memory, arrays), memory(candidates, writable=True), reason
    )
    return index, candidates, reason[0]


def avoid(
    model: FlightModel, index: int, position: ArrayLike, velocity: ArrayLike, goal: ArrayLike,
    others_position: ArrayLike, others_velocity: ArrayLike, age: ArrayLike | None = None,
) -> NDArray[np.float64]:  # fmt: skip
    """Commanded velocity of one agent, (3,), from its state and goal, and where it believes all to be, (3, N)."""
    given = (position, velocity, goal, others_position, others_velocity, [] if age is None else age)
    arrays = [np.ascontiguousarray(values, dtype=np.float64) for values in given]
    agents, command = arrays[3].shape[1], np.zeros(3)
    scratch = ffi.new("double[]", lib.avoid_scratch_doubles(agents))
    params = ffi.new("dtsa_avoid_params *", model.avoider.to_dict())
    *planes, ages = map(memory, arrays)
    ages = ffi.NULL if age is None else ages
    lib.avoid_command(model.kind, params, agents, index, *planes, ages, scratch, memory(command, writable=True))
    return command
