"""A rosbridge server without ROS, written from the protocol's specification, version 2.

It is compared with the real server: with a recording of the real server's messages, and with tests
that run against both. Topics exist only in this process: a test publishes with `publish`, and reads
what clients published.
"""

from __future__ import annotations

import base64
import contextlib
import json
import math
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import Server, ServerConnection, serve


@dataclass
class Published:
    """A message that a client has published."""

    at: float  # time of arrival, s of `time.monotonic`
    topic: str
    message: dict[str, Any]


@dataclass
class RosbridgeDouble:
    port: int = 0
    published: list[Published] = field(default_factory=list)
    advertised: dict[str, str] = field(default_factory=dict)
    subscribed: dict[str, str] = field(default_factory=dict)
    # Subscribed topics in order, including repeated subscriptions.
    subscriptions: list[str] = field(default_factory=list)
    # Called with each message that a client publishes.
    noticed: Callable[[dict[str, Any]], None] = lambda _: None
    _asked: dict[ServerConnection, set[str]] = field(default_factory=lambda: defaultdict(set))
    _server: Server | None = None
    _thread: threading.Thread | None = None

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def on(self, topic: str) -> list[dict[str, Any]]:
        """Return the messages that clients have published on a topic."""
        return [one.message for one in list(self.published) if one.topic == topic]

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        """Send a message to the clients that have subscribed to its topic."""
        for socket, asked in list(self._asked.items()):
            if topic in asked:
                with contextlib.suppress(ConnectionClosed, OSError):
                    socket.send(
                        json.dumps(_plain({"op": "publish", "topic": topic, "msg": message}))
                    )

    def open(self) -> None:
        """Listen; if the server was open before, use the same port."""
        self._server = serve(
            self._handle, "127.0.0.1", self.port, compression=None, close_timeout=0.5
        )
        self.port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever)
        self._thread.start()

    def close(self) -> None:
        """End all connections, and stop listening."""
        server, thread, self._thread = self._server, self._thread, None
        if server is None or thread is None:
            return
        server.shutdown()
        for socket in list(self._asked):
            with contextlib.suppress(OSError):
                socket.socket.shutdown(2)
        thread.join()

    def _handle(self, socket: ServerConnection) -> None:
        asked = self._asked[socket]
        try:
            for frame in socket:
                self._do(json.loads(frame), asked, socket)
        except (ConnectionClosed, OSError):
            pass
        finally:
            self._asked.pop(socket, None)

    def _do(self, message: dict[str, Any], asked: set[str], socket: ServerConnection) -> None:
        match message["op"]:
            case "subscribe":
                self.subscribed[message["topic"]] = message["type"]
                self.subscriptions.append(message["topic"])
                asked.add(message["topic"])
            case "unsubscribe":
                asked.discard(message["topic"])
            case "advertise":
                self.advertised[message["topic"]] = message["type"]
            case "publish":
                self.published.append(Published(time.monotonic(), message["topic"], message["msg"]))
                self.noticed(message["msg"])
            case "unadvertise":
                self.advertised.pop(message["topic"], None)
            case other:
                status = {"op": "status", "level": "error", "msg": f"Unknown operation: {other}."}
                socket.send(json.dumps(status))


@contextlib.contextmanager
def rosbridge_double() -> Iterator[RosbridgeDouble]:
    double = RosbridgeDouble()
    double.open()
    try:
        yield double
    finally:
        double.close()


def _plain(value: Any) -> Any:
    """Return a message as JSON values: bytes in base64, numbers that are not finite as null."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, (bytes, bytearray)):
        return base64.b64encode(value).decode()
    if isinstance(value, (list, np.ndarray)):
        return [_plain(one) for one in (value.tolist() if isinstance(value, np.ndarray) else value)]
    return None if isinstance(value, float) and not math.isfinite(value) else value
