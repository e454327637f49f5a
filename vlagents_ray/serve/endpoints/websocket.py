"""The WebSocket port of a replica, without a proxy between the robot and the policy thread.

Large messages are not copied, and a client that reads slowly delays no other client.

The metadata contains the port and an unguessable path, so that only clients that may read the
metadata can use the port; with API keys, the handshake must also contain one. Messages are those of
`WS /v1/stream` on the server's port, which remains for clients that cannot reach this one. As for
local clients, the policy thread reads the sockets (see `vlagents_ray.serve.endpoints.connection`)
and decodes the messages.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Collection
from functools import partial
from typing import ClassVar

from websockets.frames import Frame, Opcode
from websockets.http11 import Request as Handshake
from websockets.protocol import State
from websockets.server import ServerProtocol

from vlagents_ray.errors import (
    ConfigError,
    MalformedMessage,
    Overloaded,
    PolicyUnavailable,
    TooManyRequests,
    UnknownApp,
    VLAgentsError,
)
from vlagents_ray.protocol import messages
from vlagents_ray.protocol.frames import Decoded, decode_requests
from vlagents_ray.protocol.websocket_frames import (
    CONTROL_FRAMES,
    CONTROL_FRAMES_PER_S,
    HEAD_BYTES,
    ReceiveBuffer,
    frame_head,
    frame_size,
)
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey, token_of
from vlagents_ray.serve.access.origin_check import require_own_page
from vlagents_ray.serve.endpoints import answers
from vlagents_ray.serve.endpoints.connection import (
    BACKLOG,
    BACKLOGGED,
    DECODING,
    LEAST_WAIT_S,
    MOST_UNANSWERED,
    POLICY_VIOLATION,
    THROTTLED,
    Admit,
    PolledConnection,
    PolledServer,
    ReadBuffer,
    enable_timestamps,
    has_unread,
    time_in_socket_s,
    wait_delivered,
)
from vlagents_ray.serve.engine.admission import ArrivingBytes, MessageAdmission, image_bytes
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import REFUSED, Sender
from vlagents_ray.serve.requests import IncomingMessage
from vlagents_ray.serve.token_bucket import TokenBucket

logger = logging.getLogger(__name__)

_READ_BYTES = 1024 * 1024  # maximum size of a read; room for a message with two or three raw images
# Maximum number of frames that are read from a connection before others have their turn.
_FRAMES_PER_READ = 16
_DISCARD_BYTES = 64 * 1024  # maximum size of a read after an invalid message
_SLOW_S = 10.0  # maximum time without progress for a client that does not read all replies at once
_MAX_HANDSHAKES = 64  # maximum number of connections without a completed handshake
_HANDSHAKE_BYTES = 16 * 1024  # maximum size of a handshake
_HANDSHAKE_S = 5.0  # maximum time of a handshake
_REFUSED_S = 1.0  # maximum time for which the refusal of a handshake is delayed
_END_OF_HEADERS = b"\r\n\r\n"
_GOING_AWAY, _UNSUPPORTED_DATA, _TRY_AGAIN_LATER = 1001, 1003, 1013  # close codes
_REFUSED = "its handshake is refused"  # a further reason for not polling a connection

# The kernel detects that a peer has disappeared: after 20 s of silence it sends three probes, 5 s
# apart.
_KEEPALIVE = (
    ("TCP_KEEPIDLE", 20),
    ("TCP_KEEPINTVL", 5),
    ("TCP_KEEPCNT", 3),
    ("TCP_USER_TIMEOUT", 35_000),
)

read_buffer = ReadBuffer(_READ_BYTES)


class WebSocketServer(PolledServer["WebSocketConnection"]):
    """Accepts WebSockets at a port of the replica."""

    name: ClassVar[str] = "websocket"

    def __init__(
        self,
        engine: Engine,
        limits: messages.MessageLimits,
        host: str,
        ports: tuple[int, int] | None,
        admit: Admit | NoKey,
        *,
        slow_s: float = 30.0,
        idle_s: float = 600.0,
        hosts: Collection[str] = (),
    ) -> None:
        """Bind a port.

        Args:
            ports: The first and last port to try, both included; None for any free port.
            admit: Returns the caller that a key belongs to, or raises for an invalid key.
            slow_s: Maximum time that a message may take to arrive, s.
            idle_s: Maximum time that a connection may be silent, s.
            hosts: Further host names of the server.

        Raises:
            ConfigError: All ports are in use.
        """
        super().__init__(engine, limits, admit, _bind(host, ports))

        self.slow_s = slow_s
        self.idle_s = idle_s
        self._hosts = hosts
        self.path = messages.STREAM_PATH + secrets.token_urlsafe(24)

        # Connections before their handshake, in order of arrival.
        self._handshaking: dict[WebSocketConnection, None] = {}
        self.address = messages.StreamAddress(self._listener.getsockname()[1], self.path)

    def open(self) -> None:
        """Accept clients; call this before the engine starts."""
        # Accepted connections inherit the option, which the kernel enables after a moment.
        enable_timestamps(self._listener)
        super().open()

    def identify(self, client: WebSocketConnection, request: Handshake) -> Identity:
        """Return the owner of the handshake's key, and count one more connection for that key.

        Raises:
            UnknownApp: The path is another one.
            Unauthorized: The key is missing, unknown, revoked or expired.
            Forbidden: The key is for other applications, or the page is another site's.
            TooManyRequests: The key has as many connections as it may hold sessions, or is over its
                rate.
            PolicyUnavailable: The replica has as many connections as it may hold sessions.
        """
        if not secrets.compare_digest(request.path.encode(), self.path.encode()):
            raise UnknownApp("no such path")

        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        caller: Identity
        if isinstance(self.admit, NoKey):
            require_own_page(headers, self._hosts)
            caller = self.admit
        else:
            caller = self.admit(token_of(headers))

        streams = len(self._clients) - len(self._handshaking)
        if streams >= self.engine.sessions.limit:
            raise PolicyUnavailable(f"this replica has {streams} streams, its limit of sessions")
        if isinstance(caller, Caller):
            caller.require_unthrottled()
            caller.hold()
            caller.note("let in by", self.name)
        del self._handshaking[client]
        return caller

    def remove(self, client: WebSocketConnection) -> None:
        """Remove a connection, possibly during its handshake."""
        self._handshaking.pop(client, None)
        super().remove(client)

    def _add_client(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

        if len(self._handshaking) >= _MAX_HANDSHAKES:
            oldest = next(iter(self._handshaking))
            oldest.disconnect()
        client = WebSocketConnection(self, connection)
        self._serve(client, connection)
        self._handshaking[client] = None


class WebSocketConnection(PolledConnection):
    """One WebSocket, from its handshake to its end."""

    def __init__(self, server: WebSocketServer, connection: socket.socket) -> None:
        super().__init__(server, connection)
        self._server = server
        self._limits = server.limits
        self._protocol = ServerProtocol(max_size=messages.STREAM_BYTES)  # guarded by the lock

        self._head = b""  # received part of the handshake
        # Time after which the handshake is no longer over the rate of its key.
        self._refused_for_s = 0.0

        self._arrived = 0.0  # arrival time of the bytes read last, s
        self._frame_head = b""  # received part of a frame's head, until the head is complete
        self._frame_left = 0  # unread bytes of the current frame, once its head is complete
        self._control_frames = TokenBucket(CONTROL_FRAMES_PER_S, time.monotonic(), CONTROL_FRAMES)
        self._received = ReceiveBuffer(messages.STREAM_BYTES)
        # Received but unprocessed frames, their arrival times, s, and the admissions of those
        # received in parts.
        self._frames: deque[tuple[Frame, float, MessageAdmission | None]] = deque()
        self._partial: MessageAdmission | None = None  # admission of a partly received message
        self._arriving: ArrivingBytes | None = None  # bytes of a partly received message
        self._messages = 0  # number of messages received so far

        self._out = SendBuffer(connection, self._sending, messages.STREAM_BYTES)
        self._unanswered = 0  # number of unanswered messages
        self._unanswered_bytes = 0  # size of the unanswered messages with their decoded images
        self._paused = False  # whether too many messages are unanswered; guarded by the lock

        self._ending = False  # whether `end` was called, so that arriving bytes are ignored
        self._discarded = 0  # number of bytes that were discarded after an invalid message

        # Only `overdue` uses these.
        self._messages_before = 0  # number of messages at its last call
        self._quiet_since = time.monotonic()  # time of the last message or answer, s
        self._part_since = float("inf")  # arrival time of the current partial message, s

    def _read(self) -> None:
        frames = 0
        while self._read_part() and frames < _FRAMES_PER_READ:
            frames += 1

    def _read_part(self) -> bool:
        """Read the handshake or a part of a frame; return whether more may be read, since a
        frame is complete.
        """
        if self._sender is not None and self._sender.rated and self._throttle():
            return False

        data: bytes | memoryview
        is_closing = self._protocol.state is State.CLOSING
        try:
            size = _DISCARD_BYTES if is_closing else self._bytes_to_read()
            data, control = read_buffer.receive(self._connection, size)
            self._arrived = time.perf_counter() - time_in_socket_s(control)
        except BlockingIOError:
            return False
        except OSError as error:
            logger.info("stream client: %s", error)
            data = b""

        # After an invalid message bytes are read and discarded: unread bytes would reset the
        # connection before the client reads the close code.
        if is_closing:
            self._discarded += len(data)
        if self._ending or self._discarded > self._limits.body_bytes:
            self.disconnect()
            return False
        if not data and (self._sender is None or is_closing):
            self.disconnect()
            return False
        if self._sender is None:
            self._receive_handshake(data)
            return False
        if is_closing:
            return False

        if self._frame_left:
            self._frame_left -= len(data)
        self._receive(data)
        return not self._frame_left and self._polled and not self._ended

    def _receive_handshake(self, data: bytes | memoryview) -> None:
        self._head += data
        is_complete = self._head.endswith(_END_OF_HEADERS)
        if not is_complete and len(self._head) <= _HANDSHAKE_BYTES:
            return
        if not is_complete or not self._accept_handshake(self._head):
            self._refuse_handshake()
        self._head = b""

    def _bytes_to_read(self) -> int:
        """Return how many bytes to read now: at most the handshake, and then at most one frame.

        The bytes after them stay in the socket until it is known whether the client may send more.
        If the connection has ended, the number is 1, which reads its end. Raises `BlockingIOError`
        if the socket is empty.
        """
        if self._sender is None:
            peeked = self._connection.recv(_HANDSHAKE_BYTES, socket.MSG_PEEK)
            # The end of the headers may have arrived in parts.
            overlap = self._head[1 - len(_END_OF_HEADERS) :]
            end = (overlap + peeked).find(_END_OF_HEADERS)
            if end < 0:
                return len(peeked) or 1
            return end + len(_END_OF_HEADERS) - len(overlap)

        if not self._frame_left:
            peeked = self._connection.recv(HEAD_BYTES - len(self._frame_head), socket.MSG_PEEK)
            head = self._frame_head + peeked
            size = frame_size(head)
            if size is None:
                self._frame_head = head
                return len(peeked) or 1
            self._frame_left = size - len(self._frame_head)
            self._frame_head = b""
        return min(self._frame_left, _READ_BYTES)

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
            if not isinstance(event, Frame):
                continue
            if event.opcode in (Opcode.BINARY, Opcode.TEXT, Opcode.CONT):
                self._messages += 1
                self._frames.append((event, self._arrived, self._partial))
                self._partial = None
                if self._arriving is not None:
                    self._arriving.release()
            elif self._control_frames.take(time.monotonic()) > 0:
                self._charge_abuse()
                self.end(f"more than {CONTROL_FRAMES} control frames at once")
                return

        if was_open and self._protocol.state is State.CLOSING and self._protocol.close_rcvd is None:
            # The frame is invalid; up to `limits.body_bytes` after it are discarded.
            self._charge_abuse()
        self._process_frames()
        if self._received.size and self._sender is not None and not self._ended:
            self._hold_partial(self._sender)

        is_closed = self._protocol.state is State.CLOSED or self._protocol.close_rcvd is not None
        if not data or is_closed:
            self.disconnect()
            return

        with self._sending:
            paused = self._is_backlogged() and self._protocol.state is State.OPEN
            self._paused = paused
        if paused:
            self._pause(BACKLOGGED)

    def _charge_abuse(self) -> None:
        """Charge a message to the key, as for a message that is refused, before the connection
        ends.
        """
        if self._sender is not None:
            with contextlib.suppress(VLAgentsError):
                self._sender.count_message()

    def _hold_partial(self, sender: Sender) -> None:
        """Count a partly received message for its key before the rest is read, and its bytes as
        they arrive.
        """
        try:
            if self._partial is None:
                admission = sender.admission(self._limits)
                admission.begin_message()
                self._partial = admission
            if self._arriving is None:
                caller = self.caller if isinstance(self.caller, Caller) else None
                is_robot = caller is None or caller.priority != "simulation"
                key = None if caller is None else caller.name
                self._arriving = ArrivingBytes(self._engine.admission, key, is_robot, self._give_up)
            self._arriving.resize(self._received.size)
        except TooManyRequests:  # the rest stays unread until the key is under its rate
            self._throttle()
            if sender.refused_too_often:
                self.end(REFUSED)
        except VLAgentsError as error:
            self.end(
                str(error), _TRY_AGAIN_LATER if isinstance(error, Overloaded) else POLICY_VIOLATION
            )

    def _give_up(self) -> None:
        """End the connection, as a complete message needs the memory; called on any thread."""
        self._call_soon(partial(self.end, "a complete message needs the memory", _TRY_AGAIN_LATER))

    def _is_backlogged(self) -> bool:
        """Return whether the client has too many unanswered messages or bytes; the caller holds
        the lock.
        """
        return (
            self._unanswered >= MOST_UNANSWERED or self._unanswered_bytes > self._limits.body_bytes
        )

    def _discard(self) -> None:
        if not self._messages:  # a connection without a message costs as much as one
            self._charge_abuse()
        self._partial = None
        if self._arriving is not None:
            self._arriving.release()
        self._received.discard()
        self._out.close()

    def overdue(
        self, now: float, refusal: Callable[[Caller], str | None]
    ) -> tuple[str, int] | None:
        """Return a reason and a close code if the connection is too slow or has to end; see
        `PolledConnection`.

        Time counts against the client only if the server has read all bytes that arrived: a slow
        policy keeps the thread from reading.
        """
        cause = super().overdue(now, refusal)
        if cause is not None:
            return cause

        if self._messages != self._messages_before or self._unanswered or not self._polled:
            self._messages_before = self._messages
            self._quiet_since = now
            self._part_since = float("inf")
        if not self._received.size:
            self._part_since = float("inf")
        elif self._part_since > now:
            self._part_since = now

        if self._protocol.state is not State.OPEN and now - self._quiet_since > _HANDSHAKE_S:
            reason = "no handshake" if self._sender is None else "open long after a wrong message"
            cause = reason, POLICY_VIOLATION
        elif now - self._part_since > self._server.slow_s:
            cause = f"a message took longer than {self._server.slow_s:g} s", POLICY_VIOLATION
        elif now - self._quiet_since > self._server.idle_s:
            cause = "silent for too long", _GOING_AWAY

        with self._sending:
            if cause is not None and not self._ended and has_unread(self._connection):
                self._quiet_since = now
                self._part_since = float("inf")
                return None
        return cause

    def _send_close(self, code: int, reason: str) -> None:
        self._ending = True
        if self._protocol.state is State.OPEN:
            self._protocol.send_close(code, reason[:120])
            self._flush()

    def wait_answered(self, until: float) -> None:
        self._out.wait_sent(until)
        wait_delivered(self._connection, until)

    def _accept_handshake(self, head: bytes) -> bool:
        """Accept the handshake; return False if it is refused, before the refusal is sent."""
        with self._sending:
            self._protocol.receive_data(head)
            events = self._protocol.events_received()
        if len(events) == 1 and isinstance(events[0], Handshake):
            try:
                self.caller = self._server.identify(self, events[0])
                response = self._protocol.accept(events[0])
            except VLAgentsError as refused:
                response = self._protocol.reject(refused.status, f"{refused}\n")
                if isinstance(refused, TooManyRequests | PolicyUnavailable):
                    response.headers["Retry-After"] = "1"
                if isinstance(refused, TooManyRequests):
                    self._refused_for_s = refused.retry_after_s
            with self._sending:
                self._protocol.send_response(response)

        if self._protocol.state is not State.OPEN or self.caller is None:
            return False
        self._received.attach(self._protocol)
        self._sender = Sender(self._engine, self._name, caller=self.caller)
        with self._sending:
            self._flush()
        return True

    def _refuse_handshake(self) -> None:
        """Refuse the handshake.

        If the key is over its rate, the refusal is delayed, which bounds the rate of refusals.
        """
        self._pause(_REFUSED)

        def refuse() -> None:
            """Send the refusal, and close the connection."""
            with self._sending:
                if not self._ended:
                    self._flush()
                    # Closing a socket with unread bytes resets the connection.
                    with contextlib.suppress(OSError):
                        self._connection.recv(_HANDSHAKE_BYTES)
            self.disconnect()

        if self._refused_for_s > 0:
            self._call_later(min(self._refused_for_s, _REFUSED_S), refuse)
        else:
            refuse()

    def _process_frames(self) -> None:
        """Process the received frames in order, until one of them has to wait."""
        while self._frames and not (self._ended or self._unpolled_for & {DECODING, THROTTLED}):
            self._process(*self._frames.popleft())

    def _unthrottle(self) -> None:
        if not self._end_throttling():
            return
        if self._received.size and self._partial is None and self._sender is not None:
            self._hold_partial(self._sender)
        self._continue()

    def _continue(self) -> None:
        self._process_frames()
        super()._continue()

    def _process(self, frame: Frame, arrived: float, admission: MessageAdmission | None) -> None:
        if self._sender is None:  # no frame is read before the handshake is accepted
            raise VLAgentsError("stream: a message before the handshake was accepted")
        if frame.opcode is Opcode.CONT or not frame.fin:
            with self._sending:
                self._protocol.fail(
                    _UNSUPPORTED_DATA, "messages in fragments; send each in one frame"
                )
                self._flush()
            self._charge_abuse()
            return

        sender = self._sender
        message = sender.message()
        admission = admission or sender.admission(self._limits)
        admission.size = len(frame.data)
        try:
            admission.begin_message()
            if frame.opcode is Opcode.TEXT:
                raise MalformedMessage("stream: got a text message, want a binary frame")
            data = bytes(frame.data)
            if messages.is_probe(data):
                messages.read_probe(data, admission)
                self._send(messages.probe_answer(len(data)))
            else:
                submit = partial(self._submit, sender, message, admission, len(data), arrived)
                self._decode(message, partial(decode_requests, data), admission, submit)
        except VLAgentsError as error:
            message.refuse(error)
            self.deliver(message)
            if sender.refused_too_often:
                self.end(REFUSED)

        if sender.rated:
            self._throttle()

    def _submit(
        self,
        sender: Sender,
        message: IncomingMessage,
        admission: MessageAdmission,
        size: int,
        arrived: float,
        decoded: Decoded,
    ) -> None:
        """Send the requests of a message to the engine; their deadlines count from the arrival
        of the message.
        """
        message.decoded(decoded)
        waited_s = time.perf_counter() - arrived
        size += sum(map(image_bytes, decoded.requests))
        message.size = size
        with self._sending:
            self._unanswered += 1
            self._unanswered_bytes += size
        sender.send(
            message,
            decoded,
            self,
            admission=admission,
            waited_s=waited_s if waited_s > LEAST_WAIT_S else 0.0,
        )

    def deliver(self, message: IncomingMessage) -> None:
        """Send the answers of a message, and read on if the client had too many unanswered."""
        if message.size:  # a message that was refused before its requests were sent has none
            with self._sending:
                self._unanswered -= 1
                self._unanswered_bytes -= message.size
                may_resume = self._paused and not self._is_backlogged()
                self._paused = self._paused and not may_resume
            if may_resume:
                self._call_soon(partial(self._resume, BACKLOGGED))
        super().deliver(message)

    def _send_answers(self, message: IncomingMessage) -> None:
        self._send(answers.as_frame(message))

    def _send(self, data: bytes) -> None:
        with self._sending:
            if not self._ended and self._protocol.state is State.OPEN:
                self._out.send(frame_head(len(data)) + data)

    def _flush(self) -> None:
        """Send the bytes that the protocol has produced; the caller holds the lock."""
        pieces = self._protocol.data_to_send()
        if pieces:
            self._out.send(b"".join(pieces), last=b"" in pieces)


class SendBuffer:
    """The unsent bytes of one connection.

    Call the methods with the connection's lock held; the thread that sends to a slow client
    acquires the same lock.
    """

    def __init__(self, connection: socket.socket, lock: threading.Lock, limit: int) -> None:
        """Create an empty buffer; a client is cut off if more than `limit` bytes wait, or it
        reads none for 10 s.
        """
        self._connection = connection
        self._lock = lock
        self._limit = limit
        self._unsent = bytearray()
        self._thread: threading.Thread | None = None  # sends the rest to a slow client
        self._slow = False  # whether the thread is sending the rest
        self._last = False  # whether no bytes may follow the unsent ones
        self._closed = False

    def send(self, data: bytes, *, last: bool = False) -> None:
        """Send as many bytes as the connection accepts now; a thread sends the rest later.

        After the `last` bytes the client reads the end of the connection, which stays open for
        reading.
        """
        if self._closed:
            return
        self._last = self._last or last
        self._unsent += data
        if not self._slow:
            self._send_now()
            if self._unsent:
                self._slow = True
                self._thread = threading.Thread(
                    target=self._send_rest, name="send-slowly", daemon=True
                )
                self._thread.start()
        elif len(self._unsent) > self._limit:
            self._disconnect()

    def wait_sent(self, until: float) -> None:
        """Wait until the kernel has all bytes, but at most until a time of `time.monotonic`, s;
        call this without the lock.
        """
        if self._thread is not None:
            self._thread.join(max(0.0, until - time.monotonic()))

    def close(self) -> None:
        """Stop sending; call this before the connection is closed."""
        self._closed = True

    def _send_now(self) -> None:
        try:
            sent = self._connection.send(self._unsent) if self._unsent else 0
        except BlockingIOError:
            return
        except OSError as error:
            # the client is gone; the reading thread handles the end of the connection
            logger.info("client: %s", error)
            sent = len(self._unsent)
        del self._unsent[:sent]

        if self._last and not self._unsent:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_WR)

    def _send_rest(self) -> None:
        poller = select.poll()
        poller.register(self._connection, select.POLLOUT)
        while True:
            writable = poller.poll(_SLOW_S * 1e3)
            with self._lock:
                if self._closed:
                    return
                if not writable:
                    self._disconnect()
                self._send_now()
                if not self._unsent:
                    self._slow = False
                    return

    def _disconnect(self) -> None:
        logger.warning("client: takes no replies; cut off")
        self._unsent.clear()
        with contextlib.suppress(OSError):  # the client closed it already
            self._connection.shutdown(socket.SHUT_RDWR)


def _bind(host: str, ports: tuple[int, int] | None) -> socket.socket:
    """Return a non-blocking socket that listens at the first free port."""
    first, last = ports or (0, 0)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for port in range(first, last + 1):
        listener = socket.socket(family)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(BACKLOG)
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            refusal = error
        else:
            return listener
    raise ConfigError(
        f"stream: cannot listen at {host}, ports {first} to {last} ({refusal}); choose other ones"
    )
