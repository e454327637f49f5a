"""A TCP connection whose messages arrive in parts: their limits, and the end of the connection.

WebSockets (`websocket_connection`) and HTTP connections (`http_connection`) differ in how a message
begins and ends. This module contains what they have in common: incomplete messages count as
in-flight memory, and have to arrive in time; too many unanswered messages stop the reading; and a
connection that ends discards bytes that still arrive, so that its client can read the reason.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Any

from vlagents_ray.errors import Overloaded, VLAgentsError
from vlagents_ray.protocol.messages import STREAM_BYTES
from vlagents_ray.serve.access.api_keys import Caller
from vlagents_ray.serve.endpoints.connection import (
    BACKLOGGED,
    POLICY_VIOLATION,
    ConnectionOwner,
    PolledConnection,
    ReadBuffer,
    has_unread,
    time_in_socket_s,
    wait_delivered,
)
from vlagents_ray.serve.endpoints.send_buffer import SendBuffer
from vlagents_ray.serve.engine.admission import Admission, ArrivingBytes
from vlagents_ray.serve.token_bucket import TokenBucket

logger = logging.getLogger(__name__)

READ_BYTES = 1024 * 1024  # maximum size of a read; room for a message with two or three raw images
# Maximum number of parts that are read from a connection before other connections are read.
_PARTS_PER_READ = 16
_DISCARD_BYTES = 64 * 1024  # maximum size of a read after the end
# Maximum number of bytes that are discarded after the end, and maximum time, s, in which a client
# must close its connection.
_MOST_DISCARDED_BYTES = 8 * STREAM_BYTES
_CLOSING_S = 5.0
# Maximum rate of discarding, of all connections together: above this rate, a client waits. At full
# speed, 32 connections take a quarter of a core.
_DISCARDED_BYTES_PER_S = 64 * 2**20
_DISCARDING = "too many bytes are discarded"  # a further reason for not polling a connection
# Close codes of WebSockets, which other connections translate to their own errors.
GOING_AWAY, TRY_AGAIN_LATER = 1001, 1013

read_buffer = ReadBuffer(READ_BYTES)
_discarding = TokenBucket(_DISCARDED_BYTES_PER_S, time.monotonic(), capacity=_DISCARD_BYTES)


class MessageConnection(PolledConnection):
    """One TCP connection of a client."""

    late_code = POLICY_VIOLATION  # close code if a message takes too long

    def __init__(
        self,
        owner: ConnectionOwner[Any],
        connection: socket.socket,
        admission: Admission | None,
        *,
        slow_s: float,
        idle_s: float,
        answer_bytes: int = STREAM_BYTES,
    ) -> None:
        """Create a connection, which is read after `owner.serve`.

        Args:
            admission: The in-flight memory of the replica, which includes incomplete messages; None
                without a replica.
            slow_s: Maximum time that a message may take to arrive, s.
            idle_s: Maximum time that the connection may be silent, s.
            answer_bytes: Number of unsent bytes above which a client that reads slowly is cut off.
        """
        super().__init__(owner, connection)
        self._admission = admission
        self._slow_s = slow_s
        self._idle_s = idle_s
        self._is_rated = False  # whether the client's key has a rate that it may exceed

        self._arrived = 0.0  # arrival time of the bytes read last, s
        self._arriving: ArrivingBytes | None = None  # bytes of a partly received message
        self._message_count = 0  # number of messages received so far

        self._out = SendBuffer(
            connection, self._sending, answer_bytes, lambda: self._call_soon(self.disconnect)
        )
        self._unanswered = 0  # number of unanswered messages
        self._unanswered_bytes = 0  # size of the unanswered messages with their decoded images
        self._paused = False  # whether too many messages are unanswered; guarded by the lock

        self._ended_at = float("inf")  # time at which this side has ended the connection, s
        self._discarded = 0  # number of bytes that were discarded after the end

        # Only `overdue` uses the following fields.
        self._count_before = 0  # number of messages at the last call of `overdue`
        self._quiet_since = time.monotonic()  # time of the last message or answer, s
        self._part_since = float("inf")  # arrival time of the current partial message, s
        self._alive_at = time.monotonic()  # time of the last bytes, s

    # Methods that each protocol defines.

    @property
    @abstractmethod
    def _is_over(self) -> bool:
        """Whether one side has ended the connection, so that arriving bytes are discarded."""

    @abstractmethod
    def _bytes_to_read(self) -> int:
        """Return how many bytes to read now; raise `BlockingIOError` if there are none."""

    @abstractmethod
    def _receive_bytes(self, data: bytes | memoryview) -> bool:
        """Process received bytes; empty `data` means that the connection has ended.

        Return whether further bytes may be read now.
        """

    @property
    @abstractmethod
    def _incomplete_bytes(self) -> int:
        """Number of received bytes of an incomplete message."""

    @abstractmethod
    def _is_backlogged(self) -> bool:
        """Return whether the client has too many unanswered messages or bytes; the caller holds
        the lock.
        """

    # Answers.

    @property
    def unsent_bytes(self) -> int:
        """Number of unsent bytes, which do not include the bytes in the kernel's buffer."""
        return self._out.unsent_bytes

    def add_unanswered(self, size: int) -> None:
        """Count a message of `size` bytes with its images as unanswered."""
        with self._sending:
            self._unanswered += 1
            self._unanswered_bytes += size

    def remove_unanswered(self, size: int) -> None:
        """Count a message as answered, and read again if only unanswered messages prevented
        reading; may be called on any thread.
        """
        with self._sending:
            self._unanswered -= 1
            self._unanswered_bytes -= size
            may_resume = self._paused and not self._is_backlogged()
            self._paused = self._paused and not may_resume
        if may_resume:
            self._call_soon(lambda: self._resume(BACKLOGGED))

    def _pause_if_backlogged(self) -> None:
        """Stop reading while too many messages are unanswered."""
        with self._sending:
            paused = self._is_backlogged() and not self._is_over
            self._paused = paused
        if paused:
            self._pause(BACKLOGGED)

    # Reading.

    def _read(self) -> None:
        parts = 0
        while self._read_part() and parts < _PARTS_PER_READ:
            parts += 1

    def _read_part(self) -> bool:
        """Read a part of a message; return whether further bytes may be read now."""
        if self._is_rated and self._throttle():
            return False

        data: bytes | memoryview
        is_over = self._is_over
        try:
            size = _DISCARD_BYTES if is_over else self._bytes_to_read()
            data, control = read_buffer.receive(self._connection, size)
            waited_s = time_in_socket_s(control)
            self._arrived = time.perf_counter() - waited_s
        except BlockingIOError:
            return False
        except OSError as error:
            logger.info("%s client: %s", self._name, error)
            data = b""

        self._alive_at = time.monotonic()
        if is_over:
            self._discard_bytes(len(data))
            return False
        return self._receive_bytes(data)

    def _discard_bytes(self, count: int) -> None:
        """Discard bytes that were read after the end: unread bytes would reset the connection
        before the client reads the reason.

        No bytes mean that the client has closed the connection.
        """
        self._discarded += count
        if not count or self._discarded > _MOST_DISCARDED_BYTES:
            self.disconnect()
            return
        wait_s = _discarding.take(time.monotonic(), count)
        if wait_s > 0:
            self._pause(_DISCARDING)
            self._call_later(wait_s, lambda: self._resume(_DISCARDING))

    def count_bytes(self) -> ArrivingBytes | None:
        """Return a counter of bytes that wait in this connection, as part of the in-flight memory;
        None without a replica. The connection is ended if a complete message needs the memory.
        """
        if self._admission is None:
            return None
        caller = self.caller if isinstance(self.caller, Caller) else None
        is_robot = caller is None or caller.priority != "simulation"
        key = None if caller is None else caller.name
        return ArrivingBytes(self._admission, key, is_robot, self._give_up)

    def _count_incomplete(self) -> None:
        """Count the bytes of an incomplete message as they arrive; end the connection if there is
        no room for them.
        """
        try:
            if self._arriving is None:
                self._arriving = self.count_bytes()
            if self._arriving is not None:
                self._arriving.resize(self._incomplete_bytes)
        except VLAgentsError as error:
            self._end_for(error)

    def _end_for(self, error: VLAgentsError) -> None:
        """End the connection because of an error in an incomplete message."""
        code = TRY_AGAIN_LATER if isinstance(error, Overloaded) else POLICY_VIOLATION
        self.end(str(error), code)

    def _give_up(self) -> None:
        """End the connection, since a complete message needs the memory; called on any thread."""
        reason = "a complete message needs the memory"
        self._call_soon(lambda: self.end(reason, TRY_AGAIN_LATER))

    def _release_arriving(self) -> None:
        """Stop counting the bytes of an incomplete message."""
        if self._arriving is not None:
            self._arriving.release()

    # The end.

    def overdue(
        self, now: float, refusal: Callable[[Caller], str | None]
    ) -> tuple[str, int] | None:
        """Return a reason and a close code if the connection is too slow or has to end; see
        `PolledConnection`.

        A connection that this side has closed is cut off if its client leaves it open.

        Time counts against the client only if the server has read all bytes that arrived: a slow
        policy keeps the thread from reading.
        """
        if self._is_over:
            if now - self._ended_at > _CLOSING_S:
                self._cut_off()
            return None
        cause = super().overdue(now, refusal)
        if cause is not None:
            return cause

        if self._message_count != self._count_before or self._unanswered or not self._polled:
            self._count_before = self._message_count
            self._quiet_since = now
            self._part_since = float("inf")
        if not self._incomplete_bytes:
            self._part_since = float("inf")
        elif self._part_since > now:
            self._part_since = now

        cause = self._slow_cause(now)
        with self._sending:
            if cause is not None and not self._ended and has_unread(self._connection):
                self._quiet_since = self._alive_at = now
                self._part_since = float("inf")
                return None
        return cause

    def _slow_cause(self, now: float) -> tuple[str, int] | None:
        """Return a reason and a close code if the client is too slow at `now`, s."""
        if now - self._part_since > self._slow_s:
            return f"a message took longer than {self._slow_s:g} s", self.late_code
        if now - self._quiet_since > self._idle_s:
            return "silent for too long", GOING_AWAY
        return None

    @property
    def _is_closed_here(self) -> bool:
        """Whether this side has ended the connection first."""
        return self._ended_at != float("inf")

    def silent_s(self, now: float) -> float:
        """Return how long the client has sent no message at `now`, s, of `time.monotonic`; 0 while
        messages are unanswered.
        """
        return now - self._quiet_since

    def end(self, reason: str, code: int = POLICY_VIOLATION) -> None:
        """Send the reason after the answers; may be called on any thread.

        Bytes that still arrive are discarded until the client closes the connection, at most for
        `_CLOSING_S`, so that it can read the reason although it is still sending.
        """
        logger.info("%s: a connection is closed: %s", self._name, reason)
        self.announce_end(reason, code)
        self._call_soon(self._end_sessions)

    def _discard(self) -> None:
        self._release_arriving()
        self._out.close()

    def _cut_off(self) -> None:
        """End both directions of the connection, so that the polling thread reads its end."""
        with self._sending:
            if not self._ended:
                with contextlib.suppress(OSError):  # the client has already closed the connection
                    self._connection.shutdown(socket.SHUT_RDWR)
        self._call_soon(self.disconnect)

    def wait_answered(self, until: float) -> None:
        self._out.wait_sent(until)
        wait_delivered(self._connection, until)
