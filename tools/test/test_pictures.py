"""The pictures of the explanation pages are what the protocol core plays today."""

from __future__ import annotations

from pathlib import Path

import pytest
from dtsa_dev.documents.pictures import PICTURES, play

from dtsa_agent.core import SwarmConfig

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_what_its_code_draws(name: str) -> None:
    assert (IMAGES / f"{name}.svg").read_text(encoding="utf-8") == PICTURES[name]().svg()


def test_a_frame_that_one_agent_misses_makes_choices_differ() -> None:
    config = SwarmConfig(agents=8, moving=8, policy="dtsa", scenario="waypoints", stops=4, seed=2)
    whole, _ = play(config, 199)
    cut, moving = play(config, 199, (183, 8))
    assert all(moving)
    assert all(len(set(slot.chosen)) == 1 and len(slot.senders) == 1 for slot in whole)
    assert [slot.senders for slot in cut[:184]] == [slot.senders for slot in whole[:184]]
    assert any(len(set(slot.chosen)) > 1 for slot in cut[184:])
