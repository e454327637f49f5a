"""Connections to the endpoints, which carry bytes unchanged: they use no encoder, decoder or client
of this package.
"""

from __future__ import annotations

import base64
import contextlib
import fcntl
import json
import os
import queue
import re
import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol

import msgpack
from zenoh_session import open_zenoh

from tests.golden.masks import masked, masked_local, masked_rpyc, masked_websocket, masked_zmtp

ANSWER_S = 20.0
Got = tuple[str, bytes]
"""A word for the kind of the received message, and its masked bytes."""

_HANDSHAKE = (
    "GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)
_FRAME_KINDS = {0x81: "text", 0x82: "binary", 0x88: "close"}
_REQUEST_ID = re.compile(rb"x-request-id: .*\r\n")
_LENGTH = re.compile(rb"\r\ncontent-length: (\d+)\r\n", re.IGNORECASE)


class Line(Protocol):
    """One connection of a client. `more` is the data outside of a message, such as a memory
    file.
    """

    def send(self, data: bytes, more: list[bytes]) -> None: ...
    def receive(self) -> Got: ...
    def finish(self) -> Got: ...
    def close(self) -> None: ...


class TcpLine(ABC):
    """A stream of bytes that contains messages."""

    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=ANSWER_S)
        self._file = self._socket.makefile("rb")
        self._message = b""  # the bytes of the current message that have been read

    def send(self, data: bytes, more: list[bytes]) -> None:
        self._socket.sendall(data)

    def receive(self) -> Got:
        """Return the next message, or the received part of it if the connection ends."""
        self._message = b""
        try:
            return self._next()
        except (EOFError, ConnectionError):
            return "end", masked(self._message)

    def finish(self) -> Got:
        """Send no more, wait for the end of the connection, and return the bytes received until
        then.
        """
        with contextlib.suppress(OSError):  # the server may have closed the connection
            self._socket.shutdown(socket.SHUT_WR)
        return "end", masked(self._read_to_end())

    def close(self) -> None:
        self._file.close()
        self._socket.close()

    @abstractmethod
    def _next(self) -> Got: ...

    def _read(self, length: int) -> bytes:
        data = self._file.read(length)
        self._message += data
        if len(data) < length:
            raise EOFError
        return data

    def _read_to_end(self) -> bytes:
        rest = b""
        with contextlib.suppress(ConnectionError):
            while data := self._file.read1(2**16):
                rest += data
        return rest

    def _read_response(self) -> bytes:
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += self._read(1)
        length = _LENGTH.search(head)
        return head + self._read(int(length[1]) if length else 0)


class HttpLine(TcpLine):
    """HTTP requests."""

    def _next(self) -> Got:
        return "response", masked(self._read_response())


class OwnHttpLine(HttpLine):
    """The same requests at a replica's own port, below its unguessable path."""

    def __init__(self, port: int, path: str) -> None:
        super().__init__(port)
        self._path = path.encode()

    def send(self, data: bytes, more: list[bytes]) -> None:
        super().send(re.sub(rb"^(\w+) /v1(?=/)", rb"\1 " + self._path, data, count=1), more)

    def _next(self) -> Got:
        # At the server's port, the code in front of the application adds the id of the request.
        return "response", _REQUEST_ID.sub(b"", masked(self._read_response()))


class RpycLine(TcpLine):
    """Messages of RPyC: a length, a flag for compression, a body, and a final byte."""

    def _next(self) -> Got:
        head = self._read(5)
        return "message", masked_rpyc(head + self._read(int.from_bytes(head[:4], "big") + 1))


class WebSocketLine(TcpLine):
    """Frames of a WebSocket. `more` is the first byte of a message that is not one binary frame."""

    def __init__(self, port: int, path: str) -> None:
        super().__init__(port)
        self._socket.sendall(_HANDSHAKE.format(path=path, port=port).encode())
        self.opened: Got = ("handshake", masked(self._read_response()))

    def send(self, data: bytes, more: list[bytes]) -> None:
        first = more[0] if more else b"\x82"
        self._socket.sendall(
            first + bytes([0x80 | 127]) + struct.pack(">Q", len(data)) + bytes(4) + data
        )

    def _next(self) -> Got:
        first, size = self._read(2)
        if size >= 126:
            size = int.from_bytes(self._read(2 if size == 126 else 8), "big")
        return _FRAME_KINDS.get(first, f"{first:02x}"), masked(self._read(size))


class WholeWebSocketLine(TcpLine):
    """A WebSocket with its handshake and the heads of its frames. The client sends all bytes
    itself; `{path}` in them is replaced by the path at which the server expects the handshake.
    """

    def __init__(self, port: int, path: str) -> None:
        super().__init__(port)
        self._path = path.encode()
        self._is_open = False

    def send(self, data: bytes, more: list[bytes]) -> None:
        self._socket.sendall(data if self._is_open else data.replace(b"{path}", self._path))

    def _next(self) -> Got:
        if not self._is_open:
            response = self._read_response()
            self._is_open = response.startswith(b"HTTP/1.1 101 ")
            return "response", masked(response)
        head = self._read(2)
        size = head[1]
        if size >= 126:
            head += self._read(2 if size == 126 else 8)
            size = int.from_bytes(head[2:], "big")
        return "frame", masked_websocket(head + self._read(size))


class ZmtpLine(TcpLine):
    """A connection of ZeroMQ: its greeting, its commands, and its messages with all their
    frames.
    """

    _GREETING_BYTES = 64
    _MORE, _LONG = 1, 2  # flags of a frame

    def __init__(self, port: int) -> None:
        super().__init__(port)
        self._is_greeted = False

    def _next(self) -> Got:
        if not self._is_greeted:
            self._is_greeted = True
            return "greeting", self._read(self._GREETING_BYTES)
        message, has_more = b"", True
        while has_more:
            flags = self._read(1)
            size = self._read(8 if flags[0] & self._LONG else 1)
            body = self._read(int.from_bytes(size, "big"))
            message += flags + size + masked_zmtp(body)
            has_more = bool(flags[0] & self._MORE)
        return "message", message


class StrangerLine(TcpLine):
    """A connection that never sends a complete message of its protocol, and that the server
    ends.
    """

    def _next(self) -> Got:
        return "end", self._read_to_end()


class UnixLine:
    """Messages over a Unix socket whose requests are in memory: in memory files, or in memory that
    `store` keeps.
    """

    def __init__(self, address: str, store: Callable[[bytes, bytes], None] | None = None) -> None:
        self._store = store
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWER_S)
        self._socket.connect(address)

    def send(self, data: bytes, more: list[bytes]) -> None:
        """Send a message. `more` is the content of the memory that the message names, if any."""
        if not more:
            self._socket.send(data)
        elif self._store is not None:
            self._store(data, more[0])
            self._socket.send(data)
        else:
            descriptor = os.memfd_create("golden", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
            os.write(descriptor, more[0].ljust(4096, b"\0"))
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW)
            socket.send_fds(self._socket, [data], [descriptor])
            os.close(descriptor)

    def receive(self) -> Got:
        data, descriptors, _, _ = socket.recv_fds(self._socket, 2**18, 1)
        if not data:
            return "end", b""
        for descriptor in descriptors:
            with os.fdopen(descriptor, "rb") as file:
                file.seek(0)
                return "control, in a file", masked_local(data + file.read())
        return "control", masked_local(data)

    def finish(self) -> Got:
        """Send no more, wait for the end of the connection, and return the bytes received until
        then.
        """
        with contextlib.suppress(OSError):  # the server may have closed the connection
            self._socket.shutdown(socket.SHUT_WR)
        rest = b""
        while data := self._socket.recv(2**18):
            rest += data
        return "end", rest

    def close(self) -> None:
        self._socket.close()


class CallLine:
    """Calls of a function that returns the answer, one at a time."""

    def __init__(self, call: Callable[[bytes, list[bytes]], Got]) -> None:
        self._call = call
        self._thread = ThreadPoolExecutor(1)
        self._calls: list[Future[Got]] = []

    def send(self, data: bytes, more: list[bytes]) -> None:
        self._calls.append(self._thread.submit(self._call, data, more))

    def receive(self) -> Got:
        return self._calls.pop(0).result(ANSWER_S)

    def finish(self) -> Got:
        """Return nothing, since a call has only its answer."""
        return "end", b""

    def close(self) -> None:
        self._thread.shutdown()


class ZmqLine:
    """Messages of a REQ socket of ZeroMQ."""

    def __init__(self, port: int) -> None:
        import zmq

        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REQ)
        self._socket.setsockopt(zmq.RCVTIMEO, int(1e3 * ANSWER_S))
        self._socket.setsockopt(zmq.LINGER, 0)
        self._socket.connect(f"tcp://127.0.0.1:{port}")

    def send(self, data: bytes, more: list[bytes]) -> None:
        self._socket.send(data)

    def receive(self) -> Got:
        return "message", masked(self._socket.recv())

    def finish(self) -> Got:
        """Return nothing, since ZeroMQ's library shows only messages."""
        return "end", b""

    def close(self) -> None:
        self._socket.close()
        self._context.term()


class GrpcLine(CallLine):
    """Calls of gRPC methods. The data are a method's path; `more` is its message, or the messages
    of a stream.
    """

    def __init__(self, port: int) -> None:
        import grpc

        self._channel = grpc.insecure_channel(
            f"127.0.0.1:{port}", [("grpc.use_local_subchannel_pool", 1)]
        )
        self._failed = grpc.RpcError
        super().__init__(self._called)

    def _called(self, data: bytes, more: list[bytes]) -> Got:
        path = data.decode()
        try:
            if path.endswith("SendObservations"):
                return "message", masked(
                    self._channel.stream_unary(path)(iter(more), timeout=ANSWER_S)
                )
            return "message", masked(self._channel.unary_unary(path)(more[0], timeout=ANSWER_S))
        except self._failed as error:
            return error.code().name, masked(error.details().encode())

    def close(self) -> None:
        super().close()
        self._channel.close()


def remote_messages() -> dict[str, bytes]:
    """Return the messages that LeRobot's `RemoteClient` sent to the deployment of
    `dialect_situations`, by purpose.

    They were recorded at LeRobot's commits a8401e9b, and 91f903c8 for version 1. Ids of 32 digits 1
    or 2 stand for the ids of the instance and the session, which the server draws at random.
    """
    file = Path(__file__).with_name("lerobot_remote_client.json")
    sent: dict[str, str] = json.loads(file.read_text())
    return {name: base64.b64decode(message) for name, message in sent.items()}


class RemoteInferenceLine:
    """Messages of LeRobot's remote inference over Zenoh, as `remote_messages` returns them.

    The data are the end of a message's key, such as `control`, and `more` is the message. The
    earlier messages, with which a client connects and begins a session, are sent without being
    recorded.
    """

    INSTANCE, SESSION = b"1" * 32, b"2" * 32
    _QUERIES = ("describe", "open", "control")

    def __init__(self, port: int) -> None:
        import zenoh

        self._zenoh = zenoh
        self._session = open_zenoh(port)
        self._declared: list[Any] = []  # Zenoh undeclares objects without a reference
        self._answers: queue.Queue[bytes] = queue.Queue()
        self._lost = threading.Event()  # set when the server has left
        self._ids = {self.INSTANCE: b"", self.SESSION: b""}

    def send(self, data: bytes, more: list[bytes]) -> None:
        end = data.decode()
        if end != "describe":
            self._connect(begins=end != "open")
        if end in self._QUERIES:
            self._answers.put(self._query(end, more[0]))
            return
        key = self._key(end)
        publisher = self._session.declare_publisher(key)
        self._declared.append(publisher)
        self._await(lambda: publisher.matching_status.matching, key)
        publisher.put(self._addressed(more[0]))

    def receive(self) -> Got:
        return "message", masked(self._answers.get(timeout=ANSWER_S))

    def finish(self) -> Got:
        """Return when the server announces that it leaves and sends no more."""
        assert self._lost.wait(ANSWER_S)
        return "end", b""

    def close(self) -> None:
        self._session.close()

    def _key(self, end: str) -> str:
        instance, session = (actual.decode() for actual in self._ids.values())
        parts = ["lerobot/inference/v1/deployments/so101"]
        if end != "describe":
            parts += ["instances", instance]
        if end not in ("describe", "open", "alive"):
            parts += ["sessions", session]
        return "/".join([*parts, end])

    def _connect(self, *, begins: bool) -> None:
        """Query the deployment's description, and begin a session if `begins`, unless both have
        been done.
        """
        sent = remote_messages()
        if not self._ids[self.INSTANCE]:
            self._query("describe", sent["describe"])
        if begins and not self._ids[self.SESSION]:
            self._query("open", sent["open aligned"])
            self._query("control", sent["reset aligned"])

    def _addressed(self, message: bytes) -> bytes:
        """Return a message with the ids of the server."""
        for stand_in, actual in self._ids.items():
            message = message.replace(stand_in, actual or stand_in)
        return message

    def _query(self, end: str, message: bytes) -> bytes:
        key = self._key(end)
        with self._session.declare_querier(key) as querier:
            self._await(lambda: querier.matching_status.matching, key)
        replies: list[bytes] = []
        is_over = threading.Event()
        self._session.get(
            key,
            self._zenoh.handlers.Callback(
                lambda reply: replies.append(reply.ok.payload.to_bytes()),
                drop=is_over.set,
                indirect=False,
            ),
            payload=self._addressed(message),
            timeout=ANSWER_S,
        )
        assert is_over.wait(ANSWER_S)
        [answer] = replies
        self._learn(msgpack.unpackb(answer))
        return answer

    def _learn(self, answer: dict[str, Any]) -> None:
        """Store the ids of an answer, and declare the objects that a client needs for them."""
        if answer["message_type"] == "descriptor":
            self._ids[self.INSTANCE] = answer["instance_id"].encode()
            subscriber = self._session.liveliness().declare_subscriber(
                self._key("alive"), self._direct(self._see), history=True
            )
            self._declared.append(subscriber)
        elif answer["message_type"] == "accepted":
            self._ids[self.SESSION] = answer["session_id"].encode()
            for end in ("act", "language/result"):
                subscriber = self._session.declare_subscriber(
                    self._key(end),
                    self._direct(lambda sample: self._answers.put(sample.payload.to_bytes())),
                )
                self._declared.append(subscriber)

    def _see(self, sample: Any) -> None:
        if sample.kind == self._zenoh.SampleKind.DELETE:
            self._lost.set()

    def _direct(self, function: Callable[[Any], None]) -> Any:
        return self._zenoh.handlers.Callback(function, indirect=False)

    @staticmethod
    def _await(matches: Callable[[], bool], key: str) -> None:
        deadline = time.monotonic() + ANSWER_S
        while not matches():
            assert time.monotonic() < deadline, f"no server at {key}"
            time.sleep(0.005)
