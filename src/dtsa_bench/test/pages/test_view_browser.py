"""Integration: The live view in a browser, and flights with a page."""

from __future__ import annotations

import asyncio
import json
import re
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("aiohttp")

import aiohttp
from browser_helpers import CHROMIUM, MISSING, browsing, colours, serving
from view_helpers import AGENTS, PATIENCE_S, history_of, lossy_bag, numbers, on_graph, viewed_flight
from waiting import wait_for

from dtsa_agent.core import SwarmConfig
from dtsa_bench.log.record import load_log
from dtsa_bench.pages.view.history import MAX_MOMENTS, Moment, PageCommand, RunHistory, VehicleStates
from dtsa_bench.pages.view.server import ViewServer
from dtsa_bench.runs.config import RunConfig

FIGURES = """(() => ({
  heads: [...document.querySelectorAll("h2")].map(node => node.textContent),
  values: [...document.querySelectorAll(".figure .value")].map(node => node.textContent),
  rows: document.querySelectorAll("button.agent").length, charts: document.querySelectorAll("svg.plot").length,
  title: document.title,
}))()"""


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_chromium_plays_a_run_and_shows_what_an_agent_believes(tmp_path: Path) -> None:
    history = history_of(lossy_bag(tmp_path))
    with serving(ViewServer(history, "some-token")) as url, browsing() as browser:
        browser.open(url)
        browser.wait_for("dtsa.live.view.run.record.count >= 150")
        browser.run("dtsa.clock.set(1.0); if (dtsa.clock.playing) dtsa.clock.toggle(); dtsa.clock.set(1.0)")
        found = browser.run(FIGURES)
        assert found["rows"] == AGENTS
        assert found["charts"] == 3
        assert {"Slots", "Agents", "Events", "Distances", "Age", "Channel use"} <= set(found["heads"])
        assert "Control" not in found["heads"]
        assert "lossy" in found["title"]
        assert found["values"][3].endswith("m")
        browser.run("document.querySelectorAll('button.agent')[1].click()")
        browser.wait_for("dtsa.live.view.run.ghosts(1.0) !== null")
        ages = browser.run("[...dtsa.live.view.run.ghosts(1.0).age]")
        row = next(k for k, m in enumerate(history.since(0, 1000)[1]) if m.slot == 100)
        assert ages == np.frombuffer(history.since(row, 1)[1][0].belief(2, AGENTS)[0], "<u2").tolist()
        before = browser.run("dtsa.clock.time")
        browser.run("dtsa.clock.toggle()")
        browser.wait_for(f"dtsa.clock.time > {before} + 0.1")
        assert colours(browser.picture(), tmp_path) > 150
        assert browser.complaints() == []


LONG_RUN = """import("./run.js").then(({LiveRun}) => {
  const pack = values => btoa(String.fromCharCode(...new Uint8Array(values.buffer)));
  const box = [[0, 0, 0], [1, 1, 1]], ones = pack(new Uint8Array(4000).fill(1)), one = pack(new Uint16Array(1));
  const run = new LiveRun({agents: 1, slot_s: 0.01, box, target: [[0, 0, 0]], reasons: [], moving: [true]});
  const senders = pack(new Uint16Array(4000).fill(1));
  for (let slot = 4000; slot <= 280000; slot += 4000) {
    const slots = pack(Uint32Array.from({length: 4000}, (_, k) => slot - 4000 + k));
    const frames = {slot: slots, sender: senders, outcome: ones, reason: ones, received: ones};
    run.take(slot / 4000, [{slot, at: "", place: "", frames, agree: [0, 0], tables: 0, age: one, chosen: one,
      absent: [], events: [], crashes: []}]);
  }
  return [run.record.first === run.record.slot[0], run.record.first > 0, run.record.first + run.record.count];
})"""


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_the_slots_of_a_long_run_end_with_the_newest(tmp_path: Path) -> None:
    with serving(ViewServer(history_of(lossy_bag(tmp_path)), "some-token")) as url, browsing() as browser:
        browser.open(url)
        browser.wait_for("dtsa.live.view.run.record.count >= 150")
        assert browser.run(LONG_RUN) == [True, True, 280_000]


@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_chromium_shows_what_crazyflies_say_as_text(tmp_path: Path) -> None:
    recorded = history_of(lossy_bag(tmp_path))
    mission = RunHistory("mission")
    info = {"name": "mission", "live": True, "control": True, "listener": True}
    mission.start_run({**(recorded.info[1] or {}), **info})
    mission.vehicles = VehicleStates(
        (("cf1", "flying", 3.91, 0.98, ""), ("cf2", "<b>landing</b>", 3.2, 0.5, "low battery"))
    )
    mission.append(Moment(0, recorded.since(0, 1)[1][0].text, b"", b""))
    with serving(ViewServer(mission, "some-token", lambda command: "")) as url, browsing() as browser:
        browser.open(url)
        browser.wait_for("document.querySelector('.vehicles tbody').textContent.includes('<b>landing</b>')")
        browser.wait_for("document.querySelectorAll('.commands').length === 1")
        assert browser.run("document.querySelectorAll('.listener').length") == 1
        assert browser.complaints() == []


def slots_of(history: RunHistory) -> int:
    return sum(len(numbers(json.loads(m.text)["frames"]["slot"], "<u4")) for m in history.since(0, MAX_MOMENTS)[1])


def words_of(history: RunHistory) -> str:
    return "\n".join(
        event[2] for moment in history.since(0, MAX_MOMENTS)[1] for event in json.loads(moment.text)["events"]
    )


@pytest.mark.ros
@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
@pytest.mark.realtime
def test_a_kill_from_the_page_reaches_the_node_and_is_seen_on_it(tmp_path: Path) -> None:
    from fly_helpers import pid_of

    words = ("--mode", "realtime", "--policy", "lease", "--agents", "3", "--slot-ms", "40", "--tail-s", "90")
    page = viewed_flight(tmp_path / "run", *words, "--control")
    listener = RunHistory("graph")
    with browsing() as browser, page as (process, url), ExitStack() as stack:
        browser.open(url)
        browser.wait_for("dtsa.live.view.run.record.count > 20")
        environment = Path(f"/proc/{pid_of(process.pid, 2)}/environ").read_text()
        domain = int(re.search(r"\bROS_DOMAIN_ID=(\d+)", environment)[1])  # type: ignore[index]
        source = stack.enter_context(on_graph(listener, domain))
        wait_for(lambda: listener.since(0, 1)[1], what="nothing is heard on the graph")
        browser.run("document.querySelector('.commands select').value = '2'")
        browser.run("document.querySelector('[data-command=kill]').click()")
        browser.wait_for("dtsa.live.view.run.lost.has(2)")
        browser.wait_for("[...document.querySelectorAll('.events li')].some(node => node.textContent.includes('cf2'))")
        browser.run("document.querySelector('[data-command=jam]').click()")
        browser.wait_for("dtsa.live.view.run.events.some(event => event.text.includes('jam is True'))")
        browser.run("document.querySelector('[data-command=clear]').click()")
        browser.run("document.querySelector('[data-command=start]').click()")
        browser.wait_for("!dtsa.live.view.run.lost.has(2)")
        assert browser.complaints() == []
        wait_for(lambda: "cf2 takes part again" in words_of(listener))  # who listens on the graph sees the same
        source.command(PageCommand("loss", value=0.25))
        wait_for(lambda: "loss 0.25: done" in words_of(listener))
        browser.wait_for("dtsa.live.view.run.events.some(event => event.text.includes('loss is 0.25'))")
        wait_for(lambda: slots_of(listener) > 50)
        stack.close()
        moments = listener.since(0, MAX_MOMENTS)[1]
        assert moments[-1].heard
        assert json.loads(moments[-1].text)["lag_ms"] > 0.0


@pytest.mark.ros
def test_a_page_that_hears_of_the_end_before_the_settings_shows_the_end(tmp_path: Path) -> None:
    """Both are there for late subscribers, and come in any order."""
    from dtsa_msgs.msg import Configuration, RunStatus
    from node_helpers import ros_graph
    from rclpy.duration import Duration

    from dtsa_agent.ros.common import names
    from dtsa_channel_sim.ros.run_topics import configuration_message

    history = RunHistory("late")
    with ros_graph(tmp_path) as graph, on_graph(history, graph.node.context.get_domain_id()):
        make, qos = graph.node.create_publisher, names.latched_qos()
        status = make(RunStatus, f"{names.SWARM}/{names.STATUS}", qos)
        status.publish(RunStatus(run=7, phase=RunStatus.ENDED, reason="all are there"))
        wait_for(status.get_subscription_count)
        assert status.wait_for_all_acked(Duration(seconds=PATIENCE_S))
        time.sleep(0.2)  # it is read
        settings = RunConfig(SwarmConfig(agents=2)).to_dict()
        make(Configuration, f"{names.SWARM}/{names.CONFIGURATION}", qos).publish(configuration_message(settings, 7))
        wait_for(lambda: history.state == "ended: all are there")


@pytest.mark.ros
def test_a_lockstep_flight_shows_its_page_what_is_in_its_bag(tmp_path: Path) -> None:
    """Read without a browser, to the end of the flight. A listener for which nobody waits may miss a slot."""

    async def moments(url: str) -> list[dict[str, Any]]:
        got: list[dict[str, Any]] = []
        async with aiohttp.ClientSession() as client, client.ws_connect(url + "stream", max_msg_size=0) as stream:
            async for message in stream:
                content = json.loads(message.data)
                got += content.get("moments", ())
                if content["kind"] == "state" and content["text"].startswith("ended"):
                    break
        return got

    schedule = tmp_path / "channel.yaml"
    schedule.write_text("schedule: [{slot: 100, until: 150, jam: true}]")
    words = ("--agents", "4", "--processes", "1", "--no-picture", "--channel", str(schedule))
    with viewed_flight(tmp_path / "run", *words) as (process, url):
        received = asyncio.run(moments(url))
        process.wait(PATIENCE_S)
    run = load_log(tmp_path / "run")
    recorded = list(zip(run.sent_frames.row.tolist(), run.sent_frames.sender.tolist(), strict=True))
    columns = [
        np.concatenate([numbers(one["frames"][name], kind) for one in received]).tolist()
        for name, kind in (("slot", "<u4"), ("sender", "<u2"))
    ]
    shown = list(zip(*columns, strict=True))
    assert set(shown) <= set(recorded)
    assert shown == sorted(shown)
    assert len(shown) > 0.5 * len(recorded)
    assert received[-1]["slot"] >= len(run) - 1
    events = [event for one in received for event in one["events"]]
    assert any("the run has ended: completed" in event[2] for event in events)
    jam = [[100, "air", "jam is True from now on"], [150, "air", "jam is False from now on"]]
    assert [event for event in events if event[1] == "air"] == jam
