"""The server of the page: on this machine alone, behind a token, and without a queue for anybody who does not read."""

from __future__ import annotations

import asyncio
import hmac
import json
import secrets
import socket
import time
from base64 import b64encode
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from dtsa_agent.core.errors import ConfigError, DtsaError

from .moments import BELIEFS, belief
from .orders import Order, read_order
from .page import ASSETS, asset_of, page_html
from .track import Track, Vehicles

LOOPBACK = "127.0.0.1"
RATE_HZ = 20.0  # messages a second to one page, at most
BATCH = 200  # moments in one message
MOST_PAGES = 16
_LONGEST_ORDER = 4096  # bytes
_PATIENCE_S = 60.0  # a page that reads nothing for so long is let go
_ORDERS_PER_S = 20.0
_GOODBYE_S = 2.0  # for one page to be let go
_POLICY = "Content-Security-Policy"
_HEADERS = {
    _POLICY: "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self' {stream}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",  # the address holds the token
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class ViewServer:
    """Serves a page that shows runs.

    :param tracks: the runs, side by side.
    :param token: what stands in the address; whoever does not know it gets nothing.
    :param order: takes what the page orders; None: the page may order nothing.
    """

    def __init__(self, tracks: Sequence[Track], token: str, order: Callable[[Order], str] | None = None) -> None:
        self._tracks = list(tracks)
        self._token = token
        self._order = order
        self._pages: dict[web.WebSocketResponse, _Reader] = {}
        self._hosts: set[str] = set()
        self.application = web.Application(middlewares=[self._guard], client_max_size=_LONGEST_ORDER)
        self.application.router.add_get("/{token}/", self._page)
        self.application.router.add_get("/{token}/stream", self._stream)
        self.application.router.add_get("/{token}/{name}", self._asset)

    async def start(self, port: int = 0, address: str = LOOPBACK) -> str:
        """Begins to listen.

        :param port: 0: any that is free.
        :param address: whose connections are taken.
        :returns: the address of the page, with its token.
        :raises ConfigError: if the port cannot be had.
        """
        self._runner = web.AppRunner(self.application, access_log=None, handle_signals=False, shutdown_timeout=1.0)
        await self._runner.setup()
        family = socket.AF_INET6 if ":" in address else socket.AF_INET
        listening = socket.socket(family, socket.SOCK_STREAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((address, port))
        except OSError as error:
            listening.close()
            await self._runner.cleanup()
            raise ConfigError("port", port, f"one that is free on {address} ({error.strerror or error})") from None
        await web.SockSite(self._runner, listening).start()
        bound = listening.getsockname()[1]
        shown = f"[{address}]" if ":" in address else address
        self._hosts = {f"{name}:{bound}" for name in {shown, LOOPBACK, "localhost"}}
        return f"http://{shown}:{bound}/{self._token}/"

    async def stop(self, patience_s: float = 0.0) -> None:
        """Lets all pages go, and ends.

        :param patience_s: s, for pages to take what they do not have yet.
        """
        deadline = time.monotonic() + patience_s
        while time.monotonic() < deadline and any(reader.behind for reader in self._pages.values()):
            await asyncio.sleep(0.02)
        for page in list(self._pages):
            with suppress(Exception):
                await asyncio.wait_for(page.close(code=WSCloseCode.GOING_AWAY, message=b"the end"), _GOODBYE_S / 2)
        await self._runner.cleanup()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Nobody from elsewhere, and nobody without the token."""
        given = request.match_info.get("token", "")
        known = hmac.compare_digest(given.encode(), self._token.encode())
        origin = request.headers.get("Origin")
        # A name that leads here by a foreign name server is not ours (DNS rebinding).
        ours = request.headers.get("Host", "") in self._hosts
        if not known or not ours or (origin is not None and origin not in {f"http://{host}" for host in self._hosts}):
            return web.Response(status=403, text="not allowed\n", headers=_HEADERS)
        response: web.StreamResponse = await handler(request)
        if not response.prepared:
            response.headers.update(_HEADERS)
            policy = _HEADERS[_POLICY].format(stream=f"ws://{request.headers['Host']}")
            response.headers[_POLICY] = policy
        return response

    async def _page(self, _: web.Request) -> web.Response:
        return web.Response(text=page_html(self._order is not None), content_type="text/html")

    async def _asset(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        if name not in ASSETS:
            return web.Response(status=404, text="no such file\n")
        return web.Response(body=asset_of(name), content_type=ASSETS[name].kind, charset="utf-8")

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Origin") is None and request.headers.get("Sec-Fetch-Site") not in (None, "same-origin"):
            return web.Response(status=403, text="not allowed\n")
        if len(self._pages) >= MOST_PAGES:
            return web.Response(status=503, text="too many pages\n")
        page = web.WebSocketResponse(max_msg_size=_LONGEST_ORDER, heartbeat=30.0, compress=False)
        await page.prepare(request)
        reader = self._pages[page] = _Reader(page, self._tracks)
        sending = asyncio.create_task(reader.run())
        try:
            await self._listen(page, reader)
        finally:
            await reader.end(sending)
            self._pages.pop(page, None)
        return page

    async def _listen(self, page: web.WebSocketResponse, reader: _Reader) -> None:
        """Takes in what a page asks for, a few times a second."""
        async for message in page:
            if message.type != WSMsgType.TEXT:
                break
            try:
                content = json.loads(message.data)
                if isinstance(content, dict) and "ghosts" in content:
                    reader.choose(content.get("run", 0), content["ghosts"])
                elif isinstance(content, dict) and "order" in content:
                    reader.answer = self._take(content["order"])
            except (ValueError, TypeError, RecursionError):
                break  # not our page
            await asyncio.sleep(1 / _ORDERS_PER_S)

    def _take(self, content: Any) -> str:
        if self._order is None:
            return "refused: started without --control"
        try:
            return self._order(read_order(content))
        except DtsaError as error:
            return f"refused: {error}"


class _Reader:
    """What one page has been sent; it asks for the next moments when it has taken the last ones.

    :param page: the connection.
    :param tracks: the runs.
    """

    def __init__(self, page: web.WebSocketResponse, tracks: Sequence[Track]) -> None:
        self._page, self._tracks = page, tracks
        self._run = [0] * len(tracks)  # number of the run that the page knows
        self._next = [0] * len(tracks)  # first moment that it does not have
        self._state = ["-"] * len(tracks)
        self._vehicles: list[Vehicles | None] = [None] * len(tracks)  # that the page has been told
        self._chosen = [0] * len(tracks)  # agent whose beliefs it wants
        self._next_belief = [0] * len(tracks)
        self.answer = ""  # to its last order
        self._ended = False

    def choose(self, run: int, agent: int) -> None:
        """The page wants to see what an agent believes; others are ignored.

        :param run: index of the run.
        :param agent: id; 0: nobody.
        """
        if not 0 <= int(run) < len(self._tracks):
            return
        info = self._tracks[run].info[1]
        if info and 0 <= int(agent) <= min(info["agents"], BELIEFS):
            self._chosen[run], self._next_belief[run] = int(agent), 0

    async def run(self) -> None:
        """Sends what is new until the page goes."""
        try:
            while not self._page.closed and not self._ended:
                await self._send_news()
                await asyncio.sleep(1 / RATE_HZ if not self.behind else 0.0)
        finally:  # the page may connect again
            with suppress(Exception):
                await asyncio.wait_for(self._page.close(), _GOODBYE_S / 2)

    async def end(self, running: asyncio.Task[None]) -> None:
        """Ends `run`, which may be anywhere.

        :param running: the task that it is.
        """
        self._ended = True  # before Python 3.12, wait_for drops a cancellation when what it waits for is just done
        running.cancel()
        ended, _ = await asyncio.wait({running}, timeout=_GOODBYE_S)
        for task in ended:
            if not task.cancelled():
                task.exception()  # a page that has gone is no error

    async def _send_news(self) -> None:
        for index in range(len(self._tracks)):
            for content in self._news(index):
                await self._send(content)
        if self.answer:
            content, self.answer = json.dumps({"kind": "answer", "text": self.answer}), ""
            await self._send(content)

    @property
    def behind(self) -> bool:
        """Whether there is something that the page has not been sent."""
        for index, track in enumerate(self._tracks):
            if track.info[1] is None:
                continue
            if track.since(self._next[index], 1)[1] or track.state != self._state[index]:
                return True
            if self._chosen[index] and track.since(self._next_belief[index], 1)[1]:
                return True
        return False

    async def _send(self, text: str) -> None:
        """Waits until the page has taken it, or for a minute at most."""
        await asyncio.wait_for(self._page.send_str(text), _PATIENCE_S)

    def _news(self, index: int) -> list[str]:
        track = self._tracks[index]
        told: list[str] = []
        if (vehicles := track.vehicles) is not self._vehicles[index] and vehicles is not None:
            self._vehicles[index] = vehicles
            content = {"kind": "vehicles", "run": index, "told": vehicles.told, "answer": vehicles.answer}
            told.append(json.dumps(content))
        number, info = track.info
        if info is None:
            return told
        if number != self._run[index]:
            self._run[index], self._next_belief[index], self._state[index] = number, 0, "-"
            told.append(json.dumps({"kind": "begin", "run": index, "info": info, "runs": len(self._tracks)}))
        first, moments = track.since(self._next[index], BATCH)
        if moments:
            self._next[index] = first + len(moments)
            body = ",".join(moment.text for moment in moments)
            told.append(f'{{"kind":"moments","run":{index},"first":{first},"moments":[{body}]}}')
        elif track.state != self._state[index]:
            self._state[index] = track.state
            told.append(json.dumps({"kind": "state", "run": index, "text": track.state}))
        if self._chosen[index]:
            told += self._beliefs(index, info["agents"])
        return told

    def _beliefs(self, index: int, agents: int) -> list[str]:
        until = self._next[index]
        first, moments = self._tracks[index].since(self._next_belief[index], BATCH)
        moments = moments[: max(0, until - first)]
        if not moments:
            return []
        self._next_belief[index] = first + len(moments)
        told = [belief(moment, self._chosen[index], agents) for moment in moments]
        some = [k for k, one in enumerate(told) if one.heard]
        content = {
            "kind": "ghosts",
            "run": index,
            "agent": self._chosen[index],
            "at": [first + k for k in some],
            "heard": b64encode(b"".join(told[k].heard for k in some)).decode("ascii"),
            "place": b64encode(b"".join(told[k].believed for k in some)).decode("ascii"),
        }
        return [json.dumps(content, separators=(",", ":"))]


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(24)
