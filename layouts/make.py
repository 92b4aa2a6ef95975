"""Fits the layouts for Foxglove, Lichtblick and PlotJuggler to a number of agents.

    python layouts/make.py [AGENTS]

The layouts in this directory are those for 12 agents. To change one, edit its file or save over it from the player, and
run this script: it puts in an entry for each agent, the colours, and the scripts `swarm_*.ts`.
"""

from __future__ import annotations

import json
import re
import sys
from itertools import groupby
from pathlib import Path
from xml.etree import ElementTree

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "src" / "dtsa_bench"))

from dtsa_bench.drawing.palette import AGENT_COLOURS, agent_colour, rgb  # noqa: E402

AGENTS = 12
PAIRS = 5  # PlotJuggler: distances from cf1 to so many others
FOXGLOVE, PLOTJUGGLER = HERE / "foxglove_swarm.json", HERE / "plotjuggler_swarm.xml"


def user_script(name: str, agents: int) -> str:
    """A script of the layout, with the odometry of all agents instead of the first one's, and their colours."""
    source = (HERE / f"{name}.ts").read_text(encoding="utf-8")
    topics = ", ".join(f'"/cf{k}/odom"' for k in range(1, agents + 1))
    colours = [[round(part, 3) for part in rgb(colour)] for colour in AGENT_COLOURS]
    placeholder = "COLOURS = [[0.25, 0.6, 0.45]]; // by agent; make.py puts the palette in"
    source = source.replace(placeholder, f"COLOURS = {json.dumps(colours)}; // by agent")
    return source.replace('inputs = ["/cf1/odom"]', f"inputs = [{topics}]")


def foxglove(agents: int = AGENTS) -> str:
    """The layout for Foxglove and Lichtblick, for a number of agents."""
    layout = json.loads(FOXGLOVE.read_text(encoding="utf-8"))
    scene, heights = layout["configById"]["3D!swarm"], layout["configById"]["Plot!heights"]
    scene["cameraState"]["distance"] = max(9, round(0.45 * agents, 1))  # the whole swarm is in it
    for layer in scene["layers"].values():
        layer["size"] = layer["divisions"] = max(8, 2 * round(0.2 * agents))
    first = heights["paths"][0]
    heights["paths"] = [
        {**first, "value": first["value"].replace("cf1", f"cf{k}"), "label": f"cf{k}", "color": agent_colour(k)}
        for k in range(1, agents + 1)
    ]
    for script in layout["userNodes"].values():
        script["sourceCode"] = user_script(script["name"], agents)
    return json.dumps(layout, indent=2) + "\n"


def plotjuggler(agents: int = AGENTS) -> str:
    """The layout for PlotJuggler, for a number of agents."""
    root = ElementTree.fromstring(PLOTJUGGLER.read_text(encoding="utf-8"))
    for parent in (*root.iter("plot"), *root.iter("customMathEquations")):
        fit(parent, agents)
    ElementTree.indent(root, " ")
    return "<?xml version='1.0' encoding='UTF-8'?>\n" + ElementTree.tostring(root, encoding="unicode") + "\n"


def fit(parent: ElementTree.Element, agents: int) -> None:
    """Gives an element one child for each agent where it has children whose names end with the agent's number.

    Of children that begin with cf2, which compare with cf1, there are `PAIRS` at most, and always one.
    """
    groups = groupby(parent, lambda child: re.sub(r"cf\d+(?!.*cf)", "cf", child.get("name", "")))
    children: list[ElementTree.Element] = []
    for _, group in groups:
        same = list(group)
        found = [int(re.findall(r"cf(\d+)", name)[-1]) for child in same if "cf" in (name := child.get("name", ""))]
        if not found:
            children += same
            continue
        first, pattern = found[0], ElementTree.tostring(same[-1], encoding="unicode")
        last = agents if first == 1 else max(first, min(agents, PAIRS + 1))
        for agent in range(first, last + 1):
            child = ElementTree.fromstring(re.sub(rf"(cf|v1 == ){found[-1]}\b", rf"\g<1>{agent}", pattern))
            if "color" in child.attrib:
                child.set("color", agent_colour(agent))
            children.append(child)
    parent[:] = children


def main(words: list[str]) -> int:
    """Write both layouts."""
    if len(words) > 1 or (words and not (words[0].isdigit() and 1 <= int(words[0]) <= 1000)):
        print(f"make.py: AGENTS: got {' '.join(words)!r}; allowed: one number from 1 to 1000", file=sys.stderr)
        return 2
    agents = int(words[0]) if words else AGENTS
    for path, text in ((FOXGLOVE, foxglove(agents)), (PLOTJUGGLER, plotjuggler(agents))):
        path.write_text(text, encoding="utf-8")
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
