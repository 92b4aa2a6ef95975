"""Writes the layouts for Foxglove, Lichtblick and PlotJuggler.

    python layouts/make.py [AGENTS]

The layouts in this directory are those for 12 agents; for other swarms run this with their number.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "src" / "dtsa_bench"))

from dtsa_bench.drawing.palette import AGENT_COLOURS, COLLIDED, SERIES, agent_colour, rgb  # noqa: E402

AGENTS = 12
PAIRS = 5  # PlotJuggler: distances from cf1 to so many others
LEGEND = 145  # pixels, width of Foxglove's legends
SCRIPTS = ("swarm_ages", "swarm_distances", "swarm_odometry")  # one a panel: a second one may miss part of an output


# ---- Foxglove and Lichtblick ----


def plot(title: str, paths: list[dict[str, Any]], label: str, **more: Any) -> dict[str, Any]:
    """A Plot panel.

    :param more: further settings. An axis without ``minYValue`` or ``maxYValue`` finds its own; an empty text means 0.
    """
    return {
        "paths": [{"enabled": True, "timestampMethod": "receiveTime", **path} for path in paths],
        "showLegend": True,
        "legendDisplay": "left",
        "showPlotValuesInLegend": False,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "yAxisLabel": label,
        "sidebarDimension": LEGEND,
        "foxglovePanelTitle": title,
        "lichtblickPanelTitle": title,
        **more,
    }


def scene(agents: int) -> dict[str, Any]:
    """The 3D panel, seen from so far that the whole swarm is in it."""
    size = max(8, 2 * round(0.2 * agents))
    grid = "c0a1f3f0-8c7c-4f0e-9a51-2f7f5d6e0001"
    return {
        "cameraState": {
            "distance": max(9, round(0.45 * agents, 1)),
            "perspective": True,
            "phi": 55,
            "thetaOffset": 40,
            "target": [0, 0, 0],
            "targetOffset": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.05,
            "far": 500,
        },
        "followMode": "follow-none",
        "followTf": "map",
        "scene": {"enableStats": False, "transforms": {"showLabel": False, "axisScale": 0.5}},
        "transforms": {},
        "topics": {"/swarm/markers": {"visible": True}, "/studio_script/swarm_odometry": {"visible": True}},
        "layers": {
            grid: {
                "visible": True,
                "frameLocked": True,
                "label": "Grid",
                "instanceId": grid,
                "layerId": "foxglove.Grid",
                "frameId": "map",
                "size": size,
                "divisions": size,
                "lineWidth": 1,
                "color": "#8a96a555",
                "position": [0, 0, -0.95],
                "rotation": [0, 0, 0],
                "order": 1,
            }
        },
        "foxglovePanelTitle": "Flight, with velocities",
        "lichtblickPanelTitle": "Flight, with velocities",
    }


def user_script(name: str, agents: int) -> str:
    """A script of the layout, with the odometry of all agents instead of the first one's, and their colours."""
    source = (HERE / f"{name}.ts").read_text(encoding="utf-8")
    topics = ", ".join(f'"/cf{k}/odom"' for k in range(1, agents + 1))
    colours = [[round(part, 3) for part in rgb(colour)] for colour in AGENT_COLOURS]
    placeholder = "COLOURS = [[0.25, 0.6, 0.45]]; // by agent; make.py puts the palette in"
    source = source.replace(placeholder, f"COLOURS = {json.dumps(colours)}; // by agent")
    return source.replace('inputs = ["/cf1/odom"]', f"inputs = [{topics}]")


def foxglove(agents: int = AGENTS) -> dict[str, Any]:
    """The layout for Foxglove and Lichtblick.

    :param agents: number of agents.
    """
    ages_of, distances_of = "/studio_script/swarm_ages", "/studio_script/swarm_distances"
    place = "pose.pose.position"
    heights = [
        {"value": f"/cf{k}/odom.{place}.z", "label": f"cf{k}", "color": agent_colour(k)} for k in range(1, agents + 1)
    ]
    ages = [
        {"value": f"{ages_of}.age_mean", "label": "mean", "color": SERIES[0]},
        {"value": f"{ages_of}.age_max", "label": "oldest", "color": SERIES[1]},
    ]
    distances = [
        {"value": f"{distances_of}.distance_min", "label": "closest pair", "color": SERIES[0]},
        {"value": "0.2", "label": "crash", "color": COLLIDED},
    ]
    dots = {"showLine": False, "lineSize": 2}
    senders = [{"value": "/swarm/reception.sender[:]", "label": "sender", "color": SERIES[0], **dots}]
    outcome = {"value": "/swarm/reception.outcome", "label": "slots", "timestampMethod": "receiveTime"}
    slots = "Slots"
    return {
        "configById": {
            "3D!swarm": scene(agents),
            "StateTransitions!slots": {
                "paths": [outcome],
                "isSynced": True,
                "foxglovePanelTitle": slots,
                "lichtblickPanelTitle": slots,
            },
            "Plot!senders": plot("Who sends", senders, "agent", minYValue=0),
            "Plot!ages": plot("Age", ages, "age (slots)", minYValue=0),
            "Plot!distances": plot("Smallest distance", distances, "distance (m)", minYValue=0),
            "Plot!heights": plot("Odometry: height", heights, "z (m)", sidebarDimension=90),
            "RawMessages!decision": {
                "topicPath": "/swarm/decision",
                "diffEnabled": False,
                "diffMethod": "custom",
                "diffTopicPath": "",
                "showFullMessageForDiff": False,
            },
        },
        "globalVariables": {},
        "userNodes": {
            f"b6d0c0f2-4b7e-4d0c-8f6e-5b7f1c2d{number:04}": {"name": name, "sourceCode": user_script(name, agents)}
            for number, name in enumerate(SCRIPTS, 1)
        },
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "splitPercentage": 52,
            "first": {
                "direction": "column",
                "splitPercentage": 68,
                "first": "3D!swarm",
                "second": {
                    "direction": "row",
                    "splitPercentage": 50,
                    "first": "Plot!heights",
                    "second": "RawMessages!decision",
                },
            },
            "second": {
                "direction": "column",
                "splitPercentage": 16,
                "first": "StateTransitions!slots",
                "second": {
                    "direction": "column",
                    "splitPercentage": 34,
                    "first": "Plot!senders",
                    "second": {
                        "direction": "column",
                        "splitPercentage": 50,
                        "first": "Plot!distances",
                        "second": "Plot!ages",
                    },
                },
            },
        },
    }


# ---- PlotJuggler ----

DISTANCE = """return math.sqrt((value - v3)^2 + (v1 - v4)^2 + (v2 - v5)^2)"""
# Seconds since the last success in which the agent was the first sender. Other data may be loaded: then time goes back.
AGE_GLOBAL = "last = nil"
AGE = """if last == nil or time < last or (value == 1 and v1 == {agent}) then last = time end
return time - last"""

# Title, curves with their colours, style, limits of the y axis.
Panel = tuple[str, list[tuple[str, str]], str, dict[str, str]]


def plotjuggler(agents: int = AGENTS) -> str:
    """The layout for PlotJuggler.

    :param agents: number of agents.
    """
    root = ElementTree.Element("root")
    tabs = ElementTree.SubElement(root, "tabbed_widget", name="Main Window", parent="main_window")
    numbers = range(1, agents + 1)
    outcome, sender, place = "/swarm/reception/outcome", "/swarm/reception/sender[0]", "odom/pose/pose/position"
    ages = [(f"age of cf{k}", agent_colour(k)) for k in numbers]
    slots: list[Panel] = [
        ("Slots: 0 idle, 1 success, 2 collision", [(outcome, SERIES[0])], "StepsInv", {"min": "-0.1", "max": "2.1"}),
        ("Who sends (first of the senders)", [(sender, SERIES[1])], "Dots", {"min": "0"}),
        ("Age (s)", ages, "Lines", {"min": "0"}),
    ]
    _rows(_tab(tabs, "slots"), slots, [0.2, 0.3, 0.5])
    others = range(2, min(agents, PAIRS + 1) + 1)
    distances = [(f"distance cf1 cf{k}", agent_colour(k)) for k in others]
    flight: list[Panel] = [
        ("Distance from cf1 (m)", distances, "Lines", {"min": "0"}),
        *(
            (f"Odometry: {axis} (m)", [(f"/cf{k}/{place}/{axis}", agent_colour(k)) for k in numbers], "Lines", {})
            for axis in "zxy"
        ),
    ]
    columns = _splitter(_tab(tabs, "flight"), "|", [0.5, 0.5])
    _rows(columns, flight[:2], [0.5, 0.5])
    _rows(columns, flight[2:], [0.5, 0.5])
    ElementTree.SubElement(tabs, "currentTabIndex", index="0")
    ElementTree.SubElement(root, "use_relative_time_offset", enabled="1")
    equations = ElementTree.SubElement(root, "customMathEquations")
    for k in others:
        more = [f"/cf1/{place}/y", f"/cf1/{place}/z", *(f"/cf{k}/{place}/{axis}" for axis in "xyz")]
        _equation(equations, f"distance cf1 cf{k}", DISTANCE, f"/cf1/{place}/x", more)
    for k in numbers:
        _equation(equations, f"age of cf{k}", AGE.format(agent=k), outcome, [sender], AGE_GLOBAL)
    ElementTree.indent(root, " ")
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ElementTree.tostring(root, encoding="unicode") + "\n"


def _tab(tabs: ElementTree.Element, name: str) -> ElementTree.Element:
    tab = ElementTree.SubElement(tabs, "Tab", tab_name=name, containers="1")
    return ElementTree.SubElement(tab, "Container")


def _splitter(parent: ElementTree.Element, orientation: str, shares: list[float]) -> ElementTree.Element:
    sizes = ";".join(f"{share:.4f}" for share in shares)
    return ElementTree.SubElement(parent, "DockSplitter", orientation=orientation, count=str(len(shares)), sizes=sizes)


def _rows(parent: ElementTree.Element, panels: list[Panel], shares: list[float]) -> None:
    """Panels one above the other."""
    splitter = _splitter(parent, "-", shares)
    for title, curves, style, limits in panels:
        area = ElementTree.SubElement(splitter, "DockArea", name=title)
        panel = ElementTree.SubElement(area, "plot", mode="TimeSeries", style=style, flip_x="false", flip_y="false")
        ElementTree.SubElement(panel, "limitY", limits)
        for curve, ink in curves:
            line = ElementTree.SubElement(panel, "curve", name=curve, color=ink)
            if curve.startswith("/cf"):
                # A short name for the legend, which hides half of the plot otherwise. It needs a transform.
                change = ElementTree.SubElement(line, "transform", name="Scale/Offset", alias=curve.split("/")[1])
                ElementTree.SubElement(change, "options", value_scale="1", value_offset="0", time_offset="0")


def _equation(
    parent: ElementTree.Element, name: str, function: str, source: str, more: list[str], start: str = ""
) -> None:
    snippet = ElementTree.SubElement(parent, "snippet", name=name)
    ElementTree.SubElement(snippet, "global").text = start
    ElementTree.SubElement(snippet, "function").text = function
    ElementTree.SubElement(snippet, "linked_source").text = source
    if more:
        sources = ElementTree.SubElement(snippet, "additional_sources")
        for number, entry in enumerate(more, 1):
            ElementTree.SubElement(sources, f"v{number}").text = entry


def main(words: list[str]) -> int:
    """Write both layouts beside this script."""
    if len(words) > 1 or (words and not (words[0].isdigit() and 1 <= int(words[0]) <= 1000)):
        print(f"make.py: AGENTS: got {' '.join(words)!r}; allowed: one number from 1 to 1000", file=sys.stderr)
        return 2
    agents = int(words[0]) if words else AGENTS
    for name, text in (
        ("foxglove_swarm.json", json.dumps(foxglove(agents), indent=2) + "\n"),
        ("plotjuggler_swarm.xml", plotjuggler(agents)),
    ):
        (HERE / name).write_text(text, encoding="utf-8")
        print(HERE / name)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
