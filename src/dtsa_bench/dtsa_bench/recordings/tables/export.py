"""Tables of a recorded run for pandas, polars and spreadsheets: Parquet or CSV, with documented columns."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError, DtsaError, RemoteProtocolError
from dtsa_agent.core.frame import decode_frame
from dtsa_bench.recordings.bag.errors import BagError
from dtsa_bench.recordings.bag.run import OUTCOMES, RecordedRun, extent_of, load_run, recorded_config

from .ages import follow_run, observed, why_without_ages
from .columns import AXES, COLUMNS, describe
from .followed import Followed

FORMATS = ("parquet", "csv")
ROWS = 65536  # rows that are in memory as a table at once


@dataclass(frozen=True, slots=True)
class Exported:
    """One table that was written."""

    path: Path
    rows: int


def export(
    path: str | Path,
    directory: str | Path,
    kind: str = "parquet",
    tables: Collection[str] | None = None,
    progress: Callable[[str], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> list[Exported]:
    """Write the tables of a bag and a description of their columns.

    :param directory: where they go; must not exist, or be empty.
    :param tables: names from `COLUMNS`; None: all.
    :raises ConfigError: for unusable settings and bags.
    :raises BagError: if the files cannot be written.
    """
    if kind not in FORMATS:
        raise ConfigError("to", kind, " or ".join(FORMATS))
    for name in tables or ():
        if name not in COLUMNS:
            raise ConfigError("tables", name, ", ".join(COLUMNS))
    target = Path(directory)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ConfigError("out", str(directory), "a directory that is empty or does not exist yet")
    run = load_run(path)
    # Written to a directory of its own, and moved to their places when all are whole.
    new, part = not target.exists(), target / ".part"
    written = []
    try:
        part.mkdir(parents=True)
        for name, rows in _TABLES.items():
            if tables is not None and name not in tables:
                continue
            if progress:
                progress(name)
            file = f"{name}.{kind}"
            written.append(Exported(target / file, _write(part / file, kind, name, rows(run))))
        if note and (tables is None or {"ages", "ages_by_observer"} & set(tables)) and (why := why_without_ages(run)):
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


def arrow_table(run: RecordedRun, name: str) -> pa.Table:
    """One table of a run in memory."""
    return pa.concat_tables([pa.table(batch) for batch in _TABLES[name](run)])


def _write(file: Path, kind: str, name: str, batches: Iterator[dict[str, Any]]) -> int:
    notes = {column: {"unit": unit, "meaning": meaning} for column, unit, meaning in COLUMNS[name]}
    writer: Any = None
    rows = 0
    try:
        for batch in batches:
            table = pa.table(batch)
            if writer is None:
                fields = [field.with_metadata(notes[field.name]) for field in table.schema]
                schema = pa.schema(fields)
                make = pyarrow.parquet.ParquetWriter if kind == "parquet" else pyarrow.csv.CSVWriter
                writer = make(str(file), schema)
            writer.write_table(table.cast(schema))
            rows += table.num_rows
    finally:
        if writer is not None:
            writer.close()
    return rows


def _pieces(count: int, width: int = 1) -> Iterator[slice]:
    """Slices that together cover `count` steps of `width` rows each, about `ROWS` rows in each slice.

    Without any rows there is one empty slice, so that the columns are written anyway.
    """
    step = max(1, ROWS // max(1, width))
    for start in range(0, max(count, 1), step):
        yield slice(start, start + step)


def _slots(run: RecordedRun) -> Iterator[dict[str, Any]]:
    counts = np.zeros(len(run.slots), np.int64)
    places = np.searchsorted(run.slots, run.frames.slot)
    known = places < len(counts)
    np.add.at(counts, places[known], 1)
    first = np.zeros(len(run.slots), np.int64)
    first[places[known][::-1]] = run.frames.sender[known][::-1]  # the first of several is written last
    names = np.array(OUTCOMES)
    unknown = ~run.outcome_known
    for piece in _pieces(len(run.slots)):
        yield {
            "slot": run.slots[piece],
            "time_s": run.time_s(run.slots[piece]),
            "outcome": pa.array(names[run.outcome[piece]].tolist(), pa.string(), mask=unknown[piece]),
            "senders": pa.array(counts[piece], mask=unknown[piece]),
            "sender": pa.array(first[piece], mask=unknown[piece]),
        }


def _frames(run: RecordedRun) -> Iterator[dict[str, Any]]:
    frames, extent, inside = run.frames, extent_of(run.config), _opener(run.config)
    for piece in _pieces(len(frames.slot)):
        decoded = [_decode(inside(data), extent) for data in frames.data[piece]]
        batch: dict[str, Any] = {
            "slot": frames.slot[piece],
            "time_s": run.time_s(frames.slot[piece]),
            "sender": frames.sender[piece],
            "received": frames.received[piece].sum(axis=1),
            "lost": frames.lost[piece],
            "collided": pa.array(frames.collided[piece], mask=np.full(len(decoded), run.merged is not None)),
            "length": np.array([len(data) for data in frames.data[piece]], np.int64),
            "data": pa.array([data.hex() for data in frames.data[piece]], pa.string()),
            "c_r": pa.array([values[0] for values in decoded], pa.int64()),
        }
        names = [f"position_{axis}_m" for axis in AXES] + [f"velocity_{axis}_mps" for axis in AXES]
        for index, name in enumerate(names, 1):
            batch[name] = pa.array([values[index] for values in decoded], pa.float64())
        yield batch


def _receptions(run: RecordedRun) -> Iterator[dict[str, Any]]:
    frames, ids = run.frames, np.arange(1, run.agents + 1)
    for piece in _pieces(len(frames.slot), run.agents):
        other = ids[None, :] != frames.sender[piece][:, None]  # (F, N)
        row, column = np.nonzero(other)
        slots = frames.slot[piece][row]
        yield {
            "slot": slots,
            "time_s": run.time_s(slots),
            "sender": frames.sender[piece][row],
            "receiver": ids[column],
            "received": _received(run, piece, row, column),
        }


def _received(run: RecordedRun, piece: slice, row: NDArray[np.int64], column: NDArray[np.int64]) -> pa.Array:
    """Whether agents received frames; empty where there is no record of that."""
    received = run.frames.received[piece][row, column]
    if run.told is None:
        return pa.array(received)
    told = run.told[np.searchsorted(run.slots, run.frames.slot[piece])[row], column]
    return pa.array(received, mask=~(received | told))


def _opener(config: Mapping[str, Any]) -> Callable[[bytes], bytes]:
    """A function that takes from a frame what authentication and plug-ins have appended to it."""
    try:
        swarm = recorded_config(config).swarm
    except (DtsaError, TypeError, ValueError):
        return lambda data: data
    return lambda data: swarm.protocol_part(data, sealed=True)


def _decode(data: bytes, extent_m: float) -> tuple[Any, ...]:
    try:
        frame = decode_frame(data, extent_m)
    except RemoteProtocolError:
        return (None,) * 7
    return (frame.c_r, *frame.position, *frame.velocity)


def _decisions(run: RecordedRun) -> Iterator[dict[str, Any]]:
    decisions = run.decisions
    names = np.array(decisions.names or ("",), dtype=object)
    for piece in _pieces(len(decisions.slot), decisions.agent.shape[1]):
        known = decisions.agent[piece].ravel() > 0
        slots = np.repeat(decisions.slot[piece], decisions.agent.shape[1])[known]
        yield {
            "slot": slots,
            "time_s": run.time_s(slots),
            "agent": decisions.agent[piece].ravel()[known],
            "chosen": decisions.chosen[piece].ravel()[known],
            "reason": pa.array(names[decisions.reason[piece].ravel()[known]].tolist(), pa.string()),
            "score": decisions.score[piece].ravel()[known],
            "digest": decisions.digest[piece].ravel()[known],
        }


def _states(run: RecordedRun) -> Iterator[dict[str, Any]]:
    motion = run.motion
    for piece in _pieces(len(motion.time_ns), len(motion.ids)):
        time_s = (motion.time_ns[piece] - run.start_ns) / 1e9
        batch: dict[str, Any] = {
            "time_s": np.repeat(time_s, len(motion.ids)),
            "agent": np.tile(motion.ids, len(time_s)),
        }
        for values, form in ((motion.position, "position_{}_m"), (motion.velocity, "velocity_{}_mps")):
            for index, axis in enumerate(AXES):
                batch[form.format(axis)] = values[piece, index].ravel()
        if run.merged is not None:  # no rows for those of whom there is no record
            known = np.isfinite(motion.position[piece]).all(axis=1).ravel()
            batch = {name: values[known] for name, values in batch.items()}
        yield batch


def ages_table(run: RecordedRun, followed: Followed) -> dict[str, Any]:
    """Columns of the table `ages`; no rows where the bag does not hold enough."""
    ages = followed.ages
    slot = np.zeros(0, np.int64) if ages is None else np.repeat(ages.slot, run.agents)
    none = np.zeros(0)
    return {
        "slot": slot,
        "time_s": run.time_s(slot + 1),
        "agent": np.tile(np.arange(1, run.agents + 1), len(slot) // run.agents),
        "observers": np.zeros(0, np.int64) if ages is None else ages.observers.ravel(),
        "age_slots": none if ages is None else ages.age.ravel(),
        "error_m": none if ages is None else ages.error.ravel(),
    }


def _ages(run: RecordedRun) -> Iterator[dict[str, Any]]:
    columns = ages_table(run, follow_run(run))
    for piece in _pieces(len(columns["slot"])):
        batch = {name: values[piece] for name, values in columns.items()}
        for name in ("age_slots", "error_m"):
            batch[name] = pa.array(batch[name], pa.float64(), from_pandas=True)  # not a number: empty
        yield batch


def _ages_by_observer(run: RecordedRun) -> Iterator[dict[str, Any]]:
    names = ("slot", "observer", "agent", "age_slots", "error_m", "counted")
    kinds = (np.int64, np.int64, np.int64, np.int64, np.float64, np.bool_)
    waiting: list[list[Any]] = [[np.zeros(0, kind)] for kind in kinds]
    rows, done = 0, False

    def batch() -> dict[str, Any]:
        columns = dict(zip(names, (np.concatenate(parts) for parts in waiting), strict=True))
        columns["error_m"] = pa.array(columns["error_m"], pa.float64(), from_pandas=True)  # not a number: empty
        return {"slot": columns.pop("slot"), "time_s": run.time_s(np.concatenate(waiting[0]) + 1), **columns}

    for seen in observed(run):
        values = (np.full(len(seen.agent), seen.slot), seen.observer, seen.agent, seen.age, seen.error, seen.counted)
        for parts, column in zip(waiting, values, strict=True):
            parts.append(column)
        rows += len(seen.agent)
        if rows >= ROWS:
            yield batch()
            waiting, rows, done = [[np.zeros(0, kind)] for kind in kinds], 0, True
    if rows or not done:
        yield batch()


_TABLES: dict[str, Callable[[RecordedRun], Iterator[dict[str, Any]]]] = {
    "slots": _slots,
    "frames": _frames,
    "receptions": _receptions,
    "decisions": _decisions,
    "states": _states,
    "ages": _ages,
    "ages_by_observer": _ages_by_observer,
}
