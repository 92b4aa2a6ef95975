"""Positions of a flight: the same array in memory and on the disk."""

from __future__ import annotations

import numpy as np
import pytest

from dtsa_bench.flights import measurement
from dtsa_bench.flights.measurement import PositionLog


@pytest.mark.parametrize("in_memory", [1 << 20, 0, 1000])
def test_what_was_put_in_comes_out(in_memory: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurement, "_IN_MEMORY", in_memory)
    random = np.random.default_rng(1)
    positions = random.normal(size=(50, 3, 7))
    log = PositionLog(7)
    for position in positions:
        log.append(position)
    assert len(log) == 50
    assert np.array_equal(log.array(), positions)


def test_an_empty_one_is_empty() -> None:
    assert not PositionLog(3)
    assert PositionLog(3).array().shape == (0, 3, 3)


def test_a_full_disk_keeps_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurement, "_IN_MEMORY", 1000)
    log, random = PositionLog(4), np.random.default_rng(2)
    positions = random.normal(size=(60, 3, 4))
    for position in positions[:30]:
        log.append(position)

    def full(data: bytes) -> int:
        raise OSError(28, "No space left on device")

    assert log._file is not None
    monkeypatch.setattr(log._file, "write", full, raising=False)
    for position in positions[30:]:
        log.append(position)
    kept = log.array()
    assert 20 <= len(kept) == len(log) < 60
    assert np.array_equal(kept, positions[: len(kept)])
