"""Readers who do not see all colours can tell the agents apart."""

from __future__ import annotations

import json
import re
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from bag_helpers import typestore
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_bench.drawing.flight_paths import paint
from dtsa_bench.drawing.palette import (
    AGENT_COLOURS,
    COLLIDED,
    DASHES,
    SERIES,
    SHAPES,
    agent_colour,
    agent_turn,
    ink_on,
    luminance,
    rgb,
)
from dtsa_bench.log.bag.cdr import MarkerPacker
from dtsa_bench.pages.report.data import render

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


LAYOUTS = Path(__file__).resolve().parents[4] / "layouts"


@pytest.mark.parametrize("sight", SIGHT)
def test_any_two_agents_and_any_two_series_are_told_apart(sight: str) -> None:
    for colours, least in ((AGENT_COLOURS, 18.0), ((*SERIES, COLLIDED), 16.0)):
        for first, second in combinations(colours, 2):
            apart = np.linalg.norm(lab(first, sight) - lab(second, sight))
            assert apart > least, f"{first} and {second}: {apart:.1f}"


def test_every_colour_stands_out_and_comes_again_with_another_dash_and_shape() -> None:
    for colour in AGENT_COLOURS:
        for other, least in (("#ffffff", 1.5), ("#181f27", 1.5), (ink_on(colour), 4.0)):
            light, dark = sorted((luminance(colour), luminance(other)), reverse=True)
            assert (light + 0.05) / (dark + 0.05) > least, (colour, other)
    turns = [agent_turn(agent) for agent in range(1, 4 * len(AGENT_COLOURS) + 1)]
    looks = {(agent_colour(k), DASHES[turn], SHAPES[turn]) for k, turn in enumerate(turns, 1)}
    assert len(looks) == len(turns)


def test_an_agent_has_one_colour_in_page_picture_layouts_and_markers() -> None:
    count = 12
    wanted = [agent_colour(agent) for agent in range(1, count + 1)]
    page = re.search(r'<script type="application/json" id="data">(.*?)</script>', render([]), re.S)
    assert page is not None
    assert json.loads(page[1])["palette"]["agents"][:count] == wanted

    config = SwarmConfig(agents=count)
    axes = Figure().add_subplot()
    paint(axes, np.zeros((2, 3, count)), make_scenario(config).moving)
    inked = [to_hex(line.get_color()) for line in axes.lines if line.get_linestyle() == "-"]
    assert [colour for colour in inked if colour != "#ffffff"] == wanted

    data = MarkerPacker(range(1, count + 1)).pack(
        0, np.zeros((3, count)), np.ones(count, np.uint8), np.zeros((3, count))
    )
    markers = typestore().deserialize_cdr(data, "visualization_msgs/msg/MarkerArray").markers
    for agent in range(count):
        for marker in (markers[agent], markers[2 * count + agent]):
            assert (marker.color.r, marker.color.g, marker.color.b) == pytest.approx(rgb(wanted[agent]), abs=1e-6)

    if not LAYOUTS.is_dir():
        return  # part of the source tree only
    foxglove = json.loads((LAYOUTS / "foxglove_swarm.json").read_text(encoding="utf-8"))
    heights = foxglove["configById"]["Plot!heights"]["paths"]
    assert {path["label"]: path["color"] for path in heights} == {f"cf{k}": wanted[k - 1] for k in range(1, count + 1)}
    curves = ElementTree.parse(LAYOUTS / "plotjuggler_swarm.xml").iter("curve")
    own = [(curve.get("name") or "", curve.get("color")) for curve in curves]
    numbered = [(int(found[1]), colour) for name, colour in own if (found := re.search(r"(?:age of |^/)cf(\d+)", name))]
    assert len(numbered) == 4 * count
    assert all(colour == wanted[number - 1] for number, colour in numbered)
