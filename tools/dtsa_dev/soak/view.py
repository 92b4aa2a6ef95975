"""What a live page costs a flight, and what it shows: pairs of flights with and without it, 70 agents, its memory."""

from __future__ import annotations

import asyncio
import json
import statistics
import subprocess
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count, islice
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from dtsa_agent.core import SwarmConfig, make_scenario
from dtsa_bench.experiments.batch.task import Row
from dtsa_bench.experiments.statistics import median_interval
from dtsa_bench.pages.view.moments import Moment, Moments, run_info
from dtsa_bench.pages.view.recording import BagSource
from dtsa_bench.pages.view.server import ViewServer
from dtsa_bench.pages.view.track import MOST_MOMENTS, Track
from dtsa_bench.runs.config import RunConfig
from dtsa_channel_sim.model.verdict import SUCCESS

from .checks import met
from .chromium import CHROMIUM, MISSING, browsing
from .flights import PATIENCE_S, command, dtsa, end_all, until
from .item import Item, Soak

_NONE, _CLIENT, _PAGE = "nobody looks", "a client that does not render", "a page"
_LOCKSTEP_PAIRS, _REALTIME_ROUNDS = 24, 3  # one flight differs from the next by more than a page costs: many pairs
_FLIGHT = ("--agents", "12", "--no-picture", "--no-stop-on-crash")
_MODES = {
    "lockstep": ("--processes", "1", "--tail-s", "60"),
    "realtime": ("--mode", "realtime", "--policy", "lease", "--slot-ms", "10", "--processes", "2", "--tail-s", "6"),
}
_SLOWER = 0.05  # with a client that does not render, at most
_FEWER = 0.02  # of the frames on time, at most
_MANY, _MANY_S = 70, 15.0  # agents, s of flight
_FRAMES_S, _LEAST_FPS = 10.0, 20.0
_KEPT = (1.3, 2.6)  # of the moments that a page keeps: when it is looked at
_BATCH = 200  # moments sent at a time
_GROWTH_BYTES = 10_000_000


def _items() -> Iterator[Item]:
    for number in range(1, _LOCKSTEP_PAIRS + 1):
        lookers = [_NONE, _CLIENT][:: 1 if number % 2 else -1]
        settings = {"mode": "lockstep", "lookers": lookers}
        yield Item(f"lockstep, pair {number}", settings, 1, 15.0, sample=number == 1)
    for number in range(1, _REALTIME_ROUNDS + 1):
        lookers = [_NONE, _CLIENT, _PAGE][:: 1 if number % 2 else -1]
        settings = {"mode": "realtime", "lookers": lookers}
        yield Item(f"real time, round {number}", settings, number, 60.0, sample=number == 1)
    yield Item(f"{_MANY} agents drawn", {"mode": "frames"}, 1, 60.0, sample=True)
    yield Item("a page left open", {"mode": "memory"}, 1, 90.0)


def _run(item: Item, directory: Path) -> dict[str, Any]:
    mode = item.settings["mode"]
    if mode == "frames":
        return _frames(directory)
    if mode == "memory":
        return _memory(directory)
    found, cut_short = {}, {}
    for number, looker in enumerate(item.settings["lookers"]):
        summary = _flight(directory / str(number), mode, looker, item.seed)
        if mode == "lockstep":
            found[looker] = round(summary["slots"]["total"] / summary["wall_time_s"], 1)
        else:
            found[looker] = round(summary["sends_on_time_share"] or 0.0, 4)
        if summary.get("cut_short"):
            cut_short[looker] = summary["cut_short"]
    return {"mode": mode, "found": found, "cut_short": cut_short}


def _flight(directory: Path, mode: str, looker: str, seed: int) -> dict[str, Any]:
    """A flight with somebody who looks; its summary."""
    directory.mkdir()
    out = directory / "out"
    words = ["fly", "--out", str(out), *_MODES[mode], *_FLIGHT, "--seed", str(seed)]
    if looker == _NONE:
        done = dtsa(*words)
        met(done.returncode == 0 or _cut_short(out), f"the flight fails: {done.stderr.strip()[-300:]}")
    else:
        met(looker != _PAGE or CHROMIUM is not None, MISSING)
        _watched(words, looker, directory)
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    return summary


def _watched(words: Sequence[str], looker: str, directory: Path) -> None:
    with (directory / "said.txt").open("w") as said:
        nothing = subprocess.DEVNULL
        process = subprocess.Popen(command(*words, "--view"), stdin=nothing, stdout=nothing, stderr=said)
        try:
            until(lambda: process.poll() is not None or "\n" in _said(directory), "the page is served")
            met(_said(directory).startswith("view: "), f"no page: {_said(directory)[-300:]}")
            url = _said(directory).split()[1]
            if looker == _PAGE:
                with browsing() as browser:
                    browser.open(url)
                    process.wait(PATIENCE_S)
            else:
                asyncio.run(_read(url))
                process.wait(PATIENCE_S)
        finally:
            end_all(process)
        met(process.returncode == 0 or _cut_short(directory / "out"), f"the flight fails: {_said(directory)[-300:]}")


def _cut_short(out: Path) -> bool:
    """Whether the machine did not keep up: how late the frames were until then is told."""
    path = out / "summary.json"
    return path.is_file() and bool(json.loads(path.read_text(encoding="utf-8")).get("cut_short"))


def _said(directory: Path) -> str:
    return (directory / "said.txt").read_text(encoding="utf-8", errors="replace")


async def _read(url: str) -> None:
    """Takes all that comes and forgets it, to the end of the flight."""
    async with aiohttp.ClientSession() as client, client.ws_connect(url + "stream", max_msg_size=0) as stream:
        with suppress(TimeoutError):
            while (await stream.receive(PATIENCE_S)).type is aiohttp.WSMsgType.TEXT:
                pass


@contextmanager
def serving(server: ViewServer) -> Iterator[str]:
    """A server in a thread of its own; gives the address of its page.

    :param server: the server.
    """
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    url = asyncio.run_coroutine_threadsafe(server.start(), loop).result(PATIENCE_S)
    try:
        yield url
    finally:
        asyncio.run_coroutine_threadsafe(server.stop(), loop).result(PATIENCE_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(PATIENCE_S)
        loop.close()


def _frames(directory: Path) -> dict[str, Any]:
    """Frames a second of many agents, of a recorded run that is played."""
    met(CHROMIUM is not None, MISSING)
    words = ("--agents", str(_MANY), "--processes", "1", "--timeout-s", str(_MANY_S), *_FLIGHT[2:])
    done = dtsa("fly", "--out", str(directory / "out"), *words)
    met(done.returncode == 0, f"the flight fails: {done.stderr.strip()[-300:]}")
    track = Track("recorded")
    BagSource(directory / "out", track).run()
    script = f"""(async () => {{
      dtsa.clock.set(0); if (!dtsa.clock.playing) dtsa.clock.toggle();
      const before = dtsa.live.drawn, begin = performance.now();
      await new Promise(done => setTimeout(done, {1000 * _FRAMES_S}));
      return 1000 * (dtsa.live.drawn - before) / (performance.now() - begin);
    }})()"""
    with serving(ViewServer([track], "recorded")) as url, browsing() as browser:
        browser.open(url)
        browser.wait_for(f"dtsa.views.length === 1 && dtsa.views[0].run.time >= {_MANY_S - 0.5}")
        rate = float(browser.run(script))
        bodies = bool(browser.run("Boolean(document.querySelector('canvas.bodies'))"))
        met(not browser.complaints(), f"the page complains: {browser.complaints()[:2]}")
    met(rate >= _LEAST_FPS, f"{rate:.1f} frames a second of {_MANY} agents")
    return {"mode": "frames", "agents": _MANY, "frames_per_s": round(rate, 1), "webgl": bodies}


def _endless() -> tuple[dict[str, Any], Iterator[Moment]]:
    """What a page has to know of a run, and moments of it without end."""
    config = SwarmConfig(agents=12)
    scenario, reason, chosen = make_scenario(config), np.zeros(12, np.uint8), np.zeros(12, np.uint16)
    moments = Moments(scenario, config.slot_ns)

    def told() -> Iterator[Moment]:
        for first in count(0, moments.place_slots):
            turn = first / 1000.0
            moments.place(first, scenario.start * np.array([[np.cos(turn)], [np.sin(turn)], [1.0]]))
            for slot in range(first, first + moments.place_slots):
                moments.frames(slot, SUCCESS, [slot % 12 + 1], reason, None)
            yield moments.moment(moments.gather(first, None, chosen, None))

    return {**run_info("endless", RunConfig(config), scenario), "live": True}, told()


def _memory(directory: Path) -> dict[str, Any]:
    """Bytes of a page that has as many moments as it keeps, ten minutes of a flight, and later."""
    met(CHROMIUM is not None, MISSING)
    info, moments = _endless()
    track = Track("endless")
    track.begin(info)
    kept: list[int] = []
    with serving(ViewServer([track], "endless")) as url, browsing() as browser:
        browser.open(url)
        sent = 0
        for part in _KEPT:
            while sent < part * MOST_MOMENTS:
                batch = list(islice(moments, _BATCH))
                for moment in batch:
                    track.add(moment)
                sent += len(batch)
                newest_s = batch[-1].slot * info["slot_s"] - 0.001
                browser.wait_for(f"dtsa.views.length === 1 && dtsa.views[0].run.time >= {newest_s}")
            kept.append(browser.heap())
        met(not browser.complaints(), f"the page complains: {browser.complaints()[:2]}")
    growth = kept[-1] - kept[0]
    met(growth < _GROWTH_BYTES, f"the page grows by {growth} bytes: {kept}")
    return {"mode": "memory", "moments": [round(part * MOST_MOMENTS) for part in _KEPT], "bytes": kept}


def _figures(rows: Sequence[Row]) -> dict[str, Any]:
    found = [row["summary"] for row in rows]
    figures: dict[str, Any] = {one["mode"]: one for one in found if one["mode"] in ("frames", "memory")}
    pairs = [one["found"] for one in found if one["mode"] == "lockstep"]
    if pairs:
        slower = [pair[_NONE] / pair[_CLIENT] - 1.0 for pair in pairs]
        figures["lockstep"] = {
            "slots_per_s": {looker: [round(pair[looker], 1) for pair in pairs] for looker in (_NONE, _CLIENT)},
            "slower_by": [round(one, 4) for one in slower],
            "slower_by_median": round(statistics.median(slower), 4),
            "slower_by_interval": [round(end, 4) for end in median_interval(slower)],
            "kept": statistics.median(slower) <= _SLOWER,
        }
    flights = [one for one in found if one["mode"] == "realtime"]
    if flights:
        rounds = [one["found"] for one in flights]
        shares = {looker: [one[looker] for one in rounds] for looker in (_NONE, _CLIENT, _PAGE)}
        middle = {looker: statistics.median(values) for looker, values in shares.items()}
        figures["frames on time"] = {
            "shares": shares,
            "medians": middle,
            "cut_short": [one["cut_short"] for one in flights],
            "kept": {looker: middle[_NONE] - middle[looker] <= _FEWER for looker in (_CLIENT, _PAGE)},
        }
    return figures


SOAK = Soak(
    "view",
    "A client that does not render slows lockstep by 5 % at most and leaves frames on time; a page draws 70 agents at "
    "20 frames a second or more, and does not grow when it is left open.",
    tuple(_items()),
    _run,
    _figures,
)
