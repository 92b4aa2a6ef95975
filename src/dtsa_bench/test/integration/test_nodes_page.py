"""The lines of docs/how-to/nodes.md fly as they stand there."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from bag_helpers import ros_environment

from dtsa_agent.ros.common.graph import names
from dtsa_bench.flights.domain import ros_domain

SHARE = Path(__file__).resolve().parents[2]
pytest.importorskip("dtsa_msgs.msg")

PAGE = (Path(__file__).resolve().parents[4] / "docs/how-to/nodes.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.ros
@pytest.mark.parametrize("block", BLOCKS, ids=["lockstep", "realtime", "two swarms"])
def test_the_lines_of_the_page_fly(block: str, tmp_path: Path) -> None:
    with ros_domain() as domain:
        environment = ros_environment() | {"ROS_DOMAIN_ID": str(domain), "ROS_LOG_DIR": str(tmp_path / "log")}
        processes = [
            subprocess.Popen(shlex.split(line), cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True)
            for line in block.splitlines()
        ]
        try:
            said = [process.communicate(timeout=120)[1] for process in processes]
        finally:
            for process in processes:
                process.kill()
    assert [process.returncode for process in processes] == [0] * len(processes), said
    for text in said:
        assert "ends after slot" in text
    for out in re.findall(r"out:=(\w+)", block):
        assert (tmp_path / out / "summary.json").exists()
        assert (tmp_path / out / "bag" / "metadata.yaml").exists()


def test_the_model_of_a_quadcopter_hangs_on_the_frame_that_transforms_name() -> None:
    body = names.body_frame(names.agent_namespace(3, "/north"))
    text = (SHARE / "urdf/quadcopter.urdf").read_text(encoding="utf-8").replace("${PREFIX}", "north/cf3/")
    robot = ElementTree.fromstring(text)
    links = {link.attrib["name"] for link in robot.iter("link")}
    children = {child.attrib["link"] for child in robot.iter("child")}
    parents = {parent.attrib["link"] for parent in robot.iter("parent")}
    assert links - children == parents == {body}
    assert len(links) == 5


def test_the_picture_of_the_swarm_shows_its_markers() -> None:
    content = yaml.safe_load((SHARE / "rviz/swarm.rviz").read_text(encoding="utf-8"))["Visualization Manager"]
    topics = [display["Topic"]["Value"] for display in content["Displays"] if "Topic" in display]
    assert topics == [f"{names.SWARM}/{names.MARKERS}"]
    assert content["Global Options"]["Fixed Frame"] == names.FRAME
