"""Integration: a recorder that is killed: wherever its file ends, what is recovered is a run up to a complete slot."""

from __future__ import annotations

import contextlib
import random
import shutil
from pathlib import Path

import pytest

from dtsa_agent.core import SwarmConfig
from dtsa_bench.commands import cli
from dtsa_bench.recordings.bag import writer
from dtsa_bench.recordings.bag.errors import UnusableBag
from dtsa_bench.recordings.bag.recover import recover
from dtsa_bench.recordings.verify import verify_bag
from dtsa_bench.runs.config import RunConfig, RunLimits, from_swarm
from dtsa_channel_sim import ChannelConfig

pytest.importorskip("dtsa_msgs.msg")

pytestmark = pytest.mark.ros

CUTS = 40


def flown(directory: Path, mode: str, patch: pytest.MonkeyPatch) -> Path:
    """A whole flight of real nodes whose bag has a chunk for every slot."""
    from dtsa_bench.flights.flight import FlightOptions, fly

    patch.setattr(writer, "FLUSH_S", 0.0)
    swarm = SwarmConfig(agents=5, moving=2, policy="lease", slot_ms=20.0, seed=3)
    run = RunConfig(
        swarm, ChannelConfig(loss=0.2, **from_swarm(swarm)), RunLimits(timeout_s=1.5, tail_s=1.5), mode=mode
    )
    fly(run, directory, FlightOptions(processes=2))
    return directory / "bag" / "bag_0.mcap"


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_cut_anywhere_it_verifies_up_to_its_end(mode, tmp_path, monkeypatch, capsys):
    whole = flown(tmp_path / "whole", mode, monkeypatch)
    complete = verify_bag(whole)
    assert complete.ok, complete.difference
    assert not complete.broken_off
    data, pick = whole.read_bytes(), random.Random(mode)
    cut, found = tmp_path / "cut" / "bag", []
    cut.mkdir(parents=True)
    # A summary beside the bag tells of the whole flight, of which the cut bag holds a part.
    shutil.copy(tmp_path / "whole" / "summary.json", cut.parent / "summary.json")
    for size in sorted({*(pick.randrange(len(data)) for _ in range(CUTS)), len(data) - 1, len(data) - 8}):
        (cut / "bag_0.mcap").write_bytes(data[:size])
        target = tmp_path / "cut" / "recovered"
        if not found:  # the first slot may be incomplete
            with contextlib.suppress(UnusableBag):
                recover(cut, target)
            if not target.exists():
                continue
            shutil.rmtree(target)
        result = recover(cut, target)
        verified = verify_bag(target)
        assert verified.ok, (size, verified.difference)
        assert verified.broken_off
        assert not result.closed
        assert verified.slots >= (found[-1] if found else 0), size  # who cuts later loses less
        found.append(verified.slots)
        shutil.rmtree(target)
    assert found[-1] == complete.slots
    assert len(set(found)) > CUTS // 4  # slot for slot, not half seconds
    (cut / "bag_0.mcap").write_bytes(data[: len(data) // 2])
    assert cli.main(["recover", str(cut)]) == 0
    assert "breaks off at" in capsys.readouterr().out
