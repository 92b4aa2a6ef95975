"""What happened in the slots of a simulated flight, as arrays that C writes (``libdtsa_sim/run.c``)."""

from __future__ import annotations

import math
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core import Swarm
from dtsa_agent.core.frame import TAG_LENGTH
from dtsa_agent.core.kernel import ffi, lib, memory, shared_arrays
from dtsa_bench.runs.options import check_memory
from dtsa_channel_sim import Verdict

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Bools = NDArray[np.bool_]

_CAPACITY, _FEW, _MUCH = 1024, 64, 1 << 14  # slots to begin with; few of much: states of agents in a slot
_OF_FRAMES = ("received", "data")
_OF_OBSERVER = ("heard_slot", "heard_position", "estimate", "in_ap")


class SlotArrays:
    """A row a slot; agents by index (id - 1). Vectors are m and m/s, frame map. What was not asked for has no rows.

    Where agents send at any instant ``received``, ``lost`` and ``collided`` are zero: frames arrive in other slots.
    """

    # Letters of shapes, after the number of slots S, or of frames F: n agents, k control instants, b bytes of a frame.
    outcome: Annotated[Bytes, ""]  # IDLE, SUCCESS or COLLISION
    sent: Annotated[Bools, "n"]
    lost: Annotated[NDArray[np.uint16], "n"]  # receivers that lost the agent's frame to noise
    collided: Annotated[NDArray[np.uint16], "n"]  # receivers where it collided
    chosen: Annotated[NDArray[np.uint16], "n"]  # id that each took for the sender, 0: nobody
    reason: Annotated[Bytes, "n"]  # index into REASONS
    score: Annotated[Floats, "n"]  # priority g of the chosen, 0 without one
    digest: Annotated[NDArray[np.uint32], "n"]  # of each agent's table
    velocity: Annotated[Floats, "3n"]  # true, at the start of the slot, as command and goal
    command: Annotated[Floats, "3n"]
    goal: Annotated[Floats, "3n"]
    position: Annotated[Floats, "k3n"]  # true, at the control instants, the last at the end of the slot
    heard_slot: Annotated[NDArray[np.int64], "n"]  # of the observer: slots of the states that it has heard, -1: never
    heard_position: Annotated[Floats, "3n"]  # in these states
    estimate: Annotated[Floats, "3n"]  # for the start of the next slot
    in_ap: Annotated[Bytes, "n"]
    received: Annotated[Bools, "n"]  # (F, N) who received each frame, in the order of ``sent.nonzero()``
    data: Annotated[Bytes, "b"]  # (F, B) its bytes

    def __len__(self) -> int:
        return len(self.outcome)

    @property
    def length(self) -> Bytes:
        """(S, N) bytes of the frame that each sent, 0: none."""
        return self.sent * np.uint8(self.data.shape[1])

    def positions(self) -> Floats:
        """True positions at all control instants, (T, 3, N), m, frame map."""
        return self.position.reshape(-1, *self.position.shape[2:])

    def senders(self) -> list[tuple[int, ...]]:
        """Ids of the agents that sent in each slot."""
        ids = (np.nonzero(self.sent)[1] + 1).tolist()
        ends = np.cumsum(self.sent.sum(axis=1)).tolist()
        return [tuple(ids[first:end]) for first, end in zip([0, *ends], ends, strict=False)]


class SlotWriter:
    """Memory that grows with a flight.

    :param swarm: all agents.
    :param observer: id of the agent whose knowledge is kept; 0: none.
    :param frames: keep the bytes of frames.
    """

    def __init__(self, swarm: Swarm, observer: int, frames: bool) -> None:
        config = swarm.config
        self._swarm, self._frames, self._arrays = swarm, frames, SlotArrays()
        sizes = {"n": config.agents, "k": config.steps, "b": config.frame_length, "3": 3}
        self.kernel = ffi.new("sim_log *", {"observer": observer - 1, "frame_bytes": config.frame_length})
        self._lent: dict[str, Any] = {}
        left_out = {*(() if frames else ("data",)), *(() if observer else _OF_OBSERVER)}
        self._kept = [name for name in _ARRAYS if name not in left_out]
        for name, (letters, item) in _ARRAYS.items():
            setattr(self._arrays, name, np.empty((0, *(sizes[letter] for letter in letters)), item))
        slots = _FEW if config.agents * config.steps > _MUCH else _CAPACITY
        self._grow(slots, slots + config.agents)

    def make_room(self) -> None:
        """Make room for further slots."""
        log, agents = self.kernel, self._swarm.config.agents
        if lib.sim_log_is_full(log, agents):
            self._grow(max(log.capacity, 2 * log.rows), max(log.frame_capacity, 2 * log.frames + agents))

    def _grow(self, slots: int, frames: int) -> None:
        log, config = self.kernel, self._swarm.config
        old = {name: getattr(self._arrays, name) for name in self._kept}
        shapes = {name: (frames if name in _OF_FRAMES else slots, *one.shape[1:]) for name, one in old.items()}
        needed = sum(math.prod(shape) * old[name].itemsize for name, shape in shapes.items())
        check_memory(needed, f"{slots} slots of {config.steps} control instants", "agents", config.agents)
        log.capacity, log.frame_capacity = slots, frames
        for name, shape in shapes.items():
            rows, array = log.frames if name in _OF_FRAMES else log.rows, np.empty(shape, old[name].dtype)
            array[:rows] = old[name][:rows]
            setattr(self._arrays, name, array)
            self._lent[name] = memory(array, writable=True)
            setattr(log, name, self._lent[name])

    def open_slot(self) -> None:
        """Begin a slot that Python flies: all have decided, and their frames are encoded."""
        self.make_room()
        lib.sim_log_open(self.kernel, self._swarm.kernel)

    def close_slot(self, slot: int, verdict: Verdict) -> None:
        """End that slot."""
        log, swarm, received, arrays = self.kernel, self._swarm, verdict.received, self._arrays
        row, first = log.rows, log.frames
        mask = ffi.NULL if received is None else memory(np.ascontiguousarray(received))
        lib.sim_log_close(log, swarm.kernel, slot, verdict.outcome, mask)
        index = [sender - 1 for sender in verdict.senders]
        if verdict.lost is not None and verdict.collided is not None:
            arrays.lost[row, index], arrays.collided[row, index] = verdict.lost, verdict.collided
        if self._frames:
            for at, sender in enumerate(index, first):
                arrays.data[at] = np.frombuffer(swarm.frame(sender), np.uint8)

    def finish(self) -> SlotArrays:
        """Return what was written; the room that was not needed is given back."""
        log, arrays, swarm = self.kernel, self._arrays, self._swarm
        self._lent.clear()
        for name in self._kept:
            array = getattr(arrays, name)
            array.resize((log.frames if name in _OF_FRAMES else log.rows, *array.shape[1:]), refcheck=False)
        arrays.sent, arrays.received = arrays.sent.view(np.bool_), arrays.received.view(np.bool_)
        if self._frames and swarm.authenticator is not None and swarm.all_in_c:  # C does not sign
            for row, slot in zip(arrays.data, np.nonzero(arrays.sent)[0].tolist(), strict=True):
                signed = swarm.authenticator.seal(row[:-TAG_LENGTH].tobytes(), slot)
                row[:] = np.frombuffer(signed, np.uint8)
        return arrays


_ARRAYS = shared_arrays(SlotArrays, "sim_log")
