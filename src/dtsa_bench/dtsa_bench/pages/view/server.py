"""The server of the page: on this machine alone, behind a token, and without a queue for a page that does not read."""

from __future__ import annotations

import asyncio
import hmac
import json
import secrets
import socket
import time
from base64 import b64encode
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from aiohttp import WSCloseCode, WSMsgType, web

from dtsa_agent.core.errors import ConfigError, DtsaError
from dtsa_agent.core.registry import REASON_TEXTS
from dtsa_bench.pages.html import PALETTE, SCRIPTS, asset, render_page

from .history import MAX_BELIEVERS, PageCommand, RunHistory, VehicleStates, parse_command

LOOPBACK = "127.0.0.1"
RATE_HZ = 20.0  # messages a second to one page, at most
BATCH = 200  # moments in one message
MAX_PAGES = 16
_STYLES = ("style.css", "view.css")
_ASSETS = {
    **dict.fromkeys((*SCRIPTS, "run.js", "panels.js", "view.js"), "text/javascript"),
    **dict.fromkeys(_STYLES, "text/css"),
}
_MAX_MESSAGE = 4096  # bytes, of a page
_SEND_TIMEOUT_S = 60.0  # a page that reads nothing for so long is disconnected
_MESSAGES_PER_S = 20.0  # of a page
_CLOSE_S = 2.0  # for one page to disconnect
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
    """Serves a page that shows a run.

    :param token: part of the address; a request without it gets nothing.
    :param command: accepts commands of a page; None: pages may not command.
    """

    def __init__(self, history: RunHistory, token: str, command: Callable[[PageCommand], str] | None = None) -> None:
        self._history, self._token, self._command = history, token, command
        self._pages: dict[web.WebSocketResponse, _PageStream] = {}
        self._hosts: set[str] = set()
        self.application = web.Application(middlewares=[self._guard], client_max_size=_MAX_MESSAGE)
        self.application.router.add_get("/{token}/", self._page)
        self.application.router.add_get("/{token}/stream", self._stream)
        self.application.router.add_get("/{token}/{name}", self._asset)

    async def start(self, port: int = 0, address: str = LOOPBACK) -> str:
        """Start to listen on an address of this machine (port 0: any); return the address of the page.

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

    async def stop(self, wait_s: float = 0.0) -> None:
        """Disconnect all pages, and end; `wait_s`: for pages to receive what they do not have yet."""
        deadline = time.monotonic() + wait_s
        for stream in self._pages.values():
            stream.is_behind = True  # until it has found nothing more to send
        while time.monotonic() < deadline and any(stream.is_behind for stream in self._pages.values()):
            await asyncio.sleep(0.02)
        for page in list(self._pages):
            with suppress(Exception):
                await asyncio.wait_for(page.close(code=WSCloseCode.GOING_AWAY, message=b"the end"), _CLOSE_S / 2)
        await self._runner.cleanup()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Refuse requests from elsewhere, and requests without the token."""
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
        data = {"runs": [], "palette": PALETTE, "reasons": dict(REASON_TEXTS), "control": self._command is not None}
        page = render_page("view", "DTSA, live", (*SCRIPTS, "view.js"), data, styles=_STYLES, served=True)
        return web.Response(text=page, content_type="text/html")

    async def _asset(self, request: web.Request) -> web.Response:
        name = request.match_info["name"]
        if name not in _ASSETS:
            return web.Response(status=404, text="no such file\n")
        return web.Response(text=asset(name), content_type=_ASSETS[name], charset="utf-8")

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        if request.headers.get("Origin") is None and request.headers.get("Sec-Fetch-Site") not in (None, "same-origin"):
            return web.Response(status=403, text="not allowed\n")
        if len(self._pages) >= MAX_PAGES:
            return web.Response(status=503, text="too many pages\n")
        page = web.WebSocketResponse(max_msg_size=_MAX_MESSAGE, heartbeat=30.0, compress=False)
        await page.prepare(request)
        stream = self._pages[page] = _PageStream(page, self._history)
        sending = asyncio.create_task(stream.run())
        try:
            await self._listen(page, stream)
        finally:
            await stream.end(sending)
            self._pages.pop(page, None)
        return page

    async def _listen(self, page: web.WebSocketResponse, stream: _PageStream) -> None:
        """Receive messages of a page, a few times a second."""
        async for message in page:
            if message.type != WSMsgType.TEXT:
                break
            try:
                content = json.loads(message.data)
                if isinstance(content, dict) and "ghosts" in content:
                    stream.choose(content["ghosts"])
                elif isinstance(content, dict) and "command" in content:
                    stream.answer = self._accept(content["command"])
            except (ValueError, TypeError, RecursionError):
                break  # not our page
            await asyncio.sleep(1 / _MESSAGES_PER_S)

    def _accept(self, content: Any) -> str:
        if self._command is None:
            return "refused: started without --control"
        try:
            return self._command(parse_command(content))
        except DtsaError as error:
            return f"refused: {error}"


class _PageStream:
    """What one page has been sent; it gets the next moments when it has read the last ones."""

    def __init__(self, page: web.WebSocketResponse, history: RunHistory) -> None:
        self._page, self._history = page, history
        self._run = 0  # number of the run that the page knows
        self._next = 0  # first moment that it does not have
        self._state = "-"
        self._vehicles: VehicleStates | None = None  # that the page knows
        self._chosen = 0  # agent whose beliefs it shows
        self._next_belief = 0
        self.answer = ""  # to its last command
        self.is_behind = True  # whether there may be something that the page has not been sent
        self._ended = False

    def choose(self, agent: int) -> None:
        """Send what an agent (id; 0: none) believes from now on; other numbers are ignored."""
        info = self._history.info[1]
        if info and 0 <= int(agent) <= min(info["agents"], MAX_BELIEVERS):
            self._chosen, self._next_belief = int(agent), 0

    async def run(self) -> None:
        """Send what is new until the page disconnects."""
        try:
            while not self._page.closed and not self._ended:
                updates = self._updates()
                for content in updates:  # waits until the page has received it, or for a minute at most
                    await asyncio.wait_for(self._page.send_str(content), _SEND_TIMEOUT_S)
                self.is_behind = bool(updates)
                await asyncio.sleep(0.0 if updates else 1 / RATE_HZ)
        finally:  # the page may connect again
            with suppress(Exception):
                await asyncio.wait_for(self._page.close(), _CLOSE_S / 2)

    async def end(self, running: asyncio.Task[None]) -> None:
        """End the task of `run`, at whatever step it is."""
        self._ended = True  # before Python 3.12, wait_for drops a cancellation when what it waits for is just done
        running.cancel()
        ended, _ = await asyncio.wait({running}, timeout=_CLOSE_S)
        for task in ended:
            if not task.cancelled():
                task.exception()  # a page that has gone is no error

    def _updates(self) -> list[str]:
        history = self._history
        updates: list[str] = []
        if self.answer:
            updates.append(json.dumps({"kind": "answer", "text": self.answer}))
            self.answer = ""
        if (vehicles := history.vehicles) is not self._vehicles and vehicles is not None:
            self._vehicles = vehicles
            updates.append(json.dumps({"kind": "vehicles", "rows": vehicles.rows, "answer": vehicles.answer}))
        number, info = history.info
        if info is None:
            return updates
        if number != self._run:
            self._run, self._next_belief, self._state = number, 0, "-"
            updates.append(json.dumps({"kind": "begin", "info": info}))
        first, moments = history.since(self._next, BATCH)
        if moments:
            self._next = first + len(moments)
            body = ",".join(moment.text for moment in moments)
            updates.append(f'{{"kind":"moments","first":{first},"moments":[{body}]}}')
        elif history.state != self._state:
            self._state = history.state
            updates.append(json.dumps({"kind": "state", "text": history.state}))
        if self._chosen:
            updates += self._beliefs(info["agents"])
        return updates

    def _beliefs(self, agents: int) -> list[str]:
        first, moments = self._history.since(self._next_belief, BATCH)
        moments = moments[: max(0, self._next - first)]
        if not moments:
            return []
        self._next_belief = first + len(moments)
        beliefs = [moment.belief(self._chosen, agents) for moment in moments]
        known = [k for k, (heard, _) in enumerate(beliefs) if heard]
        content = {
            "kind": "ghosts",
            "agent": self._chosen,
            "at": [first + k for k in known],
            "heard": b64encode(b"".join(beliefs[k][0] for k in known)).decode("ascii"),
            "place": b64encode(b"".join(beliefs[k][1] for k in known)).decode("ascii"),
        }
        return [json.dumps(content, separators=(",", ":"))]


def new_token() -> str:
    """A token that nobody guesses."""
    return secrets.token_urlsafe(24)
