"""Requests from processes on this machine: messages on Unix sockets that locate the observations in shared memory.

A `Payload` reads that memory: the client's memory files (`vlagents_ray.serve.endpoints.shm`), or channels in the
node's object store (`vlagents_ray.serve.endpoints.plasma`). The policy thread reads the sockets itself, so that a
request needs no change of threads; while a batch runs for milliseconds, another thread reads them
(`vlagents_ray.serve.queue.poller`). Only processes of the same user may connect. Sessions end with their connection.
"""

from __future__ import annotations

import contextlib
import logging
import os
import select
import socket
import struct
import threading
import time
from abc import ABC, abstractmethod
from array import array
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import ClassVar, Protocol

import numpy as np

from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.protocol import shm_layout
from vlagents_ray.protocol.frames import Decoded, decode_requests, encode_replies
from vlagents_ray.protocol.messages import OPS, Limits, LocalAddress, Op, Reply, peer_uid
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey
from vlagents_ray.serve.endpoints.acceptor import Acceptor
from vlagents_ray.serve.engine import arrival
from vlagents_ray.serve.engine.admission import NeedsDecodingThread, decode_in_background
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import REFUSED, Sender
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.requests import Message

logger = logging.getLogger(__name__)

_MESSAGE_BYTES = 256 * 1024
_CONTROL = socket.CMSG_SPACE(struct.calcsize("i")) + arrival.SPACE  # room for one descriptor and the time stamp
_INLINE = 64 * 1024  # a longer reply travels in a memory file
BACKLOG = 128
_KEY_S = 5.0  # time within which a client must send its key
_KEY_BYTES = 4096  # maximum size of a key

Admit = Callable[[str | None], Caller]  # returns the caller with that key; raises `Unauthorized` or `Forbidden`


class Payload(Protocol):
    """The memory outside of the messages that holds the requests of one connection."""

    def read(self, message: memoryview, descriptors: list[int]) -> tuple[np.ndarray, bool, memoryview]:
        """Return the memory of a message, whether that is in compact form, and the message's text for that form.

        Removes the descriptors that it uses from `descriptors`.
        """
        ...

    def freed(self) -> int:
        """Return a bit field; bit n means that the client may reuse its memory n, which no reply has stated yet."""
        ...

    def free(self) -> None:
        """Free the memory of a connection that has ended."""
        ...


class UnixServer(ABC):
    """Listens from `open` on; all reading happens on the thread that polls for the batch queue."""

    name: ClassVar[str]

    def __init__(
        self,
        engine: Engine,
        admit: Admit | NoKey,
        limits: Limits,
        payload: Callable[[], Payload],
        ops: Sequence[Op] = OPS,
    ) -> None:
        """`admit` returns the caller with a key or raises; `payload` creates the payload of a connection.

        Requests of other operations than `ops` are refused.
        """
        self.engine = engine
        self.admit = admit
        self.limits = limits
        self.payload = payload
        self.ops = ops
        self._clients: set[UnixConnection] = set()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self._acceptor = Acceptor(self._listener, self._add_client)

    @abstractmethod
    def listen(self) -> None:
        """Bind the socket to its name and listen."""

    def open(self) -> None:
        """Start to listen; call it before the engine starts."""
        self.listen()
        self.engine.queue.watch(self._listener, self._acceptor.accept)
        if not isinstance(self.admit, NoKey):
            each_half_second.add(self.close_overdue)

    def close(self) -> None:
        """Close the listener and all connections; call it after the engine has ended."""
        each_half_second.remove(self.close_overdue)
        self._listener.close()
        self._acceptor.close()
        for client in list(self._clients):
            client.release()

    def _add_client(self, connection: socket.socket) -> None:
        if peer_uid(connection) != os.getuid():
            logger.warning("a process of another user tried to connect")
            connection.close()
            return
        if len(self._clients) >= self.engine.sessions.limit:
            full = PolicyUnavailable(f"this replica has {len(self._clients)} local clients, its limit of sessions")
            with contextlib.suppress(OSError):  # the client is gone already
                connection.send(LocalAddress.REPLY.pack(0, 0) + encode_replies([Reply(error=full)]))
            connection.close()
            return
        client = UnixConnection(self, connection)
        self._clients.add(client)
        self.engine.queue.watch(connection, client.ready)

    def remove(self, client: UnixConnection) -> None:
        """Remove a client whose connection has ended."""
        self._clients.discard(client)

    def close_overdue(self) -> None:
        """Close the connections whose key is no longer valid or was never sent; works on any thread."""
        now = time.monotonic()
        refusal = cache(Caller.refusal)  # evaluated once for all connections of a key
        for client in list(self._clients):
            if (reason := client.overdue(now, refusal)) is not None:
                client.end(reason)


class UnixConnection:
    """One connection of a client; its sessions end with it."""

    def __init__(self, server: UnixServer, connection: socket.socket) -> None:
        self._server = server
        self._engine = server.engine
        self._payload = server.payload()
        arrival.enable_timestamps(connection)
        self._connection = connection
        self._reader = shm_layout.ShmReader(server.limits)
        self._connected_at = time.monotonic()
        self.caller: Identity | None = None  # None until the client has sent its key
        self._key: bytes | None = None  # the key as sent
        self._sender: Sender | None = None
        if isinstance(server.admit, NoKey):
            self.caller = server.admit
            self._sender = Sender(server.engine, server.name, caller=server.admit)
        self._sending = threading.Lock()  # the connection may end during a batch, whose replies are still to be sent
        self._ended = False
        self._pauses = 0  # number of reasons not to poll it: a frame is decoded elsewhere, the key is over its rate

    def ready(self) -> None:
        """Read the connection, which has a message or has ended."""
        try:
            self._read()
        except Exception:
            logger.exception("local client: disconnected after an error")
            self._disconnect()

    def _read(self) -> None:
        if self._sender is not None and self._sender.rated and self._is_throttled():
            return
        message = Message(self._engine.stats, self._server.name)
        buffer = _buffers.bytes
        try:
            size, control, _, _ = self._connection.recvmsg_into([buffer], _CONTROL)
        except BlockingIOError:
            return
        except OSError as error:
            logger.info("local client: %s", error)
            size, control = 0, []
        descriptors = [
            number
            for _, kind, data in control
            if kind == socket.SCM_RIGHTS
            for number in array("i", data[: len(data) // 4 * 4])
        ]
        try:
            if not size:
                self._disconnect()
                return
            sender = self._sender or self._authenticate(bytes(buffer[: min(size, _KEY_BYTES)]))
            if sender is not None:
                self._receive(sender, message, arrival.waited_s(control), memoryview(buffer)[:size], descriptors)
        except VLAgentsError as error:
            message.refuse(error)
            self._answer(message)
            if self._sender is not None and self._sender.refused_too_often:
                self.end(REFUSED)
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        if self._sender is not None and self._sender.rated:
            self._is_throttled()

    def _receive(
        self, sender: Sender, message: Message, waited_s: float, data: memoryview, descriptors: list[int]
    ) -> None:
        try:  # only locates the memory; a new memory file of the client is taken even if the message is refused
            memory, compact_form, text = self._payload.read(data, descriptors)
        except VLAgentsError:
            sender.count_message()
            raise
        if not compact_form:
            self._decode(sender, message, waited_s, memory)
            return
        if sender.rated:
            sender.count_message()
        decoded = Decoded(self._reader.read(text, memory), {})
        message.decoded(decoded)
        sender.send(message, decoded, self._answer, waited_s=waited_s)

    def _is_throttled(self) -> bool:
        """Whether the key of the client is over its rate; if so, the connection is read again later."""
        if self._ended or self._sender is None or (wait_s := self._sender.throttled_s()) <= 0:
            return False
        self._pause()
        self._engine.queue.call_later(wait_s, self._unthrottle)
        return True

    def _unthrottle(self) -> None:
        """Read the connection again, unless the client is gone or another one with its key was over the rate since."""
        if self._ended:
            return
        if _has_hung_up(self._connection):  # to decode the messages that it left would delay others
            self._disconnect()
            return
        self._is_throttled()
        self._resume()

    def _decode(self, sender: Sender, message: Message, waited_s: float, frame: np.ndarray) -> None:
        """Decode the requests of a frame, in another thread if that is slow, and send them to the engine."""
        admission = sender.admission(self._server.limits)
        read = partial(decode_requests, frame.data, ops=self._server.ops)

        def send(decoded: Decoded, waited_s: float) -> None:
            message.decoded(decoded)
            sender.send(message, decoded, self._answer, admission=admission, waited_s=waited_s)

        def on_decoded(result: Callable[[], Decoded]) -> None:
            try:
                if not self._ended:
                    send(result(), waited_s + time.perf_counter() - message.arrived)
            except VLAgentsError as error:
                message.refuse(error)
                self._answer(message)
            except Exception:
                logger.exception("local client: disconnected after an error")
                self._disconnect()
            self._resume()

        try:
            decoded = read(admission)
        except NeedsDecodingThread:
            self._pause()
            decode_in_background(self._engine.queue, admission, read, on_decoded)
        else:
            send(decoded, waited_s)

    def _pause(self) -> None:
        """Stop polling the client until `_resume` was called as many times."""
        self._pauses += 1
        if self._pauses == 1:
            self._engine.queue.unwatch(self._connection)

    def _resume(self) -> None:
        self._pauses -= 1
        if not self._pauses and not self._ended:
            self._engine.queue.watch(self._connection, self.ready)

    def _authenticate(self, message: bytes) -> Sender | None:
        """Take the first message for the client's key; if that is refused, each later message tries that key again."""
        if isinstance(self._server.admit, NoKey):
            raise TypeError(f"a key, although none is asked for: {self._server.admit.value}")
        first, self._key = self._key is None, self._key or message
        caller = self._server.admit(self._key.decode(errors="replace"))
        caller.hold()
        caller.note("let in by", self._server.name)
        self.caller, self._sender = caller, Sender(self._engine, self._server.name, caller=caller)
        return None if first else self._sender

    def overdue(self, now: float, refusal: Callable[[Caller], str | None]) -> str | None:
        """Return the reason if the connection has to end; `refusal` returns the reason if a key is no longer valid."""
        if isinstance(self.caller, Caller):
            return refusal(self.caller)
        with self._sending:
            late = self._sender is None and now - self._connected_at > _KEY_S
            return "no key" if late and not self._ended and not arrival.has_unread(self._connection) else None

    def end(self, reason: str) -> None:
        """Close the connection from any thread, even while the policy runs."""
        logger.info("a local client is cut off: %s", reason)
        with self._sending:
            if not self._ended:
                with contextlib.suppress(OSError):  # the client closed it already
                    self._connection.shutdown(socket.SHUT_RDWR)

    def _disconnect(self) -> None:
        if not self._ended:
            if not self._pauses:
                self._engine.queue.unwatch(self._connection)
            self.release()

    def release(self) -> None:
        """End the sessions, close the connection and free its memory."""
        if self._sender is not None:
            self._sender.release()
        with self._sending:
            self._ended = True  # the number of its descriptor may soon be reused
            self._connection.close()
        self._payload.free()
        self._server.remove(self)
        if isinstance(self.caller, Caller):
            self.caller.hold(-1)

    def _answer(self, message: Message) -> None:
        self._send(*message.packed())
        message.record()

    def _send(self, frame: bytes, compact_form: bool) -> None:
        flags = LocalAddress.COMPACT if compact_form else 0
        with self._sending:
            if self._ended:
                return
            freed = self._payload.freed()
            try:
                if len(frame) <= _INLINE:
                    self._connection.send(LocalAddress.REPLY.pack(freed, flags) + frame)
                    return
                descriptor = os.memfd_create("vlagents-ray-reply")
                try:
                    os.write(descriptor, frame)
                    header = LocalAddress.REPLY.pack(freed, flags | LocalAddress.IN_FILE)
                    socket.send_fds(self._connection, [header], [descriptor])
                finally:
                    os.close(descriptor)
            except OSError as error:  # the client is gone, or does not read its replies: `ready` handles the end
                logger.info("local client: %s", error)
                with contextlib.suppress(OSError):  # the connection is closed already
                    self._connection.shutdown(socket.SHUT_RDWR)


def _has_hung_up(connection: socket.socket) -> bool:
    """Return whether the peer has closed its end; messages may be unread."""
    poller = select.poll()
    poller.register(connection, 0)  # reports a hang-up in any case
    return bool(poller.poll(0))


class _Buffers(threading.local):
    """One buffer per thread for the message that is being read, which is processed before the next one is read."""

    def __init__(self) -> None:
        self.bytes = bytearray(_MESSAGE_BYTES)


_buffers = _Buffers()
