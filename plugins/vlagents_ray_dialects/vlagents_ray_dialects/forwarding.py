"""Forwards a client's connection to a Unix socket of this process, which only this user can reach.

A library that accepts connections itself, such as gRPC's or Zenoh's, has no limits for clients that
have no key. The connection is therefore accepted and read here.
"""

from __future__ import annotations

import abc
import contextlib
import logging
import socket
import struct
import threading
import time

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.endpoints.connection import ANSWERS_S, wait_delivered
from vlagents_ray_dialects.client_reader import set_keep_alive, shut_down

logger = logging.getLogger(__name__)

# The path of a socket has at most 107 bytes. Only the user of this process can read a folder that
# `tempfile` creates here.
SHORT_FOLDER = "/tmp"  # noqa: S108
_SEND_S = 10.0  # maximum time for a client to accept a piece of an answer
_READ_BYTES = 64 * 1024


class ForwardedConnection(abc.ABC):
    """One connection of a client, and its connection to the server on a Unix socket. Two threads
    forward the bytes.

    Args:
        name: The name of the dialect.
        client: The connection of the client.
    """

    def __init__(self, name: str, client: socket.socket) -> None:
        self.name = name
        self._client = client
        self._server = socket.socket(socket.AF_UNIX)
        # The kernel chooses a unique name for the connection, by which gRPC's server identifies the
        # peer.
        self._server.bind("")
        self._ended = threading.Event()
        self.thread = threading.Thread(target=self._run, name=f"{name}-requests", daemon=True)
        self._answers = threading.Thread(
            target=self._forward_answers, name=f"{name}-answers", daemon=True
        )

    @property
    def is_open(self) -> bool:
        """Whether the connection is still open."""
        return not self._ended.is_set()

    def end(self) -> None:
        """End both connections immediately; may be called on any thread."""
        self._ended.set()
        shut_down(self._client)
        shut_down(self._server)

    def wait_answered(self, deadline: float) -> None:
        """Wait until the client has received the last answers of a server that has stopped.

        Args:
            deadline: The time until which this method waits, s, of `time.monotonic()`.
        """
        if self._answers.is_alive():
            self._answers.join(max(0.0, deadline - time.monotonic()))

    @abc.abstractmethod
    def greet(self) -> tuple[str, bytes]:
        """Read the first bytes of the client; return the path of the server's socket, and the bytes
        that it has to receive first.
        """

    @abc.abstractmethod
    def admit(self, data: bytes) -> bool:
        """Return True when these bytes of the client may be forwarded, and False if the connection
        has ended; raise an error to end it.
        """

    @abc.abstractmethod
    def closed(self) -> None:
        """Forget the connection, which has ended; called on its thread."""

    def read(self, size: int, deadline: float) -> bytes:
        """Read at most `size` bytes of the client before it is forwarded, until a time of
        `time.monotonic()`.
        """
        self._client.settimeout(max(0.001, deadline - time.monotonic()))
        return self._client.recv(size)

    def _run(self) -> None:
        """Forward the connection until it ends; runs on its own thread."""
        try:
            path, first = self.greet()
            self._client.settimeout(None)
            self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            send_limit = struct.pack("ll", int(_SEND_S), 0)
            self._client.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, send_limit)
            set_keep_alive(self._client)

            self._server.connect(path)
            self._server.sendall(first)
            self._answers.start()
            self._forward_requests()
        except (VLAgentsError, OSError) as error:
            logger.info("%s: disconnected a client: %s", self.name, error)
        except Exception:
            logger.exception("%s: disconnected a client", self.name)
        finally:
            self.end()
            if self._answers.ident is not None:
                self._answers.join()
            self.closed()
            self._client.close()
            self._server.close()

    def _forward_requests(self) -> None:
        """Forward the client's bytes to the server."""
        while True:
            data = self._client.recv(_READ_BYTES)
            if not data or not self.admit(data):
                return
            # After the end of the server, its last answers are still forwarded.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                self._server.sendall(data)

    def _forward_answers(self) -> None:
        """Forward the bytes of the server to the client; runs on its own thread."""
        try:
            data = self._server.recv(_READ_BYTES)
            while data:
                self._client.sendall(data)
                data = self._server.recv(_READ_BYTES)
        except OSError as error:
            # A server that ends with unread requests resets the connection after its answers.
            logger.info("%s: disconnected a client: %s", self.name, error)
        finally:
            wait_delivered(self._client, time.monotonic() + ANSWERS_S)
            self.end()
