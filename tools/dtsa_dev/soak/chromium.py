"""A headless Chromium that is steered by its own remote protocol (DevTools), with aiohttp and nothing else."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import signal
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import aiohttp

from dtsa_bench.runs.processes import end_process

from .checks import met

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
PATIENCE_S = 90.0
_OPTIONS = (
    "--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking", "--disable-component-update",
    "--disable-sync", "--disable-quic", "--hide-scrollbars", "--remote-debugging-port=0", "--disable-dev-shm-usage",
    "--enable-unsafe-swiftshader", "--disable-gpu", "--disable-extensions",
)  # fmt: skip


class Browser:
    """One page of a browser. A context manager.

    :param directory: for its profile.
    :param width: pixels.
    :param height: pixels.
    :param dark: whether it prefers dark pages.
    :raises NotMet: where it does not start, or what it is asked for fails.
    """

    def __init__(self, directory: Path, width: int = 1400, height: int = 1000, dark: bool = False) -> None:
        self._profile = directory / "profile"
        options = [*_OPTIONS, f"--window-size={width},{height}", f"--user-data-dir={self._profile}"]
        self._command = [str(CHROMIUM), *options, *(["--force-dark-mode"] if dark else []), "about:blank"]
        self._size, self._dark = (width, height), dark
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._number = 0
        self._waiting: dict[int, asyncio.Future[Any]] = {}
        self._said: list[str] = []

    def __enter__(self) -> Browser:
        self._process = subprocess.Popen(self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._thread.start()
        try:
            self._wait(self._connect())
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(Exception):  # whatever stands: the process is ended below
            self._wait(self._session.close())
        end_process(self._process, 10, signal.SIGTERM)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10)
        if not self._thread.is_alive():
            self._loop.close()

    def _wait(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(PATIENCE_S)

    async def _connect(self) -> None:
        told = self._profile / "DevToolsActivePort"
        deadline = time.monotonic() + PATIENCE_S
        while not told.is_file() or "\n" not in told.read_text():
            met(time.monotonic() < deadline, "the browser does not start")
            met(self._process.poll() is None, "the browser has ended")
            await asyncio.sleep(0.05)
        port = told.read_text().splitlines()[0]
        self._session = aiohttp.ClientSession()
        async with self._session.get(f"http://127.0.0.1:{port}/json/list") as answer:
            pages = [page for page in await answer.json(content_type=None) if page["type"] == "page"]
        self._socket = await self._session.ws_connect(pages[0]["webSocketDebuggerUrl"], max_msg_size=0)
        self._reading = asyncio.create_task(self._read())
        for domain in ("Runtime", "Log", "Page"):
            await self._call(f"{domain}.enable")
        width, height = self._size
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        await self._call("Emulation.setDeviceMetricsOverride", **metrics)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if self._dark else "light"}
        await self._call("Emulation.setEmulatedMedia", features=[scheme])

    async def _read(self) -> None:
        async for message in self._socket:
            content = json.loads(message.data)
            if content.get("id") in self._waiting:
                self._waiting.pop(content["id"]).set_result(content)
            elif content.get("method") == "Runtime.exceptionThrown":
                self._said.append(str(content["params"]["exceptionDetails"]))
            elif content.get("method") == "Runtime.consoleAPICalled" and content["params"]["type"] in (
                "error",
                "assert",
            ):
                self._said.append(str(content["params"]["args"]))
            elif content.get("method") == "Log.entryAdded" and content["params"]["entry"]["level"] == "error":
                self._said.append(str(content["params"]["entry"]))

    async def _call(self, method: str, **parameters: Any) -> Any:
        self._number += 1
        self._waiting[self._number] = answer = self._loop.create_future()
        await self._socket.send_str(json.dumps({"id": self._number, "method": method, "params": parameters}))
        content = await asyncio.wait_for(answer, PATIENCE_S)
        met("error" not in content, str(content))
        return content["result"]

    def open(self, url: str) -> None:
        """Goes to a page."""
        self._wait(self._call("Page.navigate", url=url))

    def run(self, script: str) -> Any:
        """What an expression of JavaScript gives, as JSON types."""
        found = self._wait(self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True))
        met("exceptionDetails" not in found, str(found))
        return found["result"].get("value")

    def wait_for(self, condition: str) -> None:
        """Waits until an expression is true; one that fails is not true yet."""
        deadline = time.monotonic() + PATIENCE_S
        while not self.run(f"(() => {{ try {{ return Boolean({condition}); }} catch {{ return false; }} }})()"):
            met(time.monotonic() < deadline, f"{condition} is not true; the page says {self._said}")
            time.sleep(0.05)

    def picture(self, path: Path | None = None) -> bytes:
        """A picture of the window as PNG.

        :param path: where it is written, too.
        """
        data = base64.b64decode(self._wait(self._call("Page.captureScreenshot", format="png"))["data"])
        if path is not None:
            path.write_bytes(data)
        return data

    def heap(self) -> int:
        """Bytes that the page's script uses, arrays among them, after a collection of garbage."""
        self._wait(self._call("HeapProfiler.collectGarbage"))
        used = self._wait(self._call("Runtime.getHeapUsage"))
        return int(used["usedSize"] + used.get("backingStorageSize", 0))

    def complaints(self) -> list[str]:
        """Errors that the page or its script have given."""
        return list(self._said)
