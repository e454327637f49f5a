"""A headless Chromium with which tests open pages, controlled through its DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
_WAIT_S = 60


class Page:
    """One tab. `said` has the messages of its console, `asked` the addresses that it requested."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self._number = 0
        self.said: list[str] = []
        self.asked: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a DevTools method, and return its result."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(_WAIT_S))
            self._note(message)
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]

    def open(self, path: Path | str, *, width: int, scheme: str, height: int = 900) -> None:
        """Open a file or a URL in a window of this size, with this preferred colour scheme."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        self.call(
            "Emulation.setEmulatedMedia",
            features=[{"name": "prefers-color-scheme", "value": scheme}],
        )
        self.call("Page.navigate", url=path if isinstance(path, str) else path.as_uri())
        while True:
            message = json.loads(self._socket.recv(_WAIT_S))
            self._note(message)
            if message.get("method") == "Page.loadEventFired":
                return

    def value(self, expression: str) -> Any:
        """Return the value of a JavaScript expression, which may be a promise; None if it is
        undefined.
        """
        found = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def picture(self, clip: dict[str, float] | None = None) -> bytes:
        """Return a PNG of the window, or of the part `clip` of the page: x, y, width, height and
        scale.
        """
        part = {} if clip is None else {"clip": clip, "captureBeyondViewport": True}
        return base64.b64decode(self.call("Page.captureScreenshot", format="png", **part)["data"])

    def pdf(self) -> bytes:
        """Return the page as a PDF, as it is printed on A4."""
        return base64.b64decode(
            self.call("Page.printToPDF", preferCSSPageSize=True, printBackground=True)["data"]
        )

    def _note(self, message: dict[str, Any]) -> None:
        method, params = message.get("method"), message.get("params", {})
        if method in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
            self.said.append(json.dumps(params))
        elif method == "Network.requestWillBeSent":
            self.asked.append(params["request"]["url"])


@contextmanager
def browser(profile: Path) -> Iterator[Page]:
    """Start Chromium with a new profile, and yield an empty page."""
    assert CHROMIUM is not None
    switches = [
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--remote-debugging-port=0",
        f"--user-data-dir={profile}",
    ]
    process = subprocess.Popen(
        [CHROMIUM, *switches, "about:blank"],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"HOME": str(profile)},
    )
    assert process.stderr is not None
    try:
        line = next(line for line in process.stderr if "DevTools listening on" in line)
        address = line.rpartition(" ")[2].strip()
        # A browser that draws a large page does not answer pings.
        with connect(address, max_size=None, proxy=None, ping_interval=None) as socket:
            targets = _ask(socket, "Target.getTargets")["targetInfos"]
            page = next(one["targetId"] for one in targets if one["type"] == "page")
        target = f"{address.partition('/devtools')[0]}/devtools/page/{page}"
        with connect(target, max_size=None, proxy=None, ping_interval=None) as socket:
            yield Page(socket)
    finally:
        process.terminate()
        process.communicate(timeout=_WAIT_S)


def _ask(socket: ClientConnection, method: str) -> dict[str, Any]:
    socket.send(json.dumps({"id": 1, "method": method}))
    return json.loads(socket.recv(_WAIT_S))["result"]
