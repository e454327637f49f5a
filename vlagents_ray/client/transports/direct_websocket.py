"""A WebSocket to a replica's own port, which the thread that waits for the answer reads and writes itself."""

from __future__ import annotations

import contextlib
import secrets
import socket
import struct
import time
from collections.abc import Mapping, Sequence
from urllib.parse import SplitResult

import numpy as np
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from vlagents_ray.client.credentials import WEBSOCKET_LOG
from vlagents_ray.protocol.arrays import Buffer
from vlagents_ray.protocol.messages import DEFAULT_LIMITS

_READ_BYTES = 256 * 1024
_KEPT_BYTES = 1024 * 1024  # holds a message with two or three raw images
_HEAD_BYTES = 16  # most bytes before the message in its frame, and two


class _FrameMemory:
    """Memory for the frames that one connection sends.

    It is used again and again: fresh memory, which the kernel clears page by page, costs more than all other work on a
    frame with images.
    """

    def __init__(self) -> None:
        self._kept = bytearray(_KEPT_BYTES)

    def frame(self, pieces: Sequence[Buffer]) -> memoryview:
        """Return the frame of a binary message (RFC 6455, section 5.2), which is valid until the next call.

        Args:
            pieces: The message's bytes, one piece after the other.
        """
        size = sum(map(len, pieces))
        memory = self._kept if size <= _KEPT_BYTES - 2 * _HEAD_BYTES else bytearray(size + 2 * _HEAD_BYTES)
        view, at = memoryview(memory), _HEAD_BYTES
        for piece in pieces:
            view[at : at + len(piece)] = piece
            at += len(piece)
        mask = secrets.token_bytes(4)
        masked = np.frombuffer(memory, np.uint32, -(-size // 4), _HEAD_BYTES)
        masked ^= np.frombuffer(mask, np.uint32)
        if size < 126:
            length = bytes([0x80 | size])
        elif size < 2**16:
            length = b"\xfe" + size.to_bytes(2, "big")
        else:
            length = b"\xff" + size.to_bytes(8, "big")
        head = b"\x82" + length + mask
        view[_HEAD_BYTES - len(head) : _HEAD_BYTES] = head
        return view[_HEAD_BYTES - len(head) : at]


class Stream:
    """An open connection. No thread answers pings: the server must rely on the kernel's keep-alive instead."""

    def __init__(
        self, base: SplitResult, port: int, path: str, timeout_s: float, headers: Mapping[str, str] | None = None
    ) -> None:
        """Connect to `port` on the host of `base`; raises `OSError` or `InvalidHandshake` if no such server answers."""
        host = base.hostname or ""
        deadline = time.monotonic() + timeout_s
        self._protocol = ClientProtocol(
            parse_uri(f"ws://{f'[{host}]' if ':' in host else host}:{port}{path}"),
            max_size=DEFAULT_LIMITS.body_bytes,
            logger=WEBSOCKET_LOG,
        )
        self._messages: list[bytes] = []
        self._frames = _FrameMemory()
        self._read_memory = memoryview(bytearray(_READ_BYTES))
        self._silent = False  # whether the server did not answer, or not take, the last message in time
        self._socket = socket.create_connection((host, port), timeout_s)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            request = self._protocol.connect()
            request.headers.update(headers or {})
            self._protocol.send_request(request)
            self._flush(deadline)
            while self._protocol.state is State.CONNECTING:
                self._read(deadline)
                if self._protocol.handshake_exc is not None:
                    raise self._protocol.handshake_exc
        except BaseException:
            self._socket.close()
            raise

    def send(self, message: bytes, timeout_s: float) -> None:
        """Send a binary message; raises what `send_pieces` raises."""
        self.send_pieces([message], timeout_s)

    def send_pieces(self, pieces: Sequence[Buffer], timeout_s: float) -> None:
        """Send a binary message, given one piece after the other.

        Raises what `recv` raises, and `OSError` if the server does not take all of it in time.
        """
        self._check_open()
        try:
            self._socket.settimeout(_left(time.monotonic() + timeout_s))
            self._socket.sendall(self._frames.frame(pieces))
        except TimeoutError as error:
            self._silent = True
            raise ConnectionAbortedError(f"the server took no message within {timeout_s:g} s") from error

    def recv(self, timeout_s: float) -> bytes:
        """Return the next binary message.

        Raises:
            ConnectionClosed: The connection is closed; `OSError` if it broke.
            TimeoutError: No message came within `timeout_s`.
        """
        deadline = time.monotonic() + timeout_s
        try:
            while not self._messages:
                self._check_open()
                self._read(deadline)
        except TimeoutError:
            self._silent = True
            raise
        self._silent = False
        return self._messages.pop(0)

    def close(self) -> None:
        """Close the connection, so that the server notices.

        A message that was not answered in time is of no use any more. Over a lost link the kernel would keep sending it
        for minutes, and the server would act on it and hold the sessions until then; a reset of the connection ends
        both.
        """
        with contextlib.suppress(OSError):
            if self._silent:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            elif self._protocol.state is State.OPEN:
                self._protocol.send_close()
                self._flush(time.monotonic() + 1.0)
        self._socket.close()

    def _check_open(self) -> None:
        """Raise `ConnectionClosed` or `OSError` unless the connection is open.

        Also if the server has sent its close frame.
        """
        if self._protocol.state is State.CLOSED:
            raise self._protocol.close_exc
        if self._protocol.state is not State.OPEN:
            raise ConnectionResetError(f"the server closes the connection ({self._protocol.close_rcvd})")

    def _read(self, deadline: float) -> None:
        self._socket.settimeout(_left(deadline))
        count = self._socket.recv_into(self._read_memory)
        if count:
            self._protocol.receive_data(bytes(self._read_memory[:count]))
        else:
            self._protocol.receive_eof()
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode is Opcode.BINARY:
                self._messages.append(bytes(event.data))
        self._flush(deadline)

    def _flush(self, deadline: float) -> None:
        for piece in self._protocol.data_to_send():
            if piece:
                self._socket.settimeout(_left(deadline))
                self._socket.sendall(piece)


def _left(deadline: float) -> float:
    left_s = deadline - time.monotonic()
    if left_s <= 0:
        raise TimeoutError
    return left_s
