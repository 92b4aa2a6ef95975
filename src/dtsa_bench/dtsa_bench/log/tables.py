"""Tables of a flight for pandas, polars and spreadsheets: data frames, Parquet or CSV, with documented columns."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from dtsa_agent.core.errors import ConfigError, RemoteProtocolError
from dtsa_agent.core.frame import decode_frame
from dtsa_agent.core.registry import REASON_TEXTS, REASONS
from dtsa_bench.runs.options import check_free
from dtsa_channel_sim.model.verdict import OUTCOMES

from .arrays import FlightArrays, extent_of
from .bag.errors import BagError
from .knowledge import ObservedPairs, knowledge_of, observed, why_without_ages

if TYPE_CHECKING:
    import pandas as pd

FORMATS = ("parquet", "csv")
ROWS = 1 << 20  # rows of a table that are in memory at once, while it is written
AXES = "xyz"
_PAIR = "whether the pair counts in the results: the observer still has the agent in A_p, and the agent moves"

# Columns by table: name, unit, meaning.
COLUMNS: dict[str, list[tuple[str, str, str]]] = {
    "slots": [
        ("slot", "1", "number of the slot, from 0"),
        ("time_s", "s", "start of the slot, counted from the start of slot 0"),
        ("outcome", "", "the channel's verdict: idle, success, collision (merged: two or more sent); empty: not known"),
        ("senders", "1", "agents that sent; empty: not known"),
        ("sender", "", "id of the first of them; 0: none; empty: not known"),
    ],
    "frames": [
        ("slot", "1", "slot in which the frame was sent"),
        ("time_s", "s", "start of that slot"),
        ("sender", "", "id of the agent that sent it"),
        ("received", "1", "agents that received it"),
        ("lost", "1", "agents that lost it to noise (merged: that did not receive it, for whatever reason)"),
        ("collided", "1", "agents at which it collided with another frame; empty: not known"),
        ("length", "byte", "length of the frame"),
        ("data", "", "the frame, hexadecimal"),
        ("c_r", "1", "transmission parameter in the frame; 0: arrived; empty if the frame cannot be decoded"),
        *((f"position_{axis}_m", "m", f"position {axis} in the frame, frame map") for axis in AXES),
        *((f"velocity_{axis}_mps", "m/s", f"velocity {axis} in the frame, frame map") for axis in AXES),
    ],
    "receptions": [
        ("slot", "1", "slot in which the frame was sent"),
        ("time_s", "s", "start of that slot"),
        ("sender", "", "id of the agent that sent it"),
        ("receiver", "", "id of another agent"),
        ("received", "", "whether that one received it; empty: not known"),
    ],
    "decisions": [
        ("slot", "1", "slot that was decided about"),
        ("time_s", "s", "start of that slot"),
        ("agent", "", "id of the agent that decided"),
        ("chosen", "", "id of the agent that it expects to send; 0: none"),
        ("reason", "", "why, by name; see below"),
        ("score", "1", "priority value g of the chosen agent, 0 where the policy has none"),
        ("digest", "", "digest of the agent's table: equal digests, equal tables"),
    ],
    "states": [
        ("time_s", "s", "time of the state, counted from the start of slot 0"),
        ("agent", "", "id"),
        *((f"position_{axis}_m", "m", f"true position {axis}, frame map") for axis in AXES),
        *((f"velocity_{axis}_mps", "m/s", f"true velocity {axis}, frame map") for axis in AXES),
    ],
    "ages": [
        ("slot", "1", "the slot at whose end this holds; the results count from slot N - 1 on"),
        ("time_s", "s", "end of that slot"),
        ("agent", "", "id of the agent that is known"),
        ("observers", "1", "how many others have it in A_p and have heard it; 0 for agents that hover"),
        ("age_slots", "slots", "mean age of what they know: 0 if heard in this very slot; empty without observers"),
        ("error_m", "m", "mean distance between where they take it to be and where it is; empty without observers"),
    ],
    "ages_by_observer": [
        ("slot", "1", "the slot at whose end this holds; the results count from slot N - 1 on"),
        ("time_s", "s", "end of that slot"),
        ("observer", "", "id of the agent that knows"),
        ("agent", "", "id of the agent that is known; rows begin when the observer first hears it"),
        ("age_slots", "slots", "slots since the state was sent that the observer last heard; 0: in this very slot"),
        ("error_m", "m", "distance between where the observer takes the agent to be and where it is; empty: not known"),
        ("counted", "", _PAIR),
    ],
    "distances": [
        ("time_s", "s", "control instant, counted from the start of slot 0"),
        ("distance_m", "m", "smallest distance of any two agents"),
    ],
}  # fmt: skip
_TEXTS = ("outcome", "reason", "data")


def _pandas() -> Any:
    try:
        import pandas
    except ImportError:
        allowed = "an installed pandas: tables are its data frames (pip install pandas)"
        raise ConfigError("pandas", None, allowed) from None
    return pandas


def table(log: FlightArrays, name: str) -> pd.DataFrame:
    """A table of a flight.

    :raises ConfigError: if pandas is missing.
    """
    pandas = _pandas()
    frames = [pandas.DataFrame(block) for block in _BUILDERS[name](log)]
    return frames[0] if len(frames) == 1 else pandas.concat(frames, ignore_index=True)


def _masked(values: Any, unknown: Any) -> Any:
    """Whole numbers or truth values, some of which are not known."""
    pandas = _pandas()
    if not np.any(unknown):
        return values
    kind = pandas.arrays.BooleanArray if values.dtype == np.bool_ else pandas.arrays.IntegerArray
    return kind(values, np.ascontiguousarray(unknown))


def _texts(names: Any, index: Any, unknown: Any = None) -> Any:
    found = np.array(names, dtype=object)[index]
    if unknown is not None:
        found[unknown] = None
    return found


Block = dict[str, Any]


def _slots(log: FlightArrays) -> Iterator[Block]:
    here = np.flatnonzero(log.recorded)
    sent, unknown = log.sent[here], ~log.outcome_known[here]
    yield {
        "slot": here,
        "time_s": log.time_s(here),
        "outcome": _texts((*OUTCOMES, ""), log.outcome[here], unknown),
        "senders": _masked(sent.sum(axis=1), unknown),
        "sender": _masked(np.where(sent.any(axis=1), sent.argmax(axis=1) + 1, 0), unknown),
    }


def _frames(log: FlightArrays) -> Iterator[Block]:
    frames, extent, inside = log.sent_frames, extent_of(log.settings), _opener(log)
    decoded = [_decode(inside(data), extent) for data in frames.data]
    values = np.array([row[1:] for row in decoded], np.float64).reshape(-1, 6)
    c_r = np.array([-1 if row[0] is None else row[0] for row in decoded], np.int64)
    block: Block = {
        "slot": frames.row,
        "time_s": log.time_s(frames.row),
        "sender": frames.sender,
        "received": frames.received.sum(axis=1),
        "lost": frames.lost,
        "collided": _masked(frames.collided, np.full(len(frames.row), log.merged is not None)),
        "length": np.array([len(data) for data in frames.data], np.int64),
        "data": np.array([data.hex() for data in frames.data], dtype=object),
        "c_r": _masked(c_r, c_r < 0),
    }
    names = [f"position_{axis}_m" for axis in AXES] + [f"velocity_{axis}_mps" for axis in AXES]
    yield block | {name: values[:, index] for index, name in enumerate(names)}


def _opener(log: FlightArrays) -> Callable[[bytes], bytes]:
    """A function that takes from a frame what authentication and plug-ins have appended to it."""
    config = log.usable_config
    if config is None:
        return lambda data: data
    return lambda data: config.swarm.protocol_part(data, sealed=True)


def _decode(data: bytes, extent_m: float) -> tuple[Any, ...]:
    try:
        frame = decode_frame(data, extent_m)
    except RemoteProtocolError:
        return (None,) * 7
    return (frame.c_r, *frame.position, *frame.velocity)


def _receptions(log: FlightArrays) -> Iterator[Block]:
    frames, ids = log.sent_frames, np.arange(1, log.agents + 1)
    row, column = np.nonzero(ids[None, :] != frames.sender[:, None])
    slots, received = frames.row[row], frames.received[row, column]
    unknown = ~(received | log.known[slots, column]) if log.merged is not None else np.zeros(len(row), np.bool_)
    yield {
        "slot": slots,
        "time_s": log.time_s(slots),
        "sender": frames.sender[row],
        "receiver": ids[column],
        "received": _masked(received, unknown),
    }


def _decisions(log: FlightArrays) -> Iterator[Block]:
    slots, column = np.nonzero(log.known)
    names = [*REASONS, *(str(code) for code in range(len(REASONS), 256))]
    yield {
        "slot": slots,
        "time_s": log.time_s(slots),
        "agent": column + 1,
        "chosen": log.chosen[slots, column].astype(np.int64),
        "reason": _texts(names, log.reason[slots, column]),
        "score": log.score[slots, column],
        "digest": log.digest[slots, column],
    }


def _states(log: FlightArrays) -> Iterator[Block]:
    time_s, path = log.instants_s, log.path
    block: Block = {
        "time_s": np.repeat(time_s, log.agents),
        "agent": np.tile(np.arange(1, log.agents + 1), len(time_s)),
    }
    for values, form in ((path, "position_{}_m"), (log.path_velocity, "velocity_{}_mps")):
        block |= {form.format(axis): values[:, index].ravel() for index, axis in enumerate(AXES)}
    if log.merged is not None:  # no rows for those of whom there is no record
        known = np.isfinite(path).all(axis=1).ravel()
        block = {name: values[known] for name, values in block.items()}
    yield block


def _ages(log: FlightArrays) -> Iterator[Block]:
    ages = knowledge_of(log).ages
    slot = np.repeat(np.arange(0 if ages is None else len(log)), log.agents)
    none = np.zeros(0)
    yield {
        "slot": slot,
        "time_s": log.time_s(slot + 1),
        "agent": np.tile(np.arange(1, log.agents + 1), len(slot) // log.agents),
        "observers": none.astype(np.int64) if ages is None else ages.observers.ravel(),
        "age_slots": none if ages is None else ages.age.ravel(),
        "error_m": none if ages is None else ages.error.ravel(),
    }


_OF_PAIRS: dict[str, tuple[str, Any]] = {  # columns, of which field of ObservedPairs, and of which kind
    "observer": ("observer", np.int64), "agent": ("agent", np.int64), "age_slots": ("age", np.int64),
    "error_m": ("error", np.float64), "counted": ("counted", np.bool_),
}  # fmt: skip


def _ages_by_observer(log: FlightArrays) -> Iterator[Block]:
    waiting: list[ObservedPairs] = []
    rows, is_first = 0, True
    for pairs in chain(observed(log), [None]):
        if pairs is not None:
            waiting.append(pairs)
            rows += len(pairs.agent)
        if rows >= ROWS or (pairs is None and (rows or is_first)):
            slot = np.concatenate([np.zeros(0, np.int64), *(np.full(len(part.agent), part.slot) for part in waiting)])
            yield {"slot": slot, "time_s": log.time_s(slot + 1), **{
                name: np.concatenate([np.zeros(0, kind), *(getattr(part, field) for part in waiting)])
                for name, (field, kind) in _OF_PAIRS.items()
            }}  # fmt: skip
            waiting, rows, is_first = [], 0, False


def _distances(log: FlightArrays) -> Iterator[Block]:
    path = log.path
    closest = np.full(len(path), np.inf)
    for k in range(path.shape[2] - 1):
        between = np.linalg.norm(path[:, :, k + 1 :] - path[:, :, k : k + 1], axis=1)
        closest = np.fmin(closest, np.nanmin(between, axis=1, initial=np.inf))
    yield {"time_s": log.instants_s, "distance_m": closest}


_BUILDERS: Mapping[str, Callable[[FlightArrays], Iterator[Block]]] = {
    "slots": _slots, "frames": _frames, "receptions": _receptions, "decisions": _decisions, "states": _states,
    "ages": _ages, "ages_by_observer": _ages_by_observer, "distances": _distances,
}  # fmt: skip


# -- files -----------------------------------------------------------------------------------------------------------
class ExportedTable(NamedTuple):
    """One table that was written."""

    path: Path
    rows: int


def export(
    log: FlightArrays | Callable[[], FlightArrays],
    directory: str | Path,
    kind: str = "parquet",
    tables: Collection[str] | None = None,
    note: Callable[[str], None] | None = None,
) -> list[ExportedTable]:
    """Write the tables of a flight and a description of their columns.

    :param log: the flight, or what reads it once the rest has been checked.
    :param directory: where they go; must not exist, or be empty.
    :param tables: names from `COLUMNS`; None: all.
    :param note: receives what is left out, and why.
    :raises ConfigError: for unusable settings and bags.
    :raises BagError: if the files cannot be written.
    """
    if kind not in FORMATS:
        raise ConfigError("to", kind, " or ".join(FORMATS))
    for name in tables or ():
        if name not in COLUMNS:
            raise ConfigError("tables", name, ", ".join(COLUMNS))
    target = Path(directory)
    check_free(target)
    flight = log() if callable(log) else log
    # Written to a directory of its own, and moved to their places when all are whole.
    new, part = not target.exists(), target / ".part"
    written = []
    try:
        part.mkdir(parents=True)
        for name in COLUMNS if tables is None else [name for name in COLUMNS if name in tables]:
            file = f"{name}.{kind}"
            written.append(ExportedTable(target / file, _write(part / file, kind, name, _BUILDERS[name](flight))))
        has_ages = tables is None or {"ages", "ages_by_observer"} & set(tables)
        if note and has_ages and (why := why_without_ages(flight)):
            note(why)
        (part / "columns.md").write_text(describe(), encoding="utf-8")
        for whole in sorted(part.iterdir()):
            whole.replace(target / whole.name)
        part.rmdir()
    except OSError as error:
        raise BagError(f"cannot export to {target}: {error.strerror or error}") from error
    finally:
        if part.exists():
            shutil.rmtree(target if new else part, ignore_errors=True)
    return written


def _write(file: Path, kind: str, name: str, blocks: Iterator[Block]) -> int:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    notes = {column: {"unit": unit, "meaning": meaning} for column, unit, meaning in COLUMNS[name]}
    writer: Any = None
    rows = 0
    try:
        for block in blocks:
            columns = {
                name: pa.array(values, pa.string() if name in _TEXTS else None, from_pandas=True)
                for name, values in block.items()
            }
            found = pa.table(columns)
            if writer is None:
                schema = pa.schema([field.with_metadata(notes[field.name]) for field in found.schema])
                make = pyarrow.parquet.ParquetWriter if kind == "parquet" else pyarrow.csv.CSVWriter
                writer = make(str(file), schema)
            writer.write_table(found.cast(schema))
            rows += found.num_rows
    finally:
        if writer is not None:
            writer.close()
    return rows


_HEAD = """\
# Columns of the tables

Of `tools/dtsa export` and of the data frames of `import dtsa`. Ids begin at 1. Times are simulated and count
from the start of slot 0. Frame `map` has its origin in the room's centre (ENU: x and y level, z up).

Of a bag that `tools/dtsa merge` has made, slot 0 is the first slot that all agents counted alike; the number that the
agents gave it is in the bag. Values that no agent's bag holds are empty there, or have no row: decisions, states and
observers of an agent without a bag, what it sent in slots in which nobody heard it, and whether it received.
"""


def describe() -> str:
    """The columns of all tables as Markdown."""
    parts = [_HEAD]
    for table, columns in COLUMNS.items():
        parts.append(f"\n## {table}\n\n| column | unit | meaning |\n|---|---|---|\n")
        parts.extend(f"| `{name}` | {unit} | {meaning} |\n" for name, unit, meaning in columns)
    parts.append("\n## Reasons\n\n| reason | meaning |\n|---|---|\n")
    parts.extend(f"| `{name}` | {text} |\n" for name, text in REASON_TEXTS.items())
    return "".join(parts)
