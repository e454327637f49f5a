"""An open WebSocket that a polling thread reads: its frames, its limits and its end.

All WebSockets of a replica are `WebSocketConnection`s, whichever port their clients used: the
replica's own port (`vlagents_ray.serve.endpoints.own_port`), or the server's port, where uvicorn
accepts the handshake and hands over its socket (`vlagents_ray.serve.endpoints.asgi_websocket`). A
`MessageHandler` serves the messages.
"""

from __future__ import annotations

import logging
import socket
import time
from abc import ABC, abstractmethod
from collections import deque
from typing import Any

from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.server import ServerProtocol

from vlagents_ray.errors import MalformedMessage, TooManyRequests, VLAgentsError
from vlagents_ray.protocol.messages import STREAM_BYTES
from vlagents_ray.protocol.websocket_frames import (
    HEAD_BYTES,
    ReceiveBuffer,
    frame_head,
    frame_size,
)
from vlagents_ray.serve.access.api_keys import Caller
from vlagents_ray.serve.access.charges import REFUSED, Charge
from vlagents_ray.serve.endpoints.connection import (
    DECODING,
    POLICY_VIOLATION,
    THROTTLED,
    ConnectionOwner,
    has_unread,
)
from vlagents_ray.serve.endpoints.message_connection import (
    GOING_AWAY,
    READ_BYTES,
    MessageConnection,
)
from vlagents_ray.serve.engine.admission import Admission

logger = logging.getLogger(__name__)

_FINISHING = "it ends after its answers"  # a further reason for not polling a connection
_FINISHING_S = 0.01  # period of the checks whether all messages are answered, s
_FRAGMENT_BYTES = 16 * 1024  # size below which a fragment of a message counts like a control frame
# Only pings detect that a client behind a proxy has disappeared, since the kernel's own probes
# reach only the proxy.
_PING_S = 20.0
_INVALID_DATA, _ABNORMAL = 1007, 1006  # close codes


class MessageHandler(ABC):
    """Serves the messages of one WebSocket; the polling thread calls its methods."""

    most_unanswered: int  # number of unanswered messages at which reading stops
    most_unanswered_bytes: int  # size of the unanswered messages above which reading stops, bytes

    @abstractmethod
    def begin(self) -> Charge | None:
        """Charge a message of which a part has arrived, before the remaining part is read. Returns:
        The charge for `receive`; None if the message is charged when the application receives
        it.
        """

    @abstractmethod
    def receive(self, message: bytes | str, arrived: float, charge: Charge | None) -> None:
        """Serve a complete message; a text message is a `str`.

        Args:
            arrived: Time at which its last byte arrived, s, of `time.perf_counter`.
            charge: The result of `begin`, if the message arrived in parts.
        """

    @abstractmethod
    def ended(self, code: int) -> None:
        """End the sessions of a connection that has ended with this close code."""

    @abstractmethod
    def finish(self, reason: str, code: int) -> None:
        """End the connection once all messages that have arrived are answered; no further messages
        will be received.
        """


class WebSocketConnection(MessageConnection):
    """One WebSocket, from its handshake to its end."""

    def __init__(
        self,
        owner: ConnectionOwner[Any],
        connection: socket.socket,
        admission: Admission | None,
        *,
        slow_s: float,
        idle_s: float,
        pings: bool = False,
    ) -> None:
        """Create a connection, which is read after `owner.serve`.

        Args:
            admission: The in-flight memory of the replica, which includes incomplete messages; None
                without a replica.
            slow_s: Maximum time that a message may take to arrive, s.
            idle_s: Maximum time that the connection may be silent, s.
            pings: Whether the client has to answer pings.
        """
        super().__init__(owner, connection, admission, slow_s=slow_s, idle_s=idle_s)
        self._pings = pings
        self._protocol = ServerProtocol(max_size=STREAM_BYTES)  # guarded by the lock
        # Handler of the messages; None before the handshake is accepted.
        self._handler: MessageHandler | None = None

        self._frame_head = b""  # received part of a frame's head, until the head is complete
        self._frame_left = 0  # unread bytes of the current frame, once its head is complete
        self._received = ReceiveBuffer(STREAM_BYTES)
        self._fragments: list[bytes] = []  # frames of a message whose last frame has not arrived
        self._fragments_bytes = 0
        self._is_text = False  # whether these frames belong to a text message
        # Received but unprocessed messages, their arrival times, s, and the charges of messages
        # that arrived in parts.
        self._messages: deque[tuple[bytes | str, float, Charge | None]] = deque()
        self._partial: Charge | None = None  # charge of a partly received message
        self._is_partial = False  # whether a part of a message has been counted

        self._has_ended_sessions = False
        self._is_finishing = False  # whether the connection ends once all messages are answered
        # Time of the last ping since the last bytes, s; 0 if there was none. Only `overdue` uses
        # it.
        self._pinged_at = 0.0

    def accepted(self, handler: MessageHandler) -> None:
        """Serve messages with `handler`, now that the handshake is accepted."""
        self._received.attach(self._protocol)
        self._is_rated = isinstance(self.caller, Caller)
        self._handler = handler

    # Handlers call the following methods.

    def send(self, message: bytes | str) -> None:
        """Send a message; may be called on any thread, and does nothing after the end."""
        with self._sending:
            if self._ended or self._protocol.state is not State.OPEN:
                return
            if isinstance(message, str):
                self._protocol.send_text(message.encode())
                self._flush()
            else:
                self._out.send(frame_head(len(message)) + message)

    def finish(self, reason: str, code: int) -> None:
        """Read no further messages, and end the connection once the messages that have arrived are
        answered; may be called on any thread.
        """
        if not self._is_finishing:
            self._is_finishing = True
            self._call_soon(lambda: self._finish(reason, code))

    def _finish(self, reason: str, code: int) -> None:
        if self._polled and not self._ended and has_unread(self._connection):
            self._read()
        if self._ended:
            return
        self._pause(_FINISHING)
        if self._messages or self._unpolled_for & {DECODING, THROTTLED}:
            self._call_later(_FINISHING_S, lambda: self._finish(reason, code))
        elif self._handler is not None:
            self._handler.finish(reason, code)

    def end_when_answered(self, reason: str, code: int) -> None:
        """End the connection once no message is unanswered; called on the polling thread."""
        if self._unanswered:
            self._call_later(_FINISHING_S, lambda: self.end_when_answered(reason, code))
        else:
            self.end(reason, code)

    # Reading.

    def _receive_bytes(self, data: bytes | memoryview) -> bool:
        if self._frame_left:
            self._frame_left -= len(data)
        self._receive(data)
        return not self._frame_left and self._polled and not self._ended

    @property
    def _is_over(self) -> bool:
        return self._protocol.state in (State.CLOSING, State.CLOSED)

    @property
    def _incomplete_bytes(self) -> int:
        return self._received.size + self._fragments_bytes + len(self._frame_head)

    def _bytes_to_read(self) -> int:
        """Return how many bytes to read now: at most one frame.

        The bytes after the frame stay in the socket until it is known whether the client may send
        more. If the connection has ended, the number is 1, which reads its end. Raises
        `BlockingIOError` if the socket is empty.
        """
        if not self._frame_left:
            peeked = self._connection.recv(HEAD_BYTES - len(self._frame_head), socket.MSG_PEEK)
            head = self._frame_head + peeked
            size = frame_size(head)
            if size is None:
                self._frame_head = head
                return len(peeked) or 1
            self._frame_left = size - len(self._frame_head)
            self._frame_head = b""
        return min(self._frame_left, READ_BYTES)

    def _receive(self, data: bytes | memoryview) -> None:
        """Process bytes of one frame; empty `data` means that the connection has ended."""
        was_open = self._protocol.state is State.OPEN
        with self._sending:
            if data:
                self._received.parse(data)
            else:
                self._protocol.receive_eof()
            events = self._protocol.events_received()
            self._flush()

        for event in events:
            if isinstance(event, Frame) and not self._receive_frame(event):
                return

        if was_open and self._protocol.state is State.CLOSING and self._protocol.close_rcvd is None:
            self._ended_at = time.monotonic()
            self.account.charge_abuse()  # the frame is invalid; bytes after it are discarded
        self._process_messages()
        if (self._received.size or self._fragments) and not self._ended:
            self._count_partial()

        is_closed = self._protocol.state is State.CLOSED or self._protocol.close_rcvd is not None
        if not data or is_closed:
            self.disconnect()
            return

        self._pause_if_backlogged()

    def _receive_frame(self, frame: Frame) -> bool:
        """Queue the message that a frame completes; return False if the connection ends."""
        is_data = frame.opcode in (Opcode.BINARY, Opcode.TEXT, Opcode.CONT)
        is_fragment = frame.opcode is Opcode.CONT or not frame.fin
        is_limited = not is_data or (is_fragment and len(frame.data) < _FRAGMENT_BYTES)
        if is_limited:
            try:
                self.account.charge_control_frame()
            except MalformedMessage as error:
                self.end(str(error))
                return False
        if not is_data:
            return True

        if frame.opcode is not Opcode.CONT:
            self._is_text = frame.opcode is Opcode.TEXT
        data = bytes(frame.data)
        if is_fragment:
            self._fragments.append(data)
            self._fragments_bytes += len(data)
            if not frame.fin:
                return True
            data = b"".join(self._fragments)
            self._fragments = []
            self._fragments_bytes = 0

        message: bytes | str = data
        if self._is_text:
            try:
                message = data.decode()
            except UnicodeDecodeError:
                self.account.charge_abuse()
                self.end("a text is not UTF-8", _INVALID_DATA)
                return False

        self._message_count += 1
        self._messages.append((message, self._arrived, self._partial))
        self._partial, self._is_partial = None, False
        self._release_arriving()
        return True

    def _count_partial(self) -> None:
        """Charge a partly received message to its key before the remaining part is read, and count
        its bytes as they arrive.
        """
        handler = self._handler
        if handler is None:
            return
        try:
            if not self._is_partial:
                charge = handler.begin()
                if charge is not None:
                    charge.require()
                self._partial = charge
                self._is_partial = True
        except TooManyRequests:  # the remaining bytes stay unread until the key is within its rate
            self._throttle()
            if self.account.refused_too_often:
                self.end(REFUSED)
        except VLAgentsError as error:
            self._end_for(error)
        else:
            self._count_incomplete()

    def _is_backlogged(self) -> bool:
        handler = self._handler
        return handler is not None and (
            self._unanswered >= handler.most_unanswered
            or self._unanswered_bytes > handler.most_unanswered_bytes
        )

    def _process_messages(self) -> None:
        """Serve the received messages in order, until a message has to wait."""
        while self._messages and not (
            self._ended or self._is_closed_here or self._unpolled_for & {DECODING, THROTTLED}
        ):
            message, arrived, charge = self._messages.popleft()
            if self._handler is None:  # no frame is read before the handshake is accepted
                raise VLAgentsError("stream: a message arrived before the handshake was accepted")
            self._handler.receive(message, arrived, charge)
            if self.account.refused_too_often:
                self.end(REFUSED)
            if self._is_rated:
                self._throttle()

    def _unthrottle(self) -> None:
        if not self._end_throttling():
            return
        if (self._received.size or self._fragments) and not self._is_partial:
            self._count_partial()
        self._continue()

    def _continue(self) -> None:
        self._process_messages()
        super()._continue()

    # The end.

    def _end_sessions(self) -> None:
        if self._handler is None or self._has_ended_sessions:
            return
        self._has_ended_sessions = True
        close = self._protocol.close_rcvd or self._protocol.close_sent
        self._handler.ended(_ABNORMAL if close is None else int(close.code))

    def _discard(self) -> None:
        # A connection without a message is charged as one request; so is a partial message that was
        # not charged.
        if not self._message_count or (self._is_partial and self._partial is None):
            self.account.charge_abuse()
        self._partial = None
        self._fragments = []
        self._received.discard()
        super()._discard()

    def _slow_cause(self, now: float) -> tuple[str, int] | None:
        cause = super()._slow_cause(now)
        return self._ping(now) if cause is None and self._pings else cause

    def _ping(self, now: float) -> tuple[str, int] | None:
        """Ping a client that is silent at `now`, s; return a reason and a close code if it does
        not answer.
        """
        if self._alive_at > self._pinged_at:
            self._pinged_at = 0.0
        if self._pinged_at:
            if now - self._pinged_at > _PING_S:
                return f"no answer to a ping within {_PING_S:g} s", GOING_AWAY
        elif now - self._alive_at > _PING_S:
            self._pinged_at = now
            with self._sending:
                if not self._ended and self._protocol.state is State.OPEN:
                    self._protocol.send_ping(b"")
                    self._flush()
        return None

    def end(self, reason: str, code: int = POLICY_VIOLATION) -> None:
        """Send a close code and its reason after the answers, see `MessageConnection.end`."""
        super().end(reason, code)
        self._call_soon(lambda: self._resume(_FINISHING))

    def _send_close(self, code: int, reason: str) -> None:
        if self._protocol.state is State.OPEN:
            self._ended_at = time.monotonic()
            self._protocol.send_close(code, reason[:120])
            self._out.send(b"".join(self._protocol.data_to_send()), last=True)

    def _flush(self) -> None:
        """Send the bytes that the protocol has produced; the caller holds the lock."""
        pieces = self._protocol.data_to_send()
        if pieces:
            self._out.send(b"".join(pieces), last=b"" in pieces)
