"""Integration: Crazyflies on the live page: their bridge's words are shown, and commands reach simulated vehicles."""

from __future__ import annotations

import subprocess
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("cflib")
pytest.importorskip("rclpy")
pytest.importorskip("dtsa_msgs.srv")
pytest.importorskip("aiohttp")

from bridge_helpers import end_process, fake_fleet, settings
from browser_helpers import CHROMIUM, MISSING, browsing, serving
from builtin_interfaces.msg import Duration
from dtsa_msgs.srv import Arm, Takeoff
from node_helpers import ServedNode, node_command, node_environment
from view_helpers import on_graph
from waiting import wait_for

from dtsa_bench.flights.domain import ros_domain
from dtsa_bench.pages.view.history import RunHistory
from dtsa_bench.pages.view.server import ViewServer

pytestmark = [pytest.mark.ros]
COUNT = 2
STATES = "[...document.querySelectorAll('.vehicles tbody tr')].map(row => row.children[1].firstChild.textContent)"
CLICK = "document.querySelector('[data-command={}]').click()"


def all_are(state: str) -> str:
    return f"(found => found.length === {COUNT} && found.every(state => state === '{state}'))({STATES})"


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
@pytest.mark.realtime
def test_commands_of_the_page_reach_the_crazyflies_and_are_seen_on_it(tmp_path: Path) -> None:
    """Without a run: the bridge alone."""
    history = RunHistory("/swarm")
    with ros_domain() as domain, fake_fleet(tmp_path, COUNT) as fleet, browsing() as browser, ExitStack() as stack:
        config = tmp_path / "swarm.yaml"
        # Nobody streams commands; the browser takes the processor from all.
        safety: dict[str, Any] = {"link_age_s": 3.0, "emergency_watchdog": False}
        config.write_text(yaml.safe_dump(settings(fleet, {"safety": safety})))
        command = node_command("dtsa_agent.crazyflie.node.bridge_node", "-p", f"config:={config}")
        bridge = subprocess.Popen(command, env=node_environment(domain, tmp_path), stdout=subprocess.DEVNULL, text=True)
        stack.callback(end_process, bridge)
        pilot = ServedNode(domain, "pilot")
        stack.callback(pilot.close)
        source = stack.enter_context(on_graph(history, domain))
        browser.open(stack.enter_context(serving(ViewServer(history, "some-token", source.command))))
        browser.wait_for(all_are("ready"))
        assert pilot.call(Arm, "/all/arm", arm=True).success
        browser.wait_for(all_are("armed"))
        assert pilot.call(Takeoff, "/all/takeoff", height=0.6, duration=Duration(sec=2)).success
        browser.wait_for(all_are("flying"))
        assert browser.run("parseFloat(document.querySelector('.vehicles td:nth-child(3)').textContent)") > 3.0
        browser.run(CLICK.format("land"))
        wait_for(lambda: len({event["cf"] for event in fleet.events(name="land")}) == COUNT)
        browser.wait_for(all_are("ready"))
        browser.wait_for("document.querySelector('.vehicles .answer').textContent === 'land: done'")
        browser.run(CLICK.format("emergency"))  # the first step of two
        browser.wait_for("document.querySelector('[data-command=emergency]').textContent.startsWith('Once more')")
        assert browser.run(STATES) == ["ready"] * COUNT
        browser.run(CLICK.format("emergency"))
        browser.wait_for(all_are("emergency"))
        assert not [event for event in fleet.events(name="state") if event["state"] == "crashed"]
        end_process(bridge)
        browser.wait_for(all_are("silent (emergency)"))
        assert browser.complaints() == []
