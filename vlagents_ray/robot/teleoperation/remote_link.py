"""The robot's own connection to the server for a human at its live page."""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Mapping
from typing import Any, Protocol

from websockets.exceptions import ConnectionClosed

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.steering import ROBOT_PATH, SILENT_S
from vlagents_ray.client.transports.http import http_url
from vlagents_ray.client.transports.websocket import ProxiedSocket, open_websocket
from vlagents_ray.errors import ConfigError, ConnectionLost, VLAgentsError

logger = logging.getLogger(__name__)

_CONNECT_S = 5.0
_SEND_S = 1.0
_PAUSE_S = 1.0  # before it connects again


class Beating(Protocol):
    """What a link serves: `vlagents_ray.robot.teleoperation.remote.RemoteLeader`."""

    @property
    def beat_s(self) -> float:
        """The time between two beats, s."""
        ...

    def beat(self) -> dict[str, Any]:
        """Return the next message to the server."""
        ...

    def receive(self, message: Mapping[str, Any]) -> None:
        """Take a message of the server."""
        ...


class RemoteLink:
    """A WebSocket to the server, on a thread; it connects again when it is lost.

    The connection is apart from the policy's, so that no command waits for an inference.

    Args:
        url: The server, as for `RemoteAgent`.
        credentials: Those of the agent, whose sessions the robot may offer.
        served: Gives the beats, and takes what comes.

    Raises:
        ConfigError: The URL is not that of an HTTP server.
    """

    def __init__(self, url: str, credentials: Credentials, served: Beating) -> None:
        try:
            base = http_url(url)
        except ConfigError as error:
            raise ConfigError(
                f"remote: {url!r} has no live page; want the server's http(s)://HOST:PORT or ws(s)://…"
            ) from error
        scheme = "wss" if base.scheme == "https" else "ws"
        self._url = base._replace(scheme=scheme, path=base.path.rstrip("/") + ROBOT_PATH).geturl()
        self._credentials = credentials
        self._served = served
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_open(self) -> bool:
        """Whether it was opened, and not closed."""
        return self._thread is not None

    def open(self) -> None:
        """Connect.

        Raises:
            PolicyUnavailable: The server is not reached.
            VLAgentsError: It refuses the robot, such as for its API key.
        """
        socket = open_websocket(self._url, self._credentials, _CONNECT_S)
        self._over.clear()
        self._thread = threading.Thread(target=self._run, args=(socket,), name="vlagents-ray-remote", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the connection."""
        self._over.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join()

    def _run(self, first: ProxiedSocket) -> None:
        socket: ProxiedSocket | None = first
        lost = False
        while not self._over.is_set():
            try:
                with contextlib.closing(socket or open_websocket(self._url, self._credentials, _CONNECT_S)) as opened:
                    if lost:
                        logger.info("%s: connected again", self._url)
                    lost = False
                    self._serve(opened)
            except (VLAgentsError, ConnectionClosed, OSError, ValueError) as error:
                if not lost:
                    logger.warning("%s: nobody can take over remotely until it is reached again: %s", self._url, error)
                lost = True
            socket = None
            self._over.wait(_PAUSE_S)

    def _serve(self, socket: ProxiedSocket) -> None:
        """Send beats, and take what comes, until the end or the loss of the connection."""
        sent, heard = float("-inf"), time.monotonic()
        while not self._over.is_set():
            if time.monotonic() >= sent + self._served.beat_s:
                socket.send(json.dumps(self._served.beat()).encode(), _SEND_S)
                sent = time.monotonic()
            try:
                message = json.loads(socket.recv(max(0.0, sent + self._served.beat_s - time.monotonic())))
            except TimeoutError:
                if time.monotonic() - heard > SILENT_S:
                    raise ConnectionLost(f"no answer for {SILENT_S:g} s") from None
                continue
            heard = time.monotonic()
            if isinstance(message, dict):
                self._served.receive(message)
