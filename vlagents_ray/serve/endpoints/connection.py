"""Servers and connections that the thread of the batch queue reads: shared memory, plasma, and
WebSockets at a replica's own port.

That thread accepts clients, reads and decodes their messages, and submits the requests, so that a
request needs no thread switch; while a batch that takes milliseconds is running, another thread
does this (`vlagents_ray.serve.queue.poller`). Answers are written by the thread that produced them.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import logging
import os
import select
import socket
import struct
import termios
import threading
import time
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Generic, TypeVar

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import Budget, MessageLimits
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey
from vlagents_ray.serve.access.charges import Account
from vlagents_ray.serve.engine.admission import MessageAdmission, NeedsDecodingThread
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.queue.poller import Poller
from vlagents_ray.serve.requests import IncomingMessage
from vlagents_ray.serve.token_bucket import TokenBucket

logger = logging.getLogger(__name__)

# Maximum number of connections that wait to be accepted. Above it the kernel discards a client's
# SYN, which the client repeats after one second, and rejects a local client.
BACKLOG = 1024
# Maximum number of ended connections that are closed together; closing a connection takes about
# 0.01 ms.
_ENDED_AT_ONCE = 64
# Maximum number of unanswered messages of a client; further messages stay unread.
MOST_UNANSWERED = 256
POLICY_VIOLATION, INTERNAL_ERROR, SERVICE_RESTART = 1008, 1011, 1012  # WebSocket close codes
# Number of warnings about clients that a server logs at once, and further ones of each second. A
# client that connects again and again would fill the log.
_WARNINGS, _WARNINGS_PER_S = 10, 0.1
# Maximum number of connections that a server accepts in a second; accepting a connection takes some
# time of the policy's thread.
_ACCEPTED_PER_S = 200.0
# Reasons for not polling a connection.
DECODING, THROTTLED = "a frame is decoded on another thread", "the key is over its rate"
BACKLOGGED = "too much of it is unanswered"
MALFORMED = "it sends malformed messages"

_TIMESTAMP = 35  # SO_TIMESTAMPNS of Linux, which Python's socket does not name
_STAMP = struct.Struct("@qq")  # wall clock, s and ns
STAMP_SPACE = socket.CMSG_SPACE(_STAMP.size)  # bytes of the time stamp in a message's control data
ANSWERS_S = 1.0  # maximum time for clients to receive their last answers when a server ends
_POLL_MS = 2
LEAST_WAIT_S = 1e-3  # a shorter wait cannot be distinguished from the time to read a message

AncillaryData = Sequence[tuple[int, int, bytes]]
# Returns the caller that owns the key; raises `Unauthorized` or `Forbidden`.
KeyCheck = Callable[[str | None], Caller]


class ReadBuffer(threading.local):
    """A buffer of `size` bytes for each thread, into which connections are read. Allocating memory
    for each read would cost as much as copying the data from this buffer.
    """

    def __init__(self, size: int) -> None:
        self._view = memoryview(bytearray(size))

    def receive(
        self, connection: socket.socket, size: int, space: int = STAMP_SPACE
    ) -> tuple[memoryview, AncillaryData]:
        """Read at most `size` bytes, and `space` bytes of control data, from a connection that is
        readable.

        The bytes are valid until this thread reads again; there are none if the connection has
        ended.
        """
        count, control, _, _ = connection.recvmsg_into([self._view[:size]], space)
        return self._view[:count], control


class PolledConnection(ABC):
    """One connection of a client; its sessions end with it."""

    def __init__(self, owner: ConnectionOwner[Any], connection: socket.socket) -> None:
        self._poller = owner.poller
        self._remove = owner.remove
        self._serve = owner.serve
        self._name = owner.name
        self._connection = connection

        self.account = Account()  # account without a caller until the client has sent its key
        # Guards sending: other threads send answers, or end the connection.
        self._sending = threading.Lock()
        self._ended = False
        self._polled = True  # whether the poller watches the connection
        self._unpolled_for: set[str] = set()  # reasons for not polling the connection

    @property
    def caller(self) -> Identity | None:
        """The caller of the connection; None until the client has sent its key."""
        return self.account.caller

    def has_left(self) -> bool:
        """Return whether the client has closed the connection; may be called on any thread."""
        return self._ended or has_hung_up(self._connection)

    @abstractmethod
    def _read(self) -> None:
        """Read from the connection, which is readable."""

    @abstractmethod
    def _end_sessions(self) -> None:
        """End the sessions of a connection that is about to be closed."""

    @abstractmethod
    def _discard(self) -> None:
        """Free the memory of a connection before it is closed; called with the lock held."""

    def _send_close(self, code: int, reason: str) -> None:  # noqa: B027 - not all protocols have close codes
        """Send a close code and its reason, if the protocol has close codes; called with the
        lock held.
        """

    def _continue(self) -> None:
        """Poll the connection again if no reason for a pause is left; called on the
        polling thread.
        """
        if not (self._ended or self._polled or self._unpolled_for):
            self._polled = True
            self._poller.watch(self._connection, self.ready)

    def ready(self) -> None:
        """Read the connection; the batch queue calls this.

        It handles errors as `_run` does, with one function call less per message.
        """
        try:
            self._read()
        except Exception:
            logger.exception("%s: disconnected a client after an error", self._name)
            self.disconnect()

    def _run(self, callback: Callable[[], None]) -> None:
        """Run a callback of the poller; an unexpected error ends this connection, and nothing
        else.
        """
        try:
            callback()
        except Exception:
            logger.exception("%s: disconnected a client after an error", self._name)
            self.disconnect()

    def _call_soon(self, callback: Callable[[], None]) -> None:
        """Schedule a callback on the polling thread; may be called on any thread."""
        self._poller.call_soon(partial(self._run, callback))

    def _call_later(self, seconds: float, callback: Callable[[], None]) -> None:
        """Schedule a callback after `seconds`; call this on the polling thread."""
        self._poller.call_later(seconds, partial(self._run, callback))

    def _pause(self, reason: str) -> None:
        """Stop polling the connection until `_resume` is called with the same reason."""
        self._unpolled_for.add(reason)
        if self._polled:
            self._polled = False
            self._poller.unwatch(self._connection)

    def _resume(self, reason: str) -> None:
        """End the pause for this reason; poll the connection again if no other reason is left."""
        self._unpolled_for.discard(reason)
        self._continue()

    def _pause_for(self, reason: str, seconds: float) -> None:
        """Stop polling the connection for a time; call this on the polling thread."""
        self._pause(reason)
        self._call_later(seconds, partial(self._end_pause, reason))

    def _end_pause(self, reason: str) -> None:
        """Poll the connection again, unless its client has hung up, or another reason is left."""
        if not self._ended and has_hung_up(self._connection):
            self.disconnect()
        self._resume(reason)

    def _throttle(self) -> bool:
        """Pause the connection while the client's key is over its rate; return whether the key is
        over its rate.
        """
        if THROTTLED in self._unpolled_for:
            return True
        if self._ended:
            return False

        wait_s = self.account.throttled_s()
        if wait_s <= 0:
            return False
        self._pause(THROTTLED)
        self._call_later(wait_s, self._unthrottle)
        return True

    def _unthrottle(self) -> None:
        """Read the connection again, unless it has ended or its key has exceeded the rate again."""
        if self._end_throttling():
            self._continue()

    def _end_throttling(self) -> bool:
        """End the pause for the rate of the key; return False if the connection has ended, or the
        key is over its rate again.

        A client that has hung up is disconnected: its unread messages would be rejected one by one,
        which would delay the key's other connections.
        """
        self._unpolled_for.discard(THROTTLED)
        if not self._ended and has_hung_up(self._connection):
            self.disconnect()
        return not self._ended and not self._throttle()

    def decode(
        self,
        read: Callable[[Budget], Decoded],
        admission: MessageAdmission,
        submit: Callable[[Decoded], None],
        refuse: Callable[[VLAgentsError], None],
        *,
        long: bool = False,
    ) -> None:
        """Decode a message with `read`, on another thread if that is slow or the message is
        `long`, and `submit` its requests.

        An error on the other thread is passed to `reject`; an error on this thread is raised.
        """
        try:
            if long:
                raise NeedsDecodingThread
            decoded = admission.decode_here(read)
        except NeedsDecodingThread:
            then = partial(self._decoded, submit, refuse)
            decoding = admission.decode_on_thread(read)
            self._pause(DECODING)
            decoding.add_done_callback(lambda done: self._call_soon(partial(then, done.result)))
        else:
            submit(decoded)

    def _decoded(
        self,
        submit: Callable[[Decoded], None],
        refuse: Callable[[VLAgentsError], None],
        result: Callable[[], Decoded],
    ) -> None:
        """Submit the requests that another thread has decoded; called on the polling thread."""
        try:
            if not self._ended:
                submit(result())
        except VLAgentsError as error:
            refuse(error)
        self._resume(DECODING)

    def send_answers(
        self,
        message: IncomingMessage,
        send: Callable[[IncomingMessage], None],
        stats: MetricsBuffer,
    ) -> None:
        """Encode and send the answers of a message with `send`, and record them, on the thread of
        the last answer.

        An unexpected error ends this connection, and nothing else.
        """
        try:
            send(message)
            stats.record(message)
        except Exception:
            logger.exception("%s: a client's answers cannot be sent", self._name)
            self.end("its answers cannot be sent", INTERNAL_ERROR)

    def overdue(
        self, now: float, refusal: Callable[[Caller], str | None]
    ) -> tuple[str, int] | None:
        """Return a reason and a close code if the connection has to end; called periodically, on
        any thread.

        `now` is the time of `time.monotonic`, s; `refusal` returns the reason why a key is no
        longer valid, or None.
        """
        reason = refusal(self.caller) if isinstance(self.caller, Caller) else None
        return None if reason is None else (reason, POLICY_VIOLATION)

    def end(self, reason: str, code: int = POLICY_VIOLATION) -> None:
        """Close the connection from any thread, even while the policy runs."""
        logger.info("%s: a client is cut off: %s", self._name, reason)
        with self._sending:
            if not self._ended:
                self._send_close(code, reason)
                with contextlib.suppress(OSError):  # the client has already closed the connection
                    self._connection.shutdown(socket.SHUT_RDWR)

    def announce_end(self, reason: str, code: int) -> None:
        """Send the close code and its reason after the answers, and leave the connection open;
        on any thread.
        """
        with self._sending:
            if not self._ended:
                self._send_close(code, reason)

    def wait_answered(self, until: float) -> None:  # noqa: B027 - needed only where the kernel may discard answers
        """Wait until the client has all answers, but at most until a time of `time.monotonic`,
        s.
        """

    def replace_by(self, successor: PolledConnection) -> None:
        """Let another connection read the socket from now on; called on the polling thread."""
        with self._sending:
            self._ended = True
        if self._polled:
            self._poller.unwatch(self._connection)
        self._remove(self)
        successor._serve(successor, self._connection)

    def disconnect(self) -> None:
        """Stop polling the connection and close it; call this on the polling thread."""
        if not self._ended:
            if self._polled:
                self._poller.unwatch(self._connection)
            self.release()

    def release(self) -> None:
        """End the sessions, and close the connection."""
        try:
            self._end_sessions()
        finally:
            with self._sending:
                self._ended = True  # the number of the closed descriptor may soon be reused
                self._discard()
                self._connection.close()
            self._remove(self)


C = TypeVar("C", bound=PolledConnection)


def _spare_descriptor() -> BinaryIO:
    return Path(os.devnull).open("rb")


class ConnectionOwner(Generic[C]):
    """The open connections of one endpoint, which are ended when they are overdue."""

    name: ClassVar[str]

    def __init__(self, poller: Poller) -> None:
        self.poller = poller
        self._clients: set[C] = set()

    def open(self) -> None:
        """Begin to end overdue connections."""
        each_half_second.add(self.close_overdue)

    def close(self) -> None:
        """Close all connections, after their clients have received their answers."""
        each_half_second.remove(self.close_overdue)
        clients = list(self._clients)
        reason = "the replica is stopping; connect again"
        for client in clients:
            client.announce_end(reason, SERVICE_RESTART)

        until = time.monotonic() + ANSWERS_S
        for client in clients:
            client.wait_answered(until)
            client.end(reason, SERVICE_RESTART)
            client.release()

    def close_overdue(self) -> None:
        """Close the connections that are overdue, or whose key is no longer valid; may be called
        on any thread.
        """
        now = time.monotonic()
        refusal = cache(Caller.refusal)  # evaluated once for all connections of a key
        for client in list(self._clients):
            cause = client.overdue(now, refusal)
            if cause is not None:
                reason, code = cause
                client.end(reason, code)

    def remove(self, client: C) -> None:
        """Remove a client whose connection is closed."""
        self._clients.discard(client)

    def serve(self, client: C, connection: socket.socket) -> None:
        """Begin to read a client's connection; called on the polling thread."""
        self.poller.watch(connection, client.ready)
        self._clients.add(client)


class PolledServer(ConnectionOwner[C], ABC):
    """Listens after `open`; the polling thread of the batch queue accepts clients and reads all
    connections.

    Args:
        check_key: Returns the caller that owns a key, or raises an error for an invalid key; or the
            reason why no key is needed.
        listener: A non-blocking socket.
    """

    def __init__(
        self,
        engine: Engine,
        limits: MessageLimits,
        check_key: KeyCheck | NoKey,
        listener: socket.socket,
    ) -> None:
        super().__init__(engine.queue.poller)
        self.engine = engine
        self.limits = limits
        self.check_key = check_key
        self._listener = listener
        self._accepting = TokenBucket(_ACCEPTED_PER_S, time.monotonic())
        self._warnings = TokenBucket(_WARNINGS_PER_S, time.monotonic(), _WARNINGS)
        # Without a free descriptor a client could not even be rejected, and the listener would stay
        # readable.
        self._spare = _spare_descriptor()

    @abstractmethod
    def _add_client(self, connection: socket.socket) -> None:
        """Serve a client with `serve`, or close its connection, which is non-blocking."""

    def open(self) -> None:
        """Accept clients; call this before the engine starts."""
        self.poller.watch(self._listener, self.accept)
        super().open()

    def close(self) -> None:
        """Close the listener and all connections; call this after the engine has ended."""
        self._listener.close()
        self._spare.close()
        super().close()

    def accept(self) -> None:
        """Accept one client; the listener is readable.

        Errors, such as an aborted connection or EMFILE, never stop the listener. Clients above the
        rate of `_ACCEPTED_PER_S` wait in the listener's backlog. Connections that their clients
        have ended do not count: otherwise the ended connections of one client would fill the
        backlog, and delay the connections of other clients by seconds.
        """
        wait_s = self._accepting.take(time.monotonic())
        if wait_s > 0:
            self.poller.unwatch(self._listener)
            self.poller.call_later(wait_s, self._listen_again)
            return

        try:
            connection = accept_open(self._listener)
        except BlockingIOError:  # all waiting clients have ended their connections
            self._accepting.give_back()
            return
        except OSError as error:
            self._accepting.give_back()
            self.warn("a client was not accepted: %s", error)
            if error.errno in (errno.EMFILE, errno.ENFILE):
                self._spare.close()
                with contextlib.suppress(OSError):
                    self._listener.accept()[0].close()
                self._spare = _spare_descriptor()
            return
        if connection is None:
            self._accepting.give_back()
            return

        try:
            connection.setblocking(False)
            self._add_client(connection)
        except Exception:
            logger.exception("a client was not accepted")
            connection.close()

    def warn(self, text: str, *values: object) -> None:
        """Log a warning about a client that was not accepted, unless there were many of them."""
        if self._warnings.take(time.monotonic()) == 0:
            logger.warning(text, *values)

    def _listen_again(self) -> None:
        self.poller.watch(self._listener, self.accept)

    def remove(self, client: C) -> None:
        """Remove a client whose connection is closed, and no longer count the connection for its
        key.
        """
        super().remove(client)
        if isinstance(client.caller, Caller):
            client.caller.hold(-1)


def enable_timestamps(connection: socket.socket) -> None:
    """Let the kernel record when messages arrive, if it supports that for this kind of socket.

    A message may wait in its socket for seconds if the reading thread is busy.
    """
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)


def time_in_socket_s(control: AncillaryData) -> float:
    """Return how long the message with this control data has waited, s; 0 if that is negligible
    or unknown.
    """
    for level, kind, data in control:
        if level == socket.SOL_SOCKET and kind == _TIMESTAMP and len(data) == _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack(data)
            waited: float = time.time() - (seconds + nanoseconds * 1e-9)
            return waited if waited > LEAST_WAIT_S else 0.0
    return 0.0


def accept_open(listener: socket.socket) -> socket.socket | None:
    """Accept the next connection that its client has not ended yet, and close the ended connections
    before it.

    Returns:
        The connection; None if `_ENDED_AT_ONCE` connections had ended.

    Raises:
        OSError: No connection is waiting (`BlockingIOError`, or `TimeoutError` of a listener with a
            time limit), or it cannot be accepted.
    """
    for _ in range(_ENDED_AT_ONCE):
        connection, _address = listener.accept()
        if not has_hung_up(connection):
            return connection
        connection.close()
    return None


def has_unread(connection: socket.socket) -> bool:
    """Return whether the socket has received data that are still unread."""
    waiting = array("i", [0])
    fcntl.ioctl(connection, termios.FIONREAD, waiting)
    return waiting[0] > 0


def wait_delivered(connection: socket.socket, until: float) -> None:
    """Wait until the client's machine has received all that was sent over a TCP connection.

    If bytes of the client are unread, or arrive later, the kernel resets a connection that is
    closed, and discards the answers that it has not yet delivered.

    Args:
        until: Time of `time.monotonic` until which to wait, s. The wait also ends with the
            connection, which the client or another thread may end.
    """
    ended = select.poll()
    with contextlib.suppress(ValueError):  # another thread has closed the connection
        ended.register(connection, 0)  # reports errors and the end of both directions
        while time.monotonic() < until and _has_undelivered(connection):
            if ended.poll(_POLL_MS):
                break


def _has_undelivered(connection: socket.socket) -> bool:
    """Return whether the peer's machine has not acknowledged all bytes that were sent over a TCP
    connection.
    """
    waiting = array("i", [0])
    fcntl.ioctl(connection, termios.TIOCOUTQ, waiting)
    return waiting[0] > 0


def has_hung_up(connection: socket.socket) -> bool:
    """Return whether the peer has closed its end; there may be unread messages.

    May be called on any thread, and while another thread closes the connection.
    """
    poller = select.poll()
    try:
        # The mask is 0, since a full hang-up is always reported.
        poller.register(connection, getattr(select, "POLLRDHUP", 0))
    except ValueError:  # this process has closed the connection
        return True
    return bool(poller.poll(0))
