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

_PAUSE_S = 0.2  # the pause between two checks whether the upstream has loaded its model, s


class VlagentsClient(UpstreamClient):
    """A client of a server whose agent is shared by all connections; each observation contains the
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
        """Connect, wait until the upstream's model is loaded, and return its name."""
        url = urlsplit(self.options.url)
        address = url.hostname or "", url.port or 8080
        deadline = time.monotonic() + timeout_s
        try:
            self._socket = socket.create_connection(address, timeout_s)
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
        """Return the sequence number of the next request."""
        self._sequence += 1
        return self._sequence

    def _method(self, name: str, deadline: float, *args: str) -> Any:
        """Call a method of the upstream's root, and return its result."""
        value = self._call(wire.call(self._next(), self._root, name, *args), deadline)
        if isinstance(value, wire.RemoteError):
            raise self.failed(value.text)
        return value

    def _call(self, frame: bytes, deadline: float) -> Any:
        """Send a request, and return the value of its reply; other replies are skipped."""
        connection = self._socket
        if connection is None:
            raise self.closed()
        limit = self.options.limits.body_bytes
        try:
            connection.settimeout(_remaining_s(deadline))
            connection.sendall(frame)
            while True:
                header = self._receive(connection, rpyc.HEADER.size, deadline)
                length, compressed = rpyc.read_header(header, limit)
                body = self._receive(connection, length, deadline)
                result = wire.read_result(body, compressed, limit)
                if result is None:
                    continue
                sequence, value = result
                if sequence == self._sequence:
                    return value
        except OSError as error:
            raise self.lost(error) from error
        except VLAgentsError:
            # The read stopped within a reply, so the connection cannot be used further.
            self.close()
            raise

    def _receive(self, connection: socket.socket, count: int, deadline: float) -> bytearray:
        """Return the next bytes of a connection."""
        data = bytearray(count)
        view = memoryview(data)
        received = 0
        while received < count:
            connection.settimeout(_remaining_s(deadline))
            length = connection.recv_into(view[received:])
            if not length:
                raise ConnectionResetError("the connection ended")
            received += length
        return data


def _remaining_s(deadline: float) -> float:
    """Return the time until a deadline, s; raise `TimeoutError` if it is over."""
    remaining_s = deadline - time.monotonic()
    if remaining_s <= 0:
        raise TimeoutError
    return remaining_s
