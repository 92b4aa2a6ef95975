"""Who heard whom, as a table: what losses are learnt from, and what is replayed. Columns: docs/reference/losses.md."""

from __future__ import annotations

import csv
from array import array
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dtsa_agent.core.errors import ConfigError
from dtsa_agent.core.settings.declaration import Setting

from .loss_record import HEARD, LOST, MOST, UNKNOWN

_SLOT = Setting("slot", "int", None, "number of the slot", minimum=0, maximum=2**53)
_TIME = Setting("time_s", "float", None, "when the frame was sent", unit="s", minimum=0, maximum=1e9)
_SENDER = Setting("sender", "int", None, "id of the sender", minimum=1, maximum=65535)
_RECEIVER = Setting("receiver", "int", None, "id of the receiver; 0: no agent", minimum=0, maximum=65535)
_RSSI = Setting("rssi_dbm", "float", None, "signal strength", unit="dBm", minimum=-200, maximum=100)
_DISTANCE = Setting("distance_m", "float", None, "distance", unit="m", minimum=0, maximum=1e6)
NEEDED, OPTIONAL = ("sender", "receiver", "heard"), ("rssi_dbm", "distance_m")
_COLUMNS = ("slot", "time_s", *NEEDED, *OPTIONAL)
_MOST_ROWS = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class LossTable:
    """Frames in the order of their slots, and who received them.

    :param slots: (F,) number of the slot in which each was sent.
    :param senders: (F,) ids.
    :param outcome: (F, N + 1) HEARD, LOST or UNKNOWN by the receiver's id; 0: a listener that is no agent.
    :param distance_m: (F, N + 1) m, from the sender to the receiver; NaN: not known. None: none is known.
    :param rssi_dbm: (F, N + 1) dBm, likewise.
    """

    slots: NDArray[np.int64]
    senders: NDArray[np.int64]
    outcome: NDArray[np.uint8]
    distance_m: NDArray[np.float32] | None = None
    rssi_dbm: NDArray[np.float32] | None = None

    @property
    def agents(self) -> int:
        """Highest id."""
        return int(self.outcome.shape[1]) - 1


def read_table(path: str | Path, slot_ns: int) -> LossTable:
    """Return the table in a CSV file.

    :param path: the file.
    :param slot_ns: ns, length of a slot, for times; 0: not known.
    :raises ConfigError: naming file, line and column of what is wrong.
    """
    try:
        with open(path, encoding="utf-8-sig", newline="") as stream:
            return _table(_Rows(str(path), stream, slot_ns))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not text"
        raise ConfigError("losses", str(path), f"a readable CSV file ({reason})") from None
    except csv.Error as error:
        raise ConfigError("losses", str(path), f"a CSV file ({error})") from None


class _Rows:
    """Reads rows and checks them."""

    def __init__(self, path: str, stream: Iterator[str], slot_ns: int) -> None:
        self.path = path
        self._rows = csv.reader(stream)
        head = [name.strip() for name in next(self._rows, [])]
        self._places = {name: place for place, name in enumerate(head)}
        for name in head:
            if name not in _COLUMNS or head.count(name) > 1:
                raise ConfigError(f"{path}, line 1", name, f"each of these once at most: {', '.join(_COLUMNS)}")
        for name in NEEDED:
            if name not in head:
                raise ConfigError(f"{path}, line 1", ",".join(head), f"a column {name}")
        if ("slot" in head) == ("time_s" in head):
            raise ConfigError(f"{path}, line 1", ",".join(head), "a column slot, or a column time_s")
        if "time_s" in head and not slot_ns:
            raise ConfigError(f"{path}, line 1: time_s", "time_s", "times together with the length of a slot, slot_ms")
        self._slot_ns = slot_ns
        self.optional = [name for name in OPTIONAL if name in head]

    def __iter__(self) -> Iterator[tuple[int, int, int, int, list[float]]]:
        """Slot, sender, receiver, outcome, and the optional columns."""
        places = self._places
        when, by_slot = places.get("slot", places.get("time_s", 0)), "slot" in places
        sender_at, receiver_at, heard_at = (places[name] for name in NEEDED)
        optional = [(places[spec.name], spec) for spec in (_RSSI, _DISTANCE) if spec.name in places]
        for row in self._rows:
            if not row:
                continue
            if len(row) != len(places):
                raise self._wrong("", f"{len(row)} fields", f"{len(places)} fields")
            if by_slot:
                slot = self._number(_SLOT, row[when])
            else:
                slot = int(self._number(_TIME, row[when]) * 1e9 // self._slot_ns)
            sender, receiver = self._number(_SENDER, row[sender_at]), self._number(_RECEIVER, row[receiver_at])
            if sender == receiver:
                raise self._wrong("receiver", row[receiver_at], "another agent than the sender")
            heard = row[heard_at].strip()
            if heard not in ("0", "1"):
                raise self._wrong("heard", heard, "0 or 1")
            more = [self._number(spec, row[place]) if row[place].strip() else np.nan for place, spec in optional]
            yield int(slot), int(sender), int(receiver), HEARD if heard == "1" else LOST, more

    def _number(self, spec: Setting, text: str) -> float:
        """A number; checked here, because `spec.read` takes ten times as long and tables are long."""
        try:
            value = int(text) if spec.kind == "int" else float(text)
        except ValueError:
            value = np.nan
        if not spec.minimum <= value <= spec.maximum:
            raise self._wrong(spec.name, text.strip(), spec.allowed)
        return value

    def _wrong(self, column: str, value: str, allowed: str) -> ConfigError:
        line = f"{self.path}, line {self._rows.line_num}"
        return ConfigError(f"{line}: {column}" if column else line, value, allowed)

    def twice(self, slot: int, sender: int, receiver: int) -> ConfigError:
        """The error for a link that is named twice in a slot."""
        return ConfigError(self.path, f"slot {slot}, sender {sender}, receiver {receiver} twice", "each frame once")


def _table(rows: _Rows) -> LossTable:
    """Return the rows, ordered."""
    columns = [array("q"), array("i"), array("i"), array("b")]
    more = [array("f") for _ in rows.optional]
    for *values, others in rows:
        for column, value in zip(columns, values, strict=True):
            column.append(value)
        for extra, number in zip(more, others, strict=True):
            extra.append(number)
        if len(columns[0]) > _MOST_ROWS:
            raise ConfigError(rows.path, f"more than {_MOST_ROWS} rows", f"at most {_MOST_ROWS}")
    if not columns[0]:
        raise ConfigError(rows.path, "no rows", "one row at least")
    slots, senders, receivers, outcome = (np.array(column) for column in columns)
    agents = int(max(senders.max(), receivers.max()))
    keys = slots * 65536 + senders
    frames, place = np.unique(keys, return_inverse=True)
    if len(frames) * (agents + 1) > MOST:
        raise ConfigError(rows.path, f"{len(frames)} frames of {agents} agents", f"at most {MOST} frames times agents")
    cells = place * (agents + 1) + receivers
    several = np.flatnonzero(np.bincount(cells) > 1) if len(cells) > len(np.unique(cells)) else ()
    if len(several):
        key, receiver = frames[several[0] // (agents + 1)], int(several[0] % (agents + 1))
        raise rows.twice(int(key // 65536), int(key % 65536), receiver)
    shape = (len(frames), agents + 1)
    found = np.full(shape, UNKNOWN, np.uint8)
    found[place, receivers] = outcome
    extras = {}
    for name, column in zip(rows.optional, more, strict=True):
        extras[name] = np.full(shape, np.nan, np.float32)
        extras[name][place, receivers] = np.array(column)
    return LossTable(frames // 65536, frames % 65536, found, extras.get("distance_m"), extras.get("rssi_dbm"))


def write_table(path: str | Path, table: LossTable) -> int:
    """Write a table as CSV; return the number of rows.

    :param path: the file.
    :param table: what is written.
    :raises ConfigError: when it cannot be written.
    """
    rows = 0
    try:
        with open(path, "w", encoding="utf-8", newline="") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            known = [name for name in OPTIONAL if getattr(table, name) is not None]
            writer.writerow(["slot", *NEEDED, *known])
            for frame in range(len(table.slots)):
                receivers = np.flatnonzero(table.outcome[frame] != UNKNOWN)
                extras = [_words(getattr(table, name)[frame, receivers]) for name in known]
                heard = np.where(table.outcome[frame, receivers] == HEARD, 1, 0).tolist()
                slot, sender = int(table.slots[frame]), int(table.senders[frame])
                for receiver, told, *more in zip(receivers.tolist(), heard, *extras, strict=True):
                    writer.writerow([slot, sender, receiver, told, *more])
                rows += len(receivers)
    except OSError as error:
        raise ConfigError("csv", str(path), f"a file that can be written ({error.strerror})") from None
    return rows


def _words(values: NDArray[np.float32]) -> list[str]:
    return ["" if np.isnan(value) else f"{value:.3f}" for value in values.tolist()]
