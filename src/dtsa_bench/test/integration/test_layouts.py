"""The layouts for Foxglove and PlotJuggler name topics and fields that our bags really have."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from bag_helpers import typestore
from rosbags.interfaces import Nodetype

from dtsa_agent.ros.common import names

SHARE = Path(__file__).resolve().parents[2]
LAYOUTS = Path(__file__).resolve().parents[4] / "layouts"
TYPES = {
    "/swarm/slot_record": "dtsa_msgs/msg/SlotRecord", "/swarm/markers": "visualization_msgs/msg/MarkerArray",
    **{f"/cf{k}/odom": "nav_msgs/msg/Odometry" for k in range(1, 13)},
}  # fmt: skip

pytestmark = pytest.mark.skipif(not LAYOUTS.is_dir(), reason="the layouts are part of the source tree only")


@pytest.fixture(scope="module")
def make() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(LAYOUTS))
        return import_module("make")


def has_field(topic: str, path: str) -> bool:
    """Whether messages of a topic have a field; arrays may be indexed."""
    kind = TYPES[topic]
    for part in re.sub(r"\[[^\]]*\]", "", path).split("."):
        fields = dict(typestore().fielddefs[kind][1])
        if part not in fields:
            return False
        node, detail = fields[part]
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            node, detail = detail[0]
        kind = detail if node == Nodetype.NAME else ""
        if not kind:
            return path.endswith(part) or "[" in path.rsplit(part, 1)[1]
    return True


def numbers(kind: str) -> set[str]:
    found: set[str] = set()
    fields: Any = typestore().fielddefs[kind][1]
    for _, (node, detail) in fields:
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            node, detail = detail[0]
        found |= numbers(detail) if node == Nodetype.NAME else {detail[0]}
    return found


def panels(node: Any) -> list[str]:
    return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])


def test_files_are_what_the_script_writes_and_grow_again_from_fewer_agents(make, tmp_path, monkeypatch):
    assert make.FOXGLOVE.read_text(encoding="utf-8") == make.foxglove()
    assert make.PLOTJUGGLER.read_text(encoding="utf-8") == make.plotjuggler()
    wanted = make.foxglove(), make.plotjuggler()
    monkeypatch.setattr(make, "FOXGLOVE", tmp_path / "layout.json")
    monkeypatch.setattr(make, "PLOTJUGGLER", tmp_path / "layout.xml")
    for agents in (12, 1, 70):
        make.FOXGLOVE.write_text(wanted[0], encoding="utf-8")
        make.PLOTJUGGLER.write_text(wanted[1], encoding="utf-8")
        fewer = make.foxglove(agents), make.plotjuggler(agents)
        make.FOXGLOVE.write_text(fewer[0], encoding="utf-8")
        make.PLOTJUGGLER.write_text(fewer[1], encoding="utf-8")
        assert (make.foxglove(), make.plotjuggler()) == wanted


def test_every_foxglove_panel_is_shown_and_every_path_exists(make: ModuleType) -> None:
    layout = json.loads(make.foxglove())
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    fields: dict[str, set[str]] = {}  # that the scripts make, by topic
    for script in layout["userNodes"].values():
        source = script["sourceCode"]
        produced = re.search(r'^export const output = "([^"]+)"', source, re.M)
        inputs = re.search(r"^export const inputs = (\[[^\]]+\])", source, re.M)
        assert set(json.loads(inputs[1])) <= TYPES.keys()
        assert "return undefined" not in source
        assert produced[1] not in fields
        fields[produced[1]] = set(re.findall(r"^  (\w+): [\w\[\]]+;", source, re.M))
    shown = set()
    checked = 0
    for config in layout["configById"].values():
        for limit in ("minXValue", "maxXValue", "minYValue", "maxYValue"):
            assert isinstance(config.get(limit, 0), (int, float)), limit  # Lichtblick takes "" for 0
        for topic in config.get("topics", {}):
            assert topic in TYPES or topic in fields
            shown.add(topic)
        for path in [entry["value"] for entry in config.get("paths", [])] + [config.get("topicPath", "0")]:
            if re.fullmatch(r"[\d.]+", path):
                continue  # a line at a value
            topic, _, field = path.partition(".")
            if topic in fields:
                assert field in fields[topic]
            else:
                assert not field or has_field(topic, field), path
            shown.add(topic)
            checked += 1
    assert checked > 12
    assert fields.keys() <= shown


def test_the_check_of_fields_can_fail() -> None:
    assert has_field("/cf1/odom", "pose.pose.position.x")
    for path in ("nothing", "pose.pose.position.w", "pose.position.x", "header.stamp.sec.more"):
        assert not has_field("/cf1/odom", path), path


def test_every_plotjuggler_curve_exists(make: ModuleType) -> None:
    root = ElementTree.fromstring(make.plotjuggler())
    made = {snippet.get("name") for snippet in root.iter("snippet")}
    sources = [
        entry.text for snippet in root.iter("snippet") for entry in snippet.iter() if (entry.text or "").startswith("/")
    ]
    curves = [curve.get("name") for curve in root.iter("curve")]
    assert len(curves) > 12
    assert sources
    for name in [curve for curve in curves if curve not in made] + sources:
        assert name is not None
        match = re.match(r"(/swarm/\w+|/cf\d+/odom)/(.+)", name)
        assert has_field(match[1], match[2].replace("/", ".")), name
    for splitter in root.iter("DockSplitter"):
        sizes = [float(size) for size in splitter.get("sizes", "").split(";")]
        assert len(splitter) == int(splitter.get("count", 0)) == len(sizes)
        assert sum(sizes) == pytest.approx(1)
    for change in (change for line in root.iter("curve") for change in line.iter("transform")):
        assert change.get("alias")  # the legend shows an empty text otherwise
        assert change.find("options") is not None
    for snippet in root.iter("snippet"):
        used = set(re.findall(r"\bv\d+\b", snippet.findtext("function", "")))
        sources = snippet.find("additional_sources")
        assert {source.tag for source in sources} == used
        assert len(used) <= 8  # more are too many for PlotJuggler 3.9
        if "age of" in snippet.get("name", ""):
            assert snippet.findtext("linked_source") == "/swarm/slot_record/outcome"
            assert sources[0].text == "/swarm/slot_record/sender[0]"


def test_no_topic_has_numbers_that_plotjuggler_refuses() -> None:
    """It loads nothing of a bag with a number that a double cannot hold, such as a digest of 64 bits."""
    assert [topic for topic, kind in TYPES.items() if "uint64" in numbers(kind)] == []
    assert "int64" in numbers(TYPES["/swarm/slot_record"])  # the check sees them; nanoseconds within a slot are small


def test_other_numbers_of_agents_and_nonsense(make: ModuleType) -> None:
    assert "/cf70/odom" in make.foxglove(70)
    assert "/cf3/odom" not in make.foxglove(2)
    for agents in (1, 3, 12):
        arrows = [f'"/cf{k}/odom"' in make.user_script("swarm_odometry", agents) for k in range(1, 14)]
        assert arrows == [k <= agents for k in range(1, 14)]
    for agents, pairs in ((1, 1), (3, 2), (70, 5)):  # with one agent a pair stays, from which others are made again
        curves = [curve.get("name", "") for curve in ElementTree.fromstring(make.plotjuggler(agents)).iter("curve")]
        assert sum(name.startswith("age of") for name in curves) == agents
        assert sum(name.startswith("distance") for name in curves) == pairs
    for words in (["many"], ["0"], ["3", "4"]):
        result = subprocess.run([sys.executable, str(LAYOUTS / "make.py"), *words], capture_output=True, text=True)
        assert result.returncode == 2
        assert "allowed: one number" in result.stderr


def test_the_model_hangs_on_its_frame_and_the_picture_shows_markers() -> None:
    body = names.body_frame(names.agent_namespace(3, "/north"))
    text = (SHARE / "urdf/quadcopter.urdf").read_text(encoding="utf-8").replace("${PREFIX}", "north/cf3/")
    robot = ElementTree.fromstring(text)
    links = {link.attrib["name"] for link in robot.iter("link")}
    children = {child.attrib["link"] for child in robot.iter("child")}
    parents = {parent.attrib["link"] for parent in robot.iter("parent")}
    assert links - children == parents == {body}
    assert len(links) == 5
    content = yaml.safe_load((SHARE / "rviz/swarm.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    topics = [display["Topic"]["Value"] for display in content["Displays"] if "Topic" in display]
    assert topics == [f"{names.SWARM}/{names.MARKERS}"]
    assert content["Global Options"]["Fixed Frame"] == names.FRAME
