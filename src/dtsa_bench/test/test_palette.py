"""Readers who do not see all colours can tell the agents apart."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from dtsa_bench.figures.palette import AGENT_COLOURS, ink_on, luminance

# From linear RGB to linear RGB as seen without one kind of cone (Machado, Oliveira, Fernandes 2009, severity 1).
SIGHT = {
    "normal": np.eye(3),
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def lab(colour: str, sight: str) -> np.ndarray:
    """A colour in CIE L*a*b*, as somebody sees it."""
    value = np.array([int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5)])
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.asarray(SIGHT[sight]) @ linear, 0.0, 1.0)
    x, y, z = np.cbrt(XYZ @ seen / [0.9505, 1.0, 1.089])
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("sight", SIGHT)
def test_any_two_agents_are_told_apart(sight: str) -> None:
    for first, second in combinations(AGENT_COLOURS, 2):
        apart = np.linalg.norm(lab(first, sight) - lab(second, sight))
        assert apart > 18.0, f"{first} and {second}: {apart:.1f}"


def test_ids_can_be_read_on_every_colour() -> None:
    for colour in AGENT_COLOURS:
        light, dark = sorted((luminance(colour), luminance(ink_on(colour))), reverse=True)
        assert (light + 0.05) / (dark + 0.05) > 4.0, colour
