"""What a process tells of its agents, where they do not all begin the same slots."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("dtsa_msgs.msg")

from dtsa_agent.core import Swarm, SwarmConfig
from dtsa_agent.ros.common.messages import Fields, read_report
from dtsa_agent.ros.reporter import Reporter

CONFIG = SwarmConfig(agents=12, slot_ms=10.0)
IDS = (2, 5, 11)


def make_reporter() -> tuple[Reporter, list[Fields]]:
    """One that publishes into a list."""
    reports: list[Fields] = []
    return Reporter(SimpleNamespace(publish=lambda data: reports.append(read_report(data))), CONFIG, IDS), reports


def test_slots_of_different_agents_are_told_apart_and_what_was_heard_once() -> None:
    reporter, reports = make_reporter()
    swarms = [Swarm(CONFIG, local=[id]) for id in IDS]
    for slot in range(6):
        for index, swarm in enumerate(swarms):
            if index == 1 and slot < 3:
                continue  # it still listens
            swarm.track[:] = 100 * slot + 10 * index + np.arange(swarm.track.size).reshape(swarm.track.shape)
            swarm.score[:] = slot + index / 8
            reporter.add_slot(index, slot, 1000 * slot - index, index, swarm)
    for index in (0, 2):
        reporter.add_received(index, 7, 1, 2)
    reporter.publish(9, 4)
    reporter.publish(9, 5)
    told = [(report.agent.tolist(), report.slot.tolist()) for report in reports]
    assert told == [([2, 11], [0, 1, 2]), ([2, 5, 11], [3, 4]), ([2, 5, 11], [5])]
    heard = [(report.heard_sender.tolist(), report.heard_by.tolist()) for report in reports]
    assert heard == [([], []), ([7], [0b101]), ([], [])]
    for report in reports:
        count = len(report.agent)
        track = report.track.reshape(len(report.slot), -1, count)
        for row, slot in enumerate(report.slot.tolist()):
            for column, agent in enumerate(report.agent.tolist()):
                index, at = IDS.index(agent), row * count + column
                assert track[row, :, column].tolist() == (100 * slot + 10 * index + np.arange(track.shape[1])).tolist()
                assert (report.score[at], report.offset_ns[at]) == (slot + index / 8, 1000 * slot - index)
                assert report.length[at] == index


def test_what_was_heard_is_told_even_if_nobody_has_begun_a_slot() -> None:
    reporter, reports = make_reporter()
    reporter.add_slot(1, 4, 0, 0, Swarm(CONFIG, local=[IDS[1]]))
    reporter.add_received(1, 7, 3, 3)
    reporter.publish(9, 4)
    alone, everybody = reports
    assert (alone.agent.tolist(), alone.heard_sender.tolist()) == ([5], [])
    assert (everybody.agent.tolist(), everybody.slot.tolist(), everybody.heard_by.tolist()) == ([2, 5, 11], [], [0b10])
