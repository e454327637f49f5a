"""A client of the servers of the package `vlagents`, 0.3, over RPyC."""

from __future__ import annotations

import socket
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar
from urllib.parse import urlsplit

from vlagents_ray.errors import ConnectionLost, PolicyUnavailable, VLAgentsError
from vlagents_ray_dialects.messages import rpyc
from vlagents_ray_dialects.messages import vlagents as wire
from vlagents_ray_dialects.upstream.client import Answer, ClientOptions, UpstreamClient

_PAUSE_S = 0.2  # s, between two checks whether the upstream's model is loaded


class VlagentsClient(UpstreamClient):
    """A client of one agent, shared by all connections; each observation contains the
    instruction.
    """

    schemes: ClassVar[tuple[str, ...]] = ("rpyc",)
    takes_key: ClassVar[bool] = False

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._socket: socket.socket | None = None
        self._sequence = 0
        self._root: tuple[Any, ...] = ()

    @property
    def is_open(self) -> bool:
        return self._socket is not None

    def connect(self, timeout_s: float) -> dict[str, Any]:
        url, deadline = urlsplit(self.options.url), time.monotonic() + timeout_s
        try:
            self._socket = socket.create_connection(
                (url.hostname or "", url.port or 8080), timeout_s
            )
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            root = self._call(wire.get_root(self._next()), deadline)
            if not isinstance(root, tuple):
                raise self.unreadable(type(root).__name__, "a reference to the root")
            self._root = root
            while self._method("is_initialized", deadline) is not True:
                if time.monotonic() + _PAUSE_S > deadline:
                    raise PolicyUnavailable(f"upstream {self.options.url}: its model is loading")
                time.sleep(_PAUSE_S)
            return {"name": self._method("name", deadline)}
        except (OSError, VLAgentsError) as error:
            self.close()
            if isinstance(error, PolicyUnavailable) and not isinstance(error, ConnectionLost):
                raise
            raise self.unreachable(error) from error

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        deadline = time.monotonic() + self.options.timeout_s
        text = self._method("act", deadline, wire.write_observation(observation))
        if not isinstance(text, str):
            raise self.unreadable(type(text).__name__, "a text")
        return [wire.read_actions(text, self.options.limits)]

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _next(self) -> int:
        self._sequence += 1
        return self._sequence

    def _method(self, name: str, deadline: float, *args: str) -> Any:
        value = self._call(wire.call(self._next(), self._root, name, *args), deadline)
        if isinstance(value, wire.RemoteError):
            raise self.failed(value.text)
        return value

    def _call(self, frame: bytes, deadline: float) -> Any:
        connection = self._socket
        if connection is None:
            raise self.closed()
        try:
            connection.settimeout(_left(deadline))
            connection.sendall(frame)
            while True:
                length, compressed = rpyc.read_header(
                    self._receive(connection, rpyc.HEADER.size, deadline),
                    self.options.limits.body_bytes,
                )
                body = self._receive(connection, length, deadline)
                result = wire.read_result(body, compressed, self.options.limits.body_bytes)
                if result is None:
                    continue
                sequence, value = result
                if sequence == self._sequence:
                    return value
        except OSError as error:
            raise self.lost(error) from error
        except VLAgentsError:
            self.close()  # the position in the stream is lost
            raise

    def _receive(self, connection: socket.socket, count: int, deadline: float) -> bytearray:
        data = bytearray(count)
        view, at = memoryview(data), 0
        while at < count:
            connection.settimeout(_left(deadline))
            received = connection.recv_into(view[at:])
            if not received:
                raise ConnectionResetError("the connection ended")
            at += received
        return data


def _left(deadline: float) -> float:
    left_s = deadline - time.monotonic()
    if left_s <= 0:
        raise TimeoutError
    return left_s
