"""Integration: agents as ROS nodes over UDP leave the bags that agents without ROS leave."""

from __future__ import annotations

import json

import air_helpers as helpers
import pytest
from node_helpers import end_of, ros_graph

pytest.importorskip("dtsa_msgs.msg")

from dtsa_bench.commands.cli import main
from dtsa_bench.log.agent_bag import read

AGENT = "dtsa_agent.ros.agent_node"


def words(agent: int, group: str, **more: object) -> list[str]:
    values = {
        "id": agent, "agents": 2, "air": "udp", "interface": "lo", "group": group, "auth": False, "slot_ms": 20.0,
        "scenario": "waypoints", **more,
    }  # fmt: skip
    return [word for name, value in values.items() for word in ("-p", f"{name}:={str(value).lower()}")]


@pytest.mark.ros
def test_nodes_leave_bags_that_merge_and_verify_take_in_directories_not_in_use(tmp_path, capsys) -> None:
    helpers.need_multicast()
    group, outs = helpers.own_group(), {agent: tmp_path / f"cf{agent}" for agent in (1, 2)}
    with ros_graph(tmp_path) as graph:
        started = [graph.start(AGENT, *words(k, group, duration_s=8.0, out=out)) for k, out in outs.items()]
        assert [end_of(process) for process in started] == [(0, ""), (0, "")]
        code, line = end_of(graph.start(AGENT, *words(1, group, out=outs[1])))
        assert (code, len(line.splitlines())) == (2, 1)  # the directory is in use
        assert f"out: got '{outs[1]}'" in line
    for agent, out in outs.items():
        assert sorted(path.name for path in out.iterdir()) == [f"cf{agent}.mcap", "summary.json"]
        summary = json.loads((out / "summary.json").read_text())
        assert summary["heard"] > 0
        assert read(out).summary == summary
    whole = tmp_path / "whole"
    assert main(["merge", *map(str, outs.values()), "--out", str(whole), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["decisions_again"]["equal"]
    assert found["flight"] is not None
    assert main(["verify", str(whole)]) == 0
