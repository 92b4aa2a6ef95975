"""Before a flight: whether all hear all, and in time."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import air_helpers as helpers
import numpy as np
import pytest

from dtsa_agent.air.port import NETWORK, link_of
from dtsa_agent.air.record import ReceivedFrame, SlotRecord
from dtsa_agent.core import Frame, SwarmConfig, encode_frame
from dtsa_agent.core.station import StationSettings
from dtsa_bench.network.check import Check, lasts_s, table

CONFIG = SwarmConfig(agents=4, policy="tdma", slot_ms=20.0)
MS, SLOT = 1_000_000, CONFIG.slot_ns
NONE = np.zeros(3)


def record(slot: int, chosen: int, heard: list[ReceivedFrame], is_first: bool = False) -> SlotRecord:
    start, track = slot * SLOT, np.zeros((1, 3))
    return SlotRecord(slot, start, is_first, 1, chosen, 0, 0, 0.0, track, NONE, NONE, NONE, heard=heard)


def said(sender: int, slot: int, delay_ns: int, hears: Sequence[int]) -> ReceivedFrame:
    """A frame that arrives so long after its slot has started; its sender names whom it hears."""
    frame = encode_frame(Frame(sender, slot, 1, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0)))
    data = StationSettings(CONFIG, link_of(CONFIG)).write(frame, slot, 0, tuple((k, 0) for k in hears))
    return ReceivedFrame(sender, slot, slot * SLOT + delay_ns, data, accepted=True)


def checked(delay_ns: dict[int, int], hears: dict[int, Sequence[int]], silent: Sequence[int] = ()) -> Check:
    """What cf1 has found after 200 slots: delays by sender, whom they hear, and slots whose frames are lost."""
    check = Check(1, CONFIG, NETWORK)
    for slot in range(100, 300):
        sender = slot % 4 + 1
        there = sender in delay_ns and slot not in silent
        heard = [said(sender, slot, delay_ns[sender], hears[sender])] if there else []
        check.slot(record(slot, sender, heard, is_first=slot == 100))
    return check


ALL = {2: (1, 3, 4), 3: (1, 2, 4), 4: (1, 2, 3)}
QUICK = {2: MS, 3: 2 * MS, 4: MS}


def test_all_hear_all_in_time() -> None:
    found = checked(QUICK, ALL).result()
    assert found["missing"] == []
    told = found["others"]["cf3"]
    assert (told["heard"], told["in_time_share"], told["delay_ms"]) == (50, 1.0, {"p50": 2.0, "max": 2.0})
    assert (told["hears_this_agent"], told["does_not_hear"]) == (True, [])
    lines = table({**found, "not_taken_in": {"other settings": 7}}).splitlines()
    assert [line.split()[0] for line in lines] == ["cf1:", "frames", "cf2", "cf3", "cf4", "not"]


@pytest.mark.parametrize(
    ("delays", "hears", "silent", "missing"),
    [
        ({2: MS, 3: MS}, {2: (1, 3), 3: (1, 2)}, (), ["cf4 is heard by no agent"]),
        ({2: MS, 3: MS}, {2: (1, 3, 4), 3: (1, 2)}, (), ["cf3 does not hear cf4", "cf4 is not heard"]),
        (QUICK, {**ALL, 3: (2, 4)}, (), ["cf3 does not hear cf1"]),
        (QUICK, {**ALL, 3: (1, 4)}, (), ["cf3 does not hear cf2"]),
        ({**QUICK, 3: 17 * MS}, ALL, (), ["0% of 49 frames of cf3 heard in time, 80% needed"]),
        (QUICK, ALL, range(102, 222, 4), []),  # began its check later
        (QUICK, ALL, range(262, 300, 4), []),  # began earlier, and has ended
        (QUICK, ALL, range(202, 300, 4), ["cf3 was not heard in the last 101 slots"]),
        (QUICK, ALL, range(106, 254, 8), ["61% of 49 frames of cf3 heard in time, 80% needed"]),
    ],
)
def test_what_is_missing_is_said(delays, hears, silent, missing):
    assert checked(delays, hears, silent).result()["missing"] == missing


def test_who_begins_late_was_heard_by_nobody_before() -> None:
    check = Check(1, CONFIG, NETWORK)
    for slot in range(100, 300):
        sender, there = slot % 4 + 1, [1, 2, 3, 4] if slot >= 230 else [1, 2, 4]
        heard = [said(sender, slot, MS, [k for k in there if k != sender])] if sender in there[1:] else []
        check.slot(record(slot, sender, heard, is_first=slot == 100))
    assert check.result()["missing"] == []


def test_it_lasts_until_all_can_tell_and_one_that_is_too_short_says_so() -> None:
    check = Check(1, CONFIG, NETWORK)
    for slot in range(100, 112):
        sender = slot % 4 + 1
        heard = [said(sender, slot, MS, ALL[sender])] if sender > 1 else []
        check.slot(record(slot, sender, heard, is_first=slot == 100))
    assert [line.split(":")[1] for line in check.result()["missing"]] == [" check for longer"] * 3
    lease = SwarmConfig(agents=6, policy="lease", slot_ms=150.0)
    assert lasts_s(lease) == pytest.approx((3 * 3 + 2 * 15 + 20) * 6 * 0.15)
    assert lasts_s(CONFIG) == 5.0


@pytest.mark.parametrize("agents", [2, 3])
def test_agents_check_before_a_flight(agents: int) -> None:
    helpers.need_multicast()
    words = ["agent", "--agents", str(agents), "--interface", "lo", "--group", helpers.own_group(), "--no-seal",
             "--slot-ms", "20", "--check", "8", "--json"]  # fmt: skip
    commands = [[sys.executable, "-m", "dtsa_bench", *words, "--id", str(k)] for k in (1, 2)]
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    started = [subprocess.Popen(command, text=True, **pipes) for command in commands]
    said = [process.communicate(timeout=60) for process in started]
    found = [json.loads(out) for out, _ in said]
    missing = [] if agents == 2 else ["cf3 is heard by no agent"]
    assert [one["missing"] for one in found] == [missing, missing]
    assert [process.returncode for process in started] == [bool(missing)] * 2
    assert all(("not all hear all in time" in errors) == bool(missing) for _, errors in said)
    assert found[0]["others"]["cf2"]["hears_this_agent"]
