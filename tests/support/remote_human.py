"""A human at the live page who moves a robot, without the page; and a link that is cut."""

from __future__ import annotations

import json
import select
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any

from eval_fakes import wait_for

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.websocket import ProxiedSocket, open_websocket


class RemoteHuman:
    """Answers each beat of the robot with `axes`, until the hold is over."""

    def __init__(self, opened: ProxiedSocket, session: str) -> None:
        self.axes = [0.0] * 6
        self.said: dict[str, Any] = {}
        self.over: str | None = None
        self.silent = False
        self._socket = opened
        self._seq = 0
        self._send({"session": session})
        threading.Thread(target=self._answer, daemon=True).start()

    def command(self) -> None:
        self._send({"seq": self._seq, "beat": self.said["beat"], "axes": self.axes, "grips": 0})
        self._seq += 1

    def release(self) -> None:
        self._send({"release": True})

    def move(self, *axes: float) -> None:
        """Ask for a motion, and wait until the robot makes it."""
        self.axes = [*axes, *[0.0] * (6 - len(axes))]
        wait_for(lambda: self.said.get("moves") or self.over, 30)
        assert self.over is None, self.over

    def ended(self) -> str:
        wait_for(lambda: self.over is not None, 30)
        return str(self.over)

    def _send(self, message: dict[str, Any]) -> None:
        self._socket.send(json.dumps(message).encode(), 10)

    def _answer(self) -> None:
        try:
            while True:
                said = json.loads(self._socket.recv(30))
                if "beat" not in said:
                    self.over = said.get("over", said.get("code"))
                    return
                self.said = said
                if not self.silent:
                    with suppress(Exception):  # it may be over by now, which the next message says
                        self.command()
        except Exception as error:  # noqa: BLE001 - the test is over, or asks why
            self.over = self.over or repr(error)


@contextmanager
def remote_human(port: int, session: str, key: str = "") -> Iterator[RemoteHuman]:
    """One who has taken over, or was told that he may not; his page goes at the end of the context."""
    address = f"ws://127.0.0.1:{port}/v1/live/control"
    with closing(open_websocket(address, Credentials(key), 10)) as opened:
        yield RemoteHuman(opened, session)


class CuttableLink:
    """A port of this machine that leads to another, until it is cut: then nothing passes, and nobody is told."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port = self._listening.getsockname()[1]
        self.cut = threading.Event()
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        for one in (self._listening, *self._open):
            one.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listening.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                return
            self._open += [near, far]
            threading.Thread(target=self._pass, args=(near, far), daemon=True).start()

    def _pass(self, near: socket.socket, far: socket.socket) -> None:
        ends = {near: far, far: near}
        try:
            while not self.cut.is_set():
                for one in select.select(list(ends), [], [], 0.01)[0]:
                    data = one.recv(2**16)
                    if not data:
                        ends[one].shutdown(socket.SHUT_WR)
                        return
                    ends[one].sendall(data)
        except (OSError, ValueError):  # closed
            pass
