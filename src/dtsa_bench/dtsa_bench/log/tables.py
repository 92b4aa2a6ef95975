"""Tables of a flight for pandas, polars and spreadsheets: data frames, Parquet or CSV, with documented columns."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import chain, islice
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
_PAIR = (
    "whether the pair counts in the results: the observer still has the agent in A_p, and the agent moves (merged: and "
    "the slot is one of the results)"
)
_RESULTS = "the slot at whose end this holds; the results count from slot N - 1 on (merged: those that its notes name)"

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
        ("lost", "1", "agents that lost it to noise (merged, or without slots: that did not receive it)"),
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
        ("receiver", "", "id of another agent that was there"),
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
        ("slot", "1", _RESULTS),
        ("time_s", "s", "end of that slot"),
        ("agent", "", "id of the agent that is known"),
        ("observers", "1", "how many others have it in A_p and have heard it; 0 for agents that hover"),
        ("age_slots", "slots", "mean age of what they know: 0 if heard in this very slot; empty without observers"),
        ("error_m", "m", "mean distance between where they take it to be and where it is; empty without observers"),
    ],
    "ages_by_observer": [
        ("slot", "1", _RESULTS),
        ("time_s", "s", "end of that slot"),
        ("observer", "", "id of the agent that knows"),
        ("agent", "", "id of the agent that is known; rows begin when the observer first hears it"),
        ("age_slots", "slots", "slots since the state was sent that the observer last heard; 0: in this very slot"),
        ("error_m", "m", "distance between where the observer takes the agent to be and where it is; empty: not known"),
        ("counted", "", _PAIR),
    ],
    "distances": [
        ("time_s", "s", "control instant, counted from the start of slot 0"),
        ("distance_m", "m", "smallest distance of any two agents; empty: not known"),
    ],
}  # fmt: skip
_TEXTS = ("outcome", "reason", "data")

Columns = Sequence[Any]  # values of a table's columns, in the order of `COLUMNS`


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
    frames = [pandas.DataFrame(block) for block in _blocks(log, name)]
    return frames[0] if len(frames) == 1 else pandas.concat(frames, ignore_index=True)


def _blocks(log: FlightArrays, name: str) -> Iterator[dict[str, Any]]:
    """Rows of a table, by columns; a large table is several blocks."""
    names = [column for column, _, _ in COLUMNS[name]]
    blocks = _ages_by_observer(log) if name == "ages_by_observer" else [_BUILDERS[name](log)]
    return (dict(zip(names, block, strict=True)) for block in blocks)


def _masked(values: Any, unknown: Any) -> Any:
    """Whole numbers or truth values, some of which are not known."""
    pandas = _pandas()
    if not np.any(unknown):
        return values
    kind = pandas.arrays.BooleanArray if values.dtype == np.bool_ else pandas.arrays.IntegerArray
    return kind(values, np.ascontiguousarray(unknown))


def _slots(log: FlightArrays) -> Columns:
    here = np.flatnonzero(log.recorded)
    sent, unknown = log.sent[here], ~log.outcome_known[here]
    outcome = np.array((*OUTCOMES, ""), dtype=object)[log.outcome[here]]
    outcome[unknown] = None
    first = np.where(sent.any(axis=1), sent.argmax(axis=1) + 1, 0)
    return here, log.time_s(here), outcome, _masked(sent.sum(axis=1), unknown), _masked(first, unknown)


def _frames(log: FlightArrays) -> Columns:
    frames, extent, config = log.sent_frames, extent_of(log.settings), log.usable_config
    plain = frames.data if config is None else [config.swarm.protocol_part(data, sealed=True) for data in frames.data]
    c_r, *vectors = np.array([_decode(data, extent) for data in plain], np.float64).reshape(-1, 7).T
    unknown = np.isnan(c_r)
    return (
        frames.row, log.time_s(frames.row), frames.sender, log.reached.sum(axis=1), frames.lost,
        _masked(frames.collided, np.full(len(frames.row), log.merged is not None or log.unslotted)),
        np.array([len(data) for data in frames.data], np.int64), np.array([data.hex() for data in frames.data], object),
        _masked(np.where(unknown, -1, c_r).astype(np.int64), unknown), *vectors,
    )  # fmt: skip


def _decode(data: bytes, extent_m: float) -> tuple[float, ...]:
    """c_r, position and velocity in a frame; not numbers if it cannot be decoded."""
    try:
        frame = decode_frame(data, extent_m)
    except RemoteProtocolError:
        return (np.nan,) * 7
    return (frame.c_r, *frame.position, *frame.velocity)


def _receptions(log: FlightArrays) -> Columns:
    frames, ids = log.sent_frames, np.arange(1, log.agents + 1)
    row, column = np.nonzero(log.receivers if log.merged is None else ids != frames.sender[:, None])
    slots, received = frames.row[row], _masked(frames.received[row, column], ~log.receivers[row, column])
    return slots, log.time_s(slots), frames.sender[row], ids[column], received


def _decisions(log: FlightArrays) -> Columns:
    slots, column = np.nonzero(log.known)
    reasons = np.array([*REASONS, *(str(code) for code in range(len(REASONS), 256))], dtype=object)
    chosen, reason, score, digest = (
        getattr(log, name)[slots, column] for name in ("chosen", "reason", "score", "digest")
    )
    return slots, log.time_s(slots), column + 1, chosen.astype(np.int64), reasons[reason], score, digest


def _states(log: FlightArrays) -> Columns:
    time_s, agents = log.instants_s, np.arange(1, log.agents + 1)
    vectors = [values[:, axis].ravel() for values in (log.path, log.path_velocity) for axis in range(3)]
    columns = [np.repeat(time_s, log.agents), np.tile(agents, len(time_s)), *vectors]
    if log.merged is None:
        return columns
    known = np.isfinite(log.path).all(axis=1).ravel()  # no rows for those of whom there is no record
    return [values[known] for values in columns]


def _ages(log: FlightArrays) -> Columns:
    ages, none = knowledge_of(log).ages, np.zeros(0)
    if ages is None:
        return [none.astype(kind) for kind in (np.int64, float, np.int64, np.int64, float, float)]
    slot, agent = (place.ravel() for place in np.indices(ages.age.shape))
    return slot, log.time_s(slot + 1), agent + 1, ages.observers.ravel(), ages.age.ravel(), ages.error.ravel()


def _ages_by_observer(log: FlightArrays) -> Iterator[Columns]:
    none = np.zeros(0, np.int64)
    empty = ObservedPairs(none, none, none, none, np.zeros(0), none.astype(np.bool_))
    pairs = observed(log)
    for slots in chain([next(pairs, empty)], pairs):
        part = [slots, *islice(pairs, max(0, ROWS // log.agents**2 - 1))]
        slot, *others = (np.concatenate(columns) for columns in zip(*part, strict=True))
        yield slot, log.time_s(slot + 1), *others


def _distances(log: FlightArrays) -> Columns:
    path = log.path
    closest = np.full(len(path), np.inf)
    for k in range(path.shape[2] - 1):
        between = np.linalg.norm(path[:, :, k + 1 :] - path[:, :, k : k + 1], axis=1)
        closest = np.fmin(closest, np.nanmin(between, axis=1, initial=np.inf))
    return log.instants_s, np.where(np.isfinite(closest), closest, np.nan)


_BUILDERS: Mapping[str, Callable[[FlightArrays], Columns]] = {
    "slots": _slots, "frames": _frames, "receptions": _receptions, "decisions": _decisions, "states": _states,
    "ages": _ages, "distances": _distances,
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
            written.append(ExportedTable(target / file, _write(part / file, kind, name, _blocks(flight, name))))
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


def _write(file: Path, kind: str, name: str, blocks: Iterator[dict[str, Any]]) -> int:
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    notes = {column: {"unit": unit, "meaning": meaning} for column, unit, meaning in COLUMNS[name]}
    kinds = {column: pa.string() if column in _TEXTS else None for column in notes}
    make = pyarrow.parquet.ParquetWriter if kind == "parquet" else pyarrow.csv.CSVWriter
    rows, schema = 0, None
    with ExitStack() as stack:
        for block in blocks:
            part = pa.table({key: pa.array(values, kinds[key], from_pandas=True) for key, values in block.items()})
            if schema is None:
                schema = pa.schema([field.with_metadata(notes[field.name]) for field in part.schema])
                writer = stack.enter_context(make(str(file), schema))
            writer.write_table(part.cast(schema))
            rows += part.num_rows
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
