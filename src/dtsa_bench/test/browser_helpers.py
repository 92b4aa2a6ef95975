"""A headless Chromium of this machine, steered by Playwright."""

from __future__ import annotations

import asyncio
import shutil
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dtsa_bench.pages.view.server import ViewServer

if TYPE_CHECKING:
    from playwright.sync_api import ConsoleMessage, Page

_NAMES = ("chromium", "chromium-browser", "google-chrome") if find_spec("playwright") else ()
#: Path of the browser; None: `MISSING`.
CHROMIUM = next((path for name in _NAMES if (path := shutil.which(name))), None)
MISSING = "no Chromium on this machine, or no Playwright (`tools/dtsa setup --extra dev`)"
PATIENCE_S = 90.0
_OPTIONS = ("--enable-unsafe-swiftshader", "--disable-gpu", "--disable-dev-shm-usage")


class Browser:
    def __init__(self, page: Page) -> None:
        self._page = page
        self._tools = page.context.new_cdp_session(page)
        self._said: list[str] = []
        page.on("pageerror", lambda error: self._said.append(str(error)))
        page.on("console", self._hear)

    def _hear(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "assert"):
            self._said.append(message.text)

    def open(self, url: str) -> None:
        self._page.goto(url)

    def run(self, script: str) -> Any:
        """What an expression of JavaScript gives, as JSON types."""
        # Not by the page's `eval`, which its security policy may forbid.
        wanted = {"expression": script, "returnByValue": True, "awaitPromise": True}
        found = self._tools.send("Runtime.evaluate", wanted)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, condition: str) -> None:
        """Waits until an expression is true; one that fails is not true yet."""
        deadline = time.monotonic() + PATIENCE_S
        while not self.run(f"(() => {{ try {{ return Boolean({condition}); }} catch {{ return false; }} }})()"):
            assert time.monotonic() < deadline, f"{condition} is not true; the page says {self._said}"
            self._page.wait_for_timeout(50)

    def picture(self) -> bytes:
        return self._page.screenshot()

    def paper(self) -> bytes:
        return self._page.pdf()

    def complaints(self) -> list[str]:
        """Errors that the page or its script have given."""
        self._page.wait_for_timeout(0)  # takes in what has been said meanwhile
        return list(self._said)


def colours(picture: bytes, directory: Path) -> int:
    from matplotlib.image import imread

    path = directory / "picture.png"
    path.write_bytes(picture)
    return len(np.unique((imread(path)[:, :, :3] * 31).astype(np.uint8).reshape(-1, 3), axis=0))


@contextmanager
def browsing(width: int = 1400) -> Iterator[Browser]:
    """A browser with one page, for as long as the context lasts."""
    from playwright.sync_api import sync_playwright  # not needed to know that there is no browser

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=_OPTIONS, chromium_sandbox=False, timeout=1000.0 * PATIENCE_S
        )
        with browser:
            page = browser.new_page(viewport={"width": width, "height": 1000})
            page.set_default_timeout(1000.0 * PATIENCE_S)
            yield Browser(page)


@contextmanager
def serving(server: ViewServer) -> Iterator[str]:
    """A server in a thread of its own; gives the address of its page."""
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
