"""One WebSocket connection at a replica's own port, from its handshake to its end: see `websocket` beside it."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import ClassVar, NamedTuple

from websockets.frames import Frame, Opcode
from websockets.http11 import Request as Handshake
from websockets.http11 import Response
from websockets.protocol import State
from websockets.server import ServerProtocol

from vlagents_ray.errors import MalformedMessage, Overloaded, PolicyUnavailable, TooManyRequests, VLAgentsError
from vlagents_ray.protocol.frames import Decoded, decode_requests
from vlagents_ray.protocol.messages import STREAM_BYTES, Limits, is_probe, probe_answer, read_probe
from vlagents_ray.serve.access.api_keys import Caller, Identity
from vlagents_ray.serve.endpoints.buffers import READ_BYTES, ReceiveBuffer, SendBuffer, receive
from vlagents_ray.serve.engine import arrival
from vlagents_ray.serve.engine.admission import MessageAdmission, NeedsDecodingThread, decode_in_background, image_bytes
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import REFUSED, Sender
from vlagents_ray.serve.requests import Message

logger = logging.getLogger(__name__)

_HANDSHAKE_BYTES = 16 * 1024  # maximum size of a handshake
_HANDSHAKE_S = 5.0  # maximum time of a handshake
_REFUSED_S = 1.0  # maximum time for which the refusal of a handshake is delayed
_END_OF_HEADERS = b"\r\n\r\n"
_UNANSWERED = 256  # maximum of unanswered messages of one client: further ones stay unread in its connection
_GOING_AWAY, _UNSUPPORTED_DATA, _POLICY_VIOLATION, _TRY_AGAIN_LATER = 1001, 1003, 1008, 1013  # close codes


class WebSocketConnection:
    """One connection of a client; its sessions end with it."""

    name: ClassVar[str] = "websocket"

    def __init__(
        self,
        connection: socket.socket,
        engine: Engine,
        limits: Limits,
        admit: Callable[[WebSocketConnection, Handshake], Identity],
        on_close: Callable[[WebSocketConnection], None],
        *,
        slow_s: float,
        idle_s: float,
    ) -> None:
        """`admit` identifies a handshake's caller or raises, `on_close` is called at the end; see `WebSocketServer`."""
        self._engine = engine
        self._limits = limits
        self._admit = admit
        self._on_close = on_close
        self._slow_s, self._idle_s = slow_s, idle_s
        self._connection = connection
        self._arrived = 0.0  # arrival time of the bytes read last, s
        self._protocol = ServerProtocol(max_size=STREAM_BYTES)
        self._head = b""  # received part of the handshake
        self._refused_for_s = 0.0  # time after which the handshake would not be over the rate of its key
        self._sender: Sender | None = None  # None until the handshake is accepted
        self.caller: Identity | None = None  # None until the handshake is accepted
        self._sending = threading.Lock()  # guards the protocol and the sending: other threads send replies
        self._received = ReceiveBuffer()
        self._out = SendBuffer(connection, self._sending, STREAM_BYTES)
        self._ended = False
        self._polled = True  # whether the batch queue polls the connection
        self._paused = False  # not polled until some of its messages are answered
        self._decoding = self._throttled = False  # not polled until a frame is decoded, or the key under its rate again
        # Received but unprocessed frames, their arrival times, s, and the admissions of those that came in parts.
        self._frames: deque[tuple[Frame, float, MessageAdmission | None]] = deque()
        self._partial: MessageAdmission | None = None  # admission of the message of which a part is here
        self._unanswered = self._unanswered_bytes = 0  # messages; bytes with the decoded images
        self._messages = 0  # number received so far
        self._ending = False  # `end` was called; bytes that arrive now are ignored
        self._discarded = 0  # bytes that arrived after a wrong message, which nobody reads
        # Of `overdue` alone: messages at its last call, since when so many, since when a part of the next is here (s).
        self._seen, self._quiet_since, self._part_since = 0, time.monotonic(), float("inf")

    def ready(self) -> None:
        """Read the connection, which has bytes or has ended."""
        try:
            self._read()
        except Exception:
            logger.exception("stream client: disconnected after an error")
            self.disconnect()

    def _read(self) -> None:
        if self._sender is not None and self._sender.rated and self._is_throttled():
            self._stop_polling()
            return
        try:
            data, control = receive(self._connection, _HANDSHAKE_BYTES if self._sender is None else READ_BYTES)
            self._arrived = time.perf_counter() - arrival.waited_s(control)
        except BlockingIOError:
            return
        except OSError as error:
            logger.info("stream client: %s", error)
            data = b""
        if closing := self._protocol.state is State.CLOSING:
            self._discarded += len(data)
        if self._ending or self._discarded > self._limits.body_bytes or not (data or (self._sender and not closing)):
            self.disconnect()
            return
        if closing:  # bytes left unread would reset the connection before the client reads the close code
            return
        if self._sender is None:
            self._head += data
            end = self._head.find(_END_OF_HEADERS)
            if end < 0 and len(self._head) <= _HANDSHAKE_BYTES:
                return
            head, data = self._head[: end + len(_END_OF_HEADERS)], self._head[end + len(_END_OF_HEADERS) :]
            if end < 0 or not self._handshake(head):
                self._refuse_handshake()
                return
            self._head = b""
            if not data:
                return
        self._receive(data)

    def _receive(self, data: bytes | memoryview) -> None:
        """Process bytes that follow the handshake; empty `data` means that the connection has ended."""
        with self._sending:
            if data:
                self._received.parse(data)
            else:
                self._protocol.receive_eof()
            events = self._protocol.events_received()
            self._flush()
        for event in events:
            if isinstance(event, Frame) and event.opcode in (Opcode.BINARY, Opcode.TEXT, Opcode.CONT):
                self._messages += 1
                self._frames.append((event, self._arrived, self._partial))
                self._partial = None
        self._process_frames()
        if self._received.size and self._sender is not None and not self._ended:
            self._hold_partial(self._sender)
        if not data or self._protocol.state is State.CLOSED or self._protocol.close_rcvd is not None:
            self.disconnect()
            return
        with self._sending:
            self._paused = self._is_backlogged() and self._protocol.state is State.OPEN
        if self._paused or self._decoding or self._throttled:
            self._stop_polling()

    def _hold_partial(self, sender: Sender) -> None:
        """Count a message of which a part is here for its key, before the rest is read, and its bytes as they come."""
        try:
            if self._partial is None:
                admission = sender.admission(self._limits)
                admission.begin_message()
                self._partial = admission
            self._partial.grow(self._received.size)
        except TooManyRequests:  # the rest stays unread until the key is under its rate
            self._is_throttled()
            if sender.refused_too_often:
                self.end(_POLICY_VIOLATION, REFUSED)
        except VLAgentsError as error:
            self.end(_TRY_AGAIN_LATER if isinstance(error, Overloaded) else _POLICY_VIOLATION, str(error))

    def _is_throttled(self) -> bool:
        """Whether the key of the client is over its rate; if so, the connection is read again later."""
        if not self._throttled and self._sender is not None and (wait_s := self._sender.throttled_s()) > 0:
            self._throttled = True
            self._engine.queue.call_later(wait_s, self._unthrottle)
        return self._throttled

    def disconnect(self) -> None:
        """Stop polling the connection and close it; call it on the thread that polls."""
        if not self._ended:
            self._stop_polling()
            self.release()

    def _stop_polling(self) -> None:
        if self._polled:
            self._polled = False
            self._engine.queue.unwatch(self._connection)

    def _resume_polling(self) -> None:
        if not self._ended and not self._polled and not (self._paused or self._decoding or self._throttled):
            self._polled = True
            self._engine.queue.watch(self._connection, self.ready)

    def _is_backlogged(self) -> bool:
        """Whether the client has too many unanswered messages or bytes; the caller holds the lock."""
        return self._unanswered >= _UNANSWERED or self._unanswered_bytes > self._limits.body_bytes

    def release(self) -> None:
        """Close the connection and end its sessions."""
        if self._sender is not None:
            self._sender.release()
        with self._sending:
            self._ended = True  # the number of its descriptor may soon be reused
            self._partial = None
            self._received.discard()
            self._out.close()
            self._connection.close()
        self._on_close(self)

    def overdue(self, now: float, refusal: Callable[[Caller], str | None]) -> tuple[int, str] | None:
        """Return a close code and a reason if the connection has to end; called periodically.

        `refusal` returns the reason if a key is no longer valid. Time counts against the client only while the server
        has read all that arrived: a slow policy keeps its thread from reading.
        """
        if isinstance(self.caller, Caller) and (reason := refusal(self.caller)) is not None:
            return _POLICY_VIOLATION, reason
        if self._messages != self._seen or self._unanswered or not self._polled:
            self._seen, self._quiet_since, self._part_since = self._messages, now, float("inf")
        if not self._received.size:
            self._part_since = float("inf")
        elif self._part_since > now:
            self._part_since = now
        cause: tuple[int, str] | None = None
        if self._protocol.state is not State.OPEN and now - self._quiet_since > _HANDSHAKE_S:
            cause = _POLICY_VIOLATION, "no handshake" if self._sender is None else "open long after a wrong message"
        elif now - self._part_since > self._slow_s:
            cause = _POLICY_VIOLATION, f"a message took longer than {self._slow_s:g} s"
        elif now - self._quiet_since > self._idle_s:
            cause = _GOING_AWAY, "silent for too long"
        with self._sending:
            if cause is not None and not self._ended and arrival.has_unread(self._connection):
                self._quiet_since, self._part_since, cause = now, float("inf"), None
        return cause

    def end(self, code: int, reason: str) -> None:
        """Close the connection from any thread, even while the policy runs; bytes that still arrive are ignored."""
        logger.info("a WebSocket at the replica's own port is closed: %s", reason)
        with self._sending:
            if self._ended:
                return
            self._ending = True
            if self._protocol.state is State.OPEN:
                self._protocol.send_close(code, reason[:120])
                self._flush()
            with contextlib.suppress(OSError):  # the client closed it already
                self._connection.shutdown(socket.SHUT_RDWR)

    def _handshake(self, head: bytes) -> bool:
        """Accept the handshake; return False if it is refused, with the response yet to be sent."""
        with self._sending:
            self._protocol.receive_data(head)
            events = self._protocol.events_received()
        if len(events) == 1 and isinstance(events[0], Handshake):
            response = self._handshake_response(events[0])
            with self._sending:
                self._protocol.send_response(response)
        if self._protocol.state is not State.OPEN or self.caller is None:
            return False
        with self._sending:
            self._flush()
        self._received.attach(self._protocol)
        self._sender = Sender(self._engine, self.name, caller=self.caller)
        return True

    def _refuse_handshake(self) -> None:
        """Refuse the handshake, after a moment if the key is over its rate, which bounds how often it is refused."""
        self._stop_polling()

        def refuse() -> None:
            with self._sending:
                if not self._ended:
                    self._flush()
            self.disconnect()

        if self._refused_for_s > 0:
            self._engine.queue.call_later(min(self._refused_for_s, _REFUSED_S), refuse)
        else:
            refuse()

    def _handshake_response(self, request: Handshake) -> Response:
        try:
            self.caller = self._admit(self, request)
            return self._protocol.accept(request)
        except VLAgentsError as refused:
            response = self._protocol.reject(refused.status, f"{refused}\n")
            if isinstance(refused, TooManyRequests | PolicyUnavailable):
                response.headers["Retry-After"] = "1"
            if isinstance(refused, TooManyRequests):
                self._refused_for_s = refused.retry_after_s
            return response

    def _process_frames(self) -> None:
        """Process the received frames in order, until one has to wait."""
        while self._frames and not (self._decoding or self._throttled or self._ended):
            self._process(*self._frames.popleft())

    def _continue(self) -> None:
        """Continue after a delay has ended; call it on the thread that polls."""
        self._process_frames()
        self._resume_polling()

    def _unthrottle(self) -> None:
        self._throttled = False
        if self._ended or self._is_throttled():
            return
        if self._received.size and self._partial is None and self._sender is not None:
            self._hold_partial(self._sender)
        self._continue()

    def _process(self, frame: Frame, arrived: float, admission: MessageAdmission | None) -> None:
        if self._sender is None:  # nothing is read before the handshake is accepted
            raise VLAgentsError("stream: a message before the handshake was accepted")
        if frame.opcode is Opcode.CONT or not frame.fin:
            with self._sending:
                self._protocol.fail(_UNSUPPORTED_DATA, "messages in fragments; send each in one frame")
                self._flush()
            return
        sender, message = self._sender, self._sender.message()
        admission = admission or sender.admission(self._limits)
        admission.size = len(frame.data)
        try:
            admission.begin_message()
            if frame.opcode is Opcode.TEXT:
                raise MalformedMessage("stream: got a text message, want a binary frame")
            data = bytes(frame.data)
            if is_probe(data):
                read_probe(data, admission)
                self._send(probe_answer(len(data)))
            else:
                self._decode(_Received(sender, admission, message, len(data), arrived), data)
        except VLAgentsError as error:
            message.refuse(error)
            self._send(message.frame())
            if sender.refused_too_often:
                self.end(_POLICY_VIOLATION, REFUSED)
        if sender.rated:
            self._is_throttled()

    def _decode(self, received: _Received, data: bytes) -> None:
        read = partial(decode_requests, data)
        try:
            self._submit(received, read(received.admission))
        except NeedsDecodingThread:
            self._decoding = True
            decode_in_background(self._engine.queue, received.admission, read, partial(self._decoded, received))

    def _submit(self, received: _Received, decoded: Decoded) -> None:
        """Send the requests of a message to the engine; their deadlines count from the arrival of the message."""
        received.message.decoded(decoded)
        waited_s = time.perf_counter() - received.arrived
        size = received.size + sum(map(image_bytes, decoded.requests))
        with self._sending:
            self._unanswered += 1
            self._unanswered_bytes += size
        received.sender.send(
            received.message,
            decoded,
            partial(self._answer, size),
            admission=received.admission,
            waited_s=waited_s if waited_s > arrival.LEAST_S else 0.0,
        )

    def _decoded(self, received: _Received, result: Callable[[], Decoded]) -> None:
        """Take a message that another thread has decoded; called on the thread that polls."""
        if self._ended:
            return
        try:
            self._submit(received, result())
        except VLAgentsError as error:
            received.message.refuse(error)
            self._send(received.message.frame())
        except Exception:
            logger.exception("stream client: disconnected after an error")
            self.disconnect()
        self._decoding = False
        self._continue()

    def _answer(self, size: int, message: Message) -> None:
        with self._sending:
            self._unanswered -= 1
            self._unanswered_bytes -= size
            resume = self._paused and not self._is_backlogged()
            self._paused = self._paused and not resume
        if resume:
            self._engine.queue.call_soon(self._resume_polling)
        self._send(message.frame())

    def _send(self, data: bytes) -> None:
        with self._sending:
            if not self._ended and self._protocol.state is State.OPEN:
                self._protocol.send_binary(data)
                self._flush()

    def _flush(self) -> None:
        """Send the bytes that the protocol has produced; the caller holds the lock."""
        pieces = self._protocol.data_to_send()
        self._out.send(b"".join(pieces), last=b"" in pieces)


class _Received(NamedTuple):
    """A complete message of a client, and the objects that process it."""

    sender: Sender
    admission: MessageAdmission
    message: Message
    size: int  # bytes
    arrived: float  # s, of `time.perf_counter`
