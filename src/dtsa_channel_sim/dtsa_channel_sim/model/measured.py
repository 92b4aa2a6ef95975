"""Losses that were measured: a two-state chain for each directed link, from a file that `dtsa losses` has written."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting

from .gilbert import GilbertElliott
from .topology import Matrix, parse_matrix

FORMAT = "dtsa-losses 2"
#: Matrices of a file, (N, N), row = sender: P(good -> bad) and P(bad -> good) per slot, loss in each state.
NUMBERS = ("enter", "leave", "loss_good", "loss_bad")
_SLOT_NS = Setting("slot_ns", "int", None, "length of a slot; 0: not known", unit="ns", minimum=0, maximum=10**12)
_MOST_BYTES = 1 << 28


@dataclass(frozen=True, slots=True, repr=False)
class MeasuredLosses:
    """Content of a file of losses. A bag holds all of it, so no reader needs the file again."""

    name: str  # of the file
    sha256: str  # of its bytes, hexadecimal
    slot_ns: int  # ns, length of the slots in which the chains move; 0: not known
    enter: Matrix  # (N, N) P(good -> bad) per slot of each link, row = sender
    leave: Matrix  # (N, N) P(bad -> good)
    loss_good: Matrix  # (N, N) loss in the good state
    loss_bad: Matrix  # (N, N) loss in the bad state

    def __repr__(self) -> str:
        """The name of the file, and the beginning of its hash."""
        return f"{self.name} ({self.sha256[:12]})"

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], name: str = "", sha256: str = "") -> MeasuredLosses:
        """Return the losses that plain values say: those of :meth:`to_dict`, or of a file; further names are notes.

        :raises ConfigError: naming the part that is wrong.
        """
        if values.get("format", FORMAT) != FORMAT:
            raise ConfigError("losses.format", values["format"], FORMAT)
        enter = values.get("enter")
        agents = len(enter) if isinstance(enter, (list, tuple)) else 0
        matrices = [parse_matrix(values.get(key), agents, f"losses.{key}") for key in NUMBERS]
        for key, matrix in zip(NUMBERS, matrices, strict=True):
            if not matrix:
                raise ConfigError(f"losses.{key}", None, "a matrix: a row for each sender, a number for each receiver")
        moves = np.add(matrices[0], matrices[1])
        if (moves > 1.0 + 1e-12).any():
            row, column = np.argwhere(moves > 1.0 + 1e-12)[0]
            allowed = f"at most 1 - enter, {1.0 - matrices[0][row][column]:g}"
            raise ConfigError(f"losses.leave[{row}][{column}]", matrices[1][row][column], allowed)
        slot_ns = _SLOT_NS.check(values.get("slot_ns", 0), "losses.slot_ns")
        return cls(str(values.get("name", name)), str(values.get("sha256", sha256)), slot_ns, *matrices)

    def to_dict(self) -> dict[str, Any]:
        """Return the losses as :meth:`from_dict` reads them."""
        matrices = {key: [list(row) for row in getattr(self, key)] for key in NUMBERS}
        return {"name": self.name, "sha256": self.sha256, "slot_ns": self.slot_ns, **matrices}

    def check(self, agents: int, slot_ns: int) -> None:
        """Check that the losses fit a swarm.

        :raises ConfigError: when they do not.
        """
        if self.slot_ns and self.slot_ns != slot_ns:
            allowed = f"slots of {slot_ns / 1e6:g} ms, as in the swarm: chains move once a slot"
            raise ConfigError("losses", f"{self.name}, measured in slots of {self.slot_ns / 1e6:g} ms", allowed)
        if len(self.enter) < agents:
            raise ConfigError("losses", f"{self.name}, of {len(self.enter)} agents", f"one of {agents} agents or more")

    def fitted(self, agents: int) -> tuple[GilbertElliott, NDArray[np.float64], NDArray[np.float64]]:
        """Return the chains of the links between the first agents, and their losses in either state, (N, N)."""
        enter, leave, good, bad = (np.array(getattr(self, key))[:agents, :agents] for key in NUMBERS)
        moves = enter + leave
        leave[moves == 0.0] = 1.0  # a chain that never moves is in its good state
        share = np.divide(enter, moves, out=np.zeros_like(enter), where=moves > 0.0)
        return GilbertElliott(share, enter, leave), good, bad


def losses_of(value: object) -> MeasuredLosses | str:
    """Return the losses that a setting means: path of a file, plain values, or losses; empty text: none.

    :raises ConfigError: naming the part that is wrong.
    """
    if isinstance(value, MeasuredLosses):
        return value
    if isinstance(value, Mapping):
        return MeasuredLosses.from_dict(value)
    if not isinstance(value, str | Path):
        raise ConfigError("losses", value, "path of a file that `losses` has written")
    return _read(Path(value)) if str(value) else ""


def _read(path: Path) -> MeasuredLosses:
    import hashlib  # an agent in flight has the settings of channels in memory, and no need of hashes

    try:
        with path.open("rb") as file:
            data = file.read(_MOST_BYTES + 1)
        if len(data) > _MOST_BYTES:
            raise ValueError(f"more than {_MOST_BYTES} bytes")
        content: Any = json.loads(data)
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError("losses", str(path), f"a file of JSON that `losses` has written ({error})") from None
    if not isinstance(content, Mapping):
        raise ConfigError("losses", str(path), "a file that `losses` has written: names with values")
    return MeasuredLosses.from_dict({**content, "name": path.name, "sha256": hashlib.sha256(data).hexdigest()})
