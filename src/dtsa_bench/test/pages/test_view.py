"""The live view: what its sources tell, who may see it, and that it disturbs nothing."""

from __future__ import annotations

import asyncio
import json
import math
import socket
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bag_helpers import flight_bag
from cli_helpers import refused
from view_helpers import AGENTS, PATIENCE_S, SLOTS, history_of, lossy_bag, numbers

pytest.importorskip("aiohttp")

import aiohttp
from browser_helpers import serving

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_agent.core.errors import ConfigError
from dtsa_bench.log.bag.reader import Bag
from dtsa_bench.log.record import SLOT_RECORD, load_log
from dtsa_bench.pages.view.follower import Follower
from dtsa_bench.pages.view.history import (
    MAX_BYTES,
    MAX_FRAMES,
    MAX_MOMENTS,
    UNKNOWN,
    Moment,
    MomentBuilder,
    PageCommand,
    RunHistory,
    parse_command,
)
from dtsa_bench.pages.view.server import ViewServer, _PageStream
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim.model.verdict import SUCCESS


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lossy_bag(tmp_path_factory.mktemp("view"))


@pytest.fixture(scope="module")
def history(bag: Path) -> RunHistory:
    return history_of(bag)


def test_moments_tell_what_the_bag_holds(bag: Path, history: RunHistory) -> None:
    run = load_log(bag)
    _, moments = history.since(0, MAX_MOMENTS)
    told = [json.loads(moment.text) for moment in moments]
    assert history.state == "recorded"
    slots, senders, outcomes, received = (
        np.concatenate([numbers(one["frames"][name], kind) for one in told])
        for name, kind in (("slot", "<u4"), ("sender", "<u2"), ("outcome", "u1"), ("received", "u1"))
    )
    assert slots.tolist() == run.sent_frames.row.tolist()
    assert senders.tolist() == run.sent_frames.sender.tolist()
    assert outcomes.tolist() == run.outcome[run.sent_frames.row].tolist()
    assert np.abs(received / 255 - run.received.sum(axis=1) / (AGENTS - 1)).max() < 0.01
    for one in told:
        places = numbers(one["place"], "<f4").reshape(-1, 3, AGENTS)
        for slot, place in zip(numbers(one["at"], "<u4").tolist(), places, strict=True):
            assert np.abs(place - run.track[slot, -1]).max() < 1e-5
    assert told[-1]["slot"] == SLOTS


def test_ages_and_beliefs_are_those_of_the_report(bag: Path, history: RunHistory) -> None:
    run = load_log(bag)
    ages = run.knowledge.ages
    assert ages is not None
    table = run.ages_by_observer
    _, moments = history.since(0, MAX_MOMENTS)
    for moment in moments[3:]:
        told = numbers(json.loads(moment.text)["age"], "<u2")
        known = ages.age[moment.slot - 1]
        assert (told == UNKNOWN).tolist() == np.isnan(known).tolist()
        assert np.nanmax(np.abs(np.where(told == UNKNOWN, np.nan, told) / 10 - known)) <= 0.051
        for observer in (1, AGENTS):
            heard = np.frombuffer(moment.belief(observer, AGENTS)[0], "<u2")
            rows = table[(table.slot == moment.slot - 1) & (table.observer == observer)]
            assert heard[rows.agent - 1].tolist() == rows.age_slots.tolist()


def test_agents_that_do_not_take_part_are_in_no_age(bag: Path) -> None:
    """What a killed one has heard does not grow old, and of itself nobody expects anything."""

    def killed(record: Any) -> list[tuple[str, Any]]:
        if record.slot != SLOTS // 2:
            return []
        status = {"slot": record.slot, "lost": [2], "lag_ms": 0.0, "phase": 1, "reason": ""}
        return [("RunStatus", SimpleNamespace(**status))]

    moments = history_of(bag, killed, refused=False).since(0, MAX_MOMENTS)[1]
    known = load_log(bag).ages_by_observer.query("counted and observer != 2 and agent != 2")
    for moment in moments[-3:]:
        told = numbers(json.loads(moment.text)["age"], "<u2") / 10
        means = known[known.slot == moment.slot - 1].groupby("agent").age_slots.mean()
        assert told[means.index - 1] == pytest.approx(means.to_numpy(), abs=0.051)
        assert told[1] == UNKNOWN / 10


def test_agents_that_have_not_reported_disagree_with_nobody(tmp_path: Path) -> None:
    """Neither are they receivers once it is known that they are silent."""
    flight_bag(tmp_path / "bag", slots=60, agents=4, policy="tdma", seed=1)
    history, by_agent = RunHistory("killed"), ("chosen", "digest", "reason", "track")
    follower = Follower(history, {})
    with Bag(tmp_path / "bag") as opened:
        follower.start(opened.config)
        for _, record in list(opened.typed([SLOT_RECORD]))[:-1]:
            if record.slot == 40:
                status = {"slot": 40, "lost": [2], "lag_ms": 0.0, "phase": 1, "reason": ""}
                follower.receive("RunStatus", SimpleNamespace(**status))
            here = np.array([0, 2, 3]) if record.slot >= 30 else np.arange(4)
            fields = {name: getattr(record, name).reshape(-1, 4)[:, here].ravel() for name in by_agent}
            follower.receive("SlotRecord", replace(record, agent=record.agent[here], **fields))
    follower.finish("recorded")
    told = [json.loads(moment.text) for moment in history.since(0, MAX_MOMENTS)[1]]
    assert np.sum([one["agree"] for one in told], axis=0).tolist() == [60, 60]
    assert {one["tables"] for one in told} == {1}
    assert {level for one in told for level in numbers(one["frames"]["received"], "u1")} == {254}


def test_a_crash_that_lasts_one_slot_is_seen(bag: Path) -> None:
    def close(record: Any) -> list[tuple[str, Any]]:
        track = record.track.reshape(-1, 3, AGENTS).copy()
        track[:, :, 1] = track[:, :, 0]
        return [("SlotRecord", replace(record, track=track.ravel()))] if record.slot == 52 else []

    moments = history_of(bag, close, refused=False).since(0, MAX_MOMENTS)[1]
    assert [crash for one in moments for crash in json.loads(one.text)["crashes"]] == [[52, 1, 2, 0.0]]


def test_messages_that_cannot_be_are_refused_and_change_nothing(bag: Path, history: RunHistory) -> None:
    def wrong(record: Any) -> list[tuple[str, Any]]:
        fields = {
            "agent": record.agent + 1, "track": np.append(record.track[:-1], np.nan), "steps": record.steps + 1,
            "sender": np.append(record.sender, 1), "data": np.append(record.data, 0),
            "received": np.append(record.received, 0), "chosen": record.chosen[:1], "digest": record.digest[:1],
            "reason": record.reason[:1],
        }  # fmt: skip
        status = {"slot": record.slot, "lost": [1], "lag_ms": math.nan, "phase": 2, "reason": ""}
        records = [("SlotRecord", replace(record, **{name: values})) for name, values in fields.items()]
        return [*records, ("RunStatus", SimpleNamespace(**status))]

    assert history_of(bag, wrong).since(0, MAX_MOMENTS) == history.since(0, MAX_MOMENTS)


def test_a_history_and_what_waits_for_a_page_are_limited() -> None:
    history = RunHistory("long")
    history.start_run({})
    for slot in range(MAX_MOMENTS + 10):
        history.append(Moment(slot, "{}", b"", b""))
    first, moments = history.since(0, 5)
    assert (first, moments[0].slot, len(moments)) == (10, 10, 5)
    history.start_run({})
    for slot in range(5):
        history.append(Moment(slot, "", b"", bytes(MAX_BYTES // 4)))
    first, moments = history.since(0, 100)
    assert len(moments) <= 4
    assert moments[-1].slot == 4
    run, reason = RunConfig(SwarmConfig(agents=AGENTS)), np.zeros(AGENTS, np.uint8)
    builder = MomentBuilder(history, run, make_scenario(run.swarm), {})
    for slot in range(5 * MAX_FRAMES // 2):
        builder.add_frames(slot, SUCCESS, (slot % AGENTS + 1,), reason, None)
    for _ in "ab":
        builder.append_moment(slot, None, np.zeros(AGENTS, np.uint16), None)
    frames = [json.loads(moment.text)["frames"]["slot"] for moment in history.since(0, 5)[1]]
    assert numbers(frames[0], "<u4").tolist() == list(range(slot - MAX_FRAMES + 1, slot + 1))
    assert not frames[1]


async def _statuses(url: str) -> dict[str, int]:
    base, token = url.rstrip("/").rsplit("/", 1)
    found = {}
    async with aiohttp.ClientSession() as session:
        for name, address, headers in (
            ("page", url, {}),
            ("script", url + "view.js", {}),
            ("own origin", url, {"Origin": base}),
            ("nothing", base + "/", {}),
            ("wrong token", f"{base}/{token[:-1]}x/", {}),
            ("no token", f"{base}/stream", {}),
            ("other file", url + "server.py", {}),
            ("way up", url + "..%2fserver.py", {}),
            ("foreign origin", url, {"Origin": "http://elsewhere.example"}),
            ("foreign host", url, {"Host": "elsewhere.example"}),
        ):
            async with session.get(address, headers=headers) as answer:
                found[name] = answer.status
                assert "no-referrer" in answer.headers.get("Referrer-Policy", "")
        async with session.ws_connect(url + "stream", headers={"Origin": base}) as stream:
            found["stream"] = 101
            assert (await stream.receive_json(timeout=PATIENCE_S))["kind"] == "begin"
            await stream.send_str(json.dumps({"command": {"kind": "jam", "value": True}}))
            while (told := await stream.receive_json(timeout=PATIENCE_S))["kind"] != "answer":
                pass
            assert told["text"].startswith("refused")
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await session.ws_connect(url + "stream", headers={"Origin": "null"})
        found["foreign stream"] = refused.value.status
    return found


def test_only_who_knows_the_token_and_comes_from_here_gets_anything(history: RunHistory) -> None:
    with serving(ViewServer(history, "some-token")) as url:
        assert url.startswith("http://127.0.0.1:")
        found = asyncio.run(_statuses(url))
    allowed = {name: status for name, status in found.items() if status < 400}
    assert allowed == {"page": 200, "script": 200, "own origin": 200, "stream": 101}
    assert {status for name, status in found.items() if name not in allowed} <= {403, 404}


def test_a_page_that_does_not_read_costs_nothing_and_garbage_is_let_go() -> None:
    """The server's memory stays where it is while moments go on; another page gets them all."""
    history = RunHistory("fast")
    history.start_run({"agents": 1})
    big = Moment(0, json.dumps({"filler": "x" * 200_000}), b"", b"")

    async def session(url: str) -> int:
        sleeping = socket.create_connection(("127.0.0.1", int(url.split(":")[2].split("/")[0])))
        path = "/" + url.split("/", 3)[3] + "stream"
        host = url.split("/")[2]
        head = f"GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        key = "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        sleeping.sendall((head + key).encode())
        got = 0
        async with aiohttp.ClientSession() as client, client.ws_connect(url + "stream", max_msg_size=0) as stream:
            for _ in range(40):
                history.append(big)
            while got < 40:
                message = await stream.receive_json(timeout=PATIENCE_S)
                got += len(message.get("moments", ()))
            await stream.send_str("[" * 4000)
            closed = await stream.receive(timeout=PATIENCE_S)
            while closed.type not in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED):
                closed = await stream.receive(timeout=PATIENCE_S)
        sleeping.close()
        return got

    with serving(ViewServer(history, "some-token")) as url:
        assert asyncio.run(session(url)) == 40


class Page:
    """A connection whose other side takes everything."""

    closed = False

    async def send_str(self, _: str) -> None:
        await asyncio.sleep(0)

    async def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize("steps", range(25))
def test_a_page_is_let_go_wherever_sending_stands(steps: int) -> None:
    history = RunHistory("fast")
    history.start_run({"agents": 1})
    for _ in range(500):
        history.append(Moment(0, "{}", b"", b""))

    async def session() -> bool:
        stream = _PageStream(page := Page(), history)  # type: ignore[arg-type]
        running = asyncio.create_task(stream.run())
        for _ in range(steps):
            await asyncio.sleep(0)
        await stream.end(running)
        return running.done() and (page.closed or not steps)

    assert asyncio.run(session())


def test_commands_are_checked() -> None:
    losses = ({"kind": "loss", "value": value} for value in (2, "1", True, float("nan")))
    others = ({"kind": "emergency"}, {"kind": "emergency", "value": True}, {"kind": "partition", "value": "1" * 5000})
    kinds = ({"kind": "reboot"}, {"kind": "kill"}, {"kind": "kill", "value": True}, {"kind": "jam", "value": 1})
    for content in (None, [], {}, *kinds, *losses, *others):
        with pytest.raises(ConfigError):
            parse_command(content)
    assert parse_command({"kind": "kill", "value": 3}) == PageCommand("kill", 3)
    assert parse_command({"kind": "loss", "value": 1}) == PageCommand("loss", value=1.0)
    assert parse_command({"kind": "partition", "value": ""}) == PageCommand("partition", value="")


@pytest.mark.parametrize(("words", "text"), [
    (["view", "runs/a"], "a recorded run is shown by `tools/dtsa report runs/a`"),
    (["view", "--port", "99999"], "port: got"), (["view", "--listen", "0.0.0.0"], "listen: got"),
])  # fmt: skip
def test_unusable_settings_are_one_line(words: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert text in refused(words, capsys)


def test_a_page_is_told_once_that_nobody_hears_anybody(tmp_path: Path) -> None:
    """Also afterwards, of a bag; of one in which frames are heard it is told nothing."""
    for name, loss, told in (("deaf", 1.0, 1), ("well", 0.2, 0)):
        flight_bag(tmp_path / name, slots=300, loss=loss, agents=4, policy="tdma")
        history = history_of(tmp_path / name)
        moments = [json.loads(moment.text) for moment in history.since(0, MAX_MOMENTS)[1]]
        texts = [event[2] for moment in moments for event in moment["events"]]
        found = [text for text in texts if text.startswith("no agent heard another: ")]
        assert len(found) == told, texts
