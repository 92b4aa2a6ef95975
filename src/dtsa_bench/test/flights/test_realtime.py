"""Integration: flights in real time, agents on their own clocks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from fly_helpers import fly, readable, verified

pytest.importorskip("dtsa_msgs.msg")

from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.record import SLOT_RECORD, load_log
from dtsa_channel_sim import ClockConfig, make_clocks

pytestmark = pytest.mark.ros

DRIFT_PPM = 1000.0  # much more than a crystal's, to see in seconds what else takes minutes
AGENTS = 4
# A frame is on the air for 7.8 of 10 ms, so that agents that are 2.2 ms apart disturb each other.
TIGHT = (
    "--agents", str(AGENTS), "--moving", "2", "--policy", "tdma", "--processes", "2", "--seed", "9",
    "--bitrate", "31250",
    "--mode", "realtime", "--clock-drift-ppm", str(DRIFT_PPM), "--timeout-s", "3", "--no-picture",
)  # fmt: skip


@pytest.mark.alone
@pytest.mark.realtime
def test_with_alignment_slots_stay_together_and_without_frames_collide(tmp_path: Path) -> None:
    aligned = tmp_path / "aligned"
    together, apart = fly(aligned, *TIGHT, "--loss", "0.2"), fly(tmp_path / "apart", *TIGHT, "--no-align")
    # Left alone the clocks drift apart, each at its own rate: 5 ms by the end, far more than the 2.2 ms between frames.
    clocks = make_clocks(ClockConfig(drift_ppm=DRIFT_PPM, seed=9), AGENTS)
    gained = [clock.drift_ppb * apart["flight_time_s"] * 1e-6 for clock in clocks]  # ms
    assert apart["clock_spread_end_ms"] == pytest.approx(max(gained) - min(gained), abs=0.5)
    assert apart["clock_spread_end_ms"] > 3.0
    assert together["clock_spread_end_ms"] < 1.0
    assert together["slots"]["success"] > together["slots"]["total"] // 2
    met_apart, met_together = (verified(path).safety["frames_collided"] for path in (tmp_path / "apart", aligned))
    assert met_apart > 20
    assert met_together < met_apart / 4  # a busy machine may make a frame late now and then; clocks do not


def test_frames_of_a_fast_clock_arrive_before_the_slot_of_their_report(tmp_path: Path) -> None:
    words = ("--agents", "3", "--moving", "2", "--policy", "tdma", "--processes", "1", "--mode", "realtime")
    more = ("--no-align", "--clock-offset-ns", "4000000", "--clock-jitter-ns", "20000", "--timeout-s", "1")
    summary = fly(tmp_path / "fast", *words, *more, "--no-picture")
    assert (summary["mode"], summary["end"], summary["lost_agents"]) == ("realtime", "timed out", [])
    assert summary["realtime_factor"] == pytest.approx(1.0, abs=0.02)  # without the wait for its last reports
    log = load_log(tmp_path / "fast")
    assert len(set(log.offset_ns[0])) == 3  # three clocks, none like another
    assert (log.offset_ns[log.sent] < 0).any()
    assert readable(tmp_path / "fast")


@pytest.mark.alone
@pytest.mark.realtime
def test_seventy_agents_lose_no_message(tmp_path: Path) -> None:
    """All that agents report is recorded, and a frame that one of them had not taken in would show in its view."""
    out, agents = tmp_path / "flight", 70
    words = ("--agents", str(agents), "--policy", "tdma", "--processes", "2", "--mode", "realtime", "--timeout-s", "2")
    fly(out, *words, "--no-picture")
    slots: dict[int, list[int]] = {agent: [] for agent in range(1, agents + 1)}
    views: dict[int, dict[int, int]] = {}
    frames = heard = 0
    excused = set()  # those whose frame was not ready in time, or met another: only they think that it was heard
    with Bag(out / "bag") as bag:
        for _, message in bag.typed([SLOT_RECORD]):
            bits = np.unpackbits(message.received.reshape(len(message.sender), (agents + 7) // 8), axis=1).sum(axis=1)
            heard += int((bits > 0).sum())
            frames += len(message.sender)
            excused |= set(message.sender[bits < agents - 1].tolist())
            silent = ~np.isin(message.agent, message.sender)
            for agent, choice, unsent in zip(message.agent.tolist(), message.chosen, silent, strict=False):
                if unsent and choice == agent:
                    excused.add(agent)
            for agent, digest in zip(message.agent.tolist(), message.digest.tolist(), strict=False):
                slots[agent].append(int(message.slot))
                views.setdefault(int(message.slot), {})[agent] = digest
    last = min(max(reported) for reported in slots.values())
    assert last > 150
    for reported in slots.values():
        assert reported[: last + 1] == list(range(last + 1))
    assert frames - heard <= 3  # those that were still on the air at the end
    # Without loss all views become equal; who misses a frame differs from the others until its sender's next turn.
    assert len(excused) < agents / 2
    odd = dict.fromkeys(set(slots) - excused, 0)
    for slot in range(last + 1):
        digests = list(views[slot].values())
        usual = max(set(digests), key=digests.count)
        for agent in odd:
            odd[agent] = odd[agent] + 1 if views[slot][agent] != usual else 0
            assert odd[agent] < agents - 5, f"cf{agent} has missed a frame"
