"""The door for processes on the same machine: frames in shared memory, a Unix socket for the wake-ups.

A client connects to an abstract Unix socket whose unguessable name stands in the metadata, and hands
over memory files that it writes its frames into. Neither side leaves a name behind, so that memory
and socket are gone with their processes, however those end. Only processes of the same user are let
in. The policy's own thread reads the sockets: a request reaches it without a change of threads; while
a batch runs that takes milliseconds, another thread reads them for it (`vlagents_ray.serve.ears`).
"""

from __future__ import annotations

import contextlib
import fcntl
import logging
import mmap
import os
import secrets
import socket
import struct
import threading
from collections.abc import Callable
from typing import ClassVar

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire.frames import decode_requests, encode_replies
from vlagents_ray.wire.messages import Limits, LocalAddress, Reply, boot_id

logger = logging.getLogger(__name__)

_FILES = 8  # memory files of one client; it needs more than one only after deadlines passed
_INLINE = 64 * 1024  # a longer reply travels in a memory file
_BACKLOG = 128


class LocalDoor:
    """Listens from `open` on; everything else happens where the batch queue hears."""

    def __init__(self, engine: Engine, limits: Limits) -> None:
        self._engine = engine
        self._limits = limits
        self._clients: set[LocalClient] = set()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self.address = LocalAddress(f"vlagents-ray-{secrets.token_hex(16)}", boot_id())

    def open(self) -> None:
        """Start to listen; before the engine starts."""
        self.listen()
        self._engine.queue.watch(self._listener, self._accept)

    def listen(self) -> None:
        """Give the socket its name."""
        self._listener.bind(f"\0{self.address.socket}")
        self._listener.listen(_BACKLOG)

    def close(self) -> None:
        """Hang up; after the engine has ended."""
        self._listener.close()
        for client in list(self._clients):
            client.release()

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        if peer_uid(connection) != os.getuid():
            logger.warning("a process of another user tried the local door")
            connection.close()
            return
        if len(self._clients) >= self._engine.sessions.limit:
            full = PolicyUnavailable(f"this replica has {len(self._clients)} local clients, its limit of sessions")
            connection.send(LocalAddress.REPLY.pack(0, 0) + encode_replies([Reply(error=full)]))
            connection.close()
            return
        client = self.client(connection)
        self._clients.add(client)
        self._engine.queue.watch(connection, client.ready)

    def client(self, connection: socket.socket) -> LocalClient:
        """What serves a connection that was let in."""
        return LocalClient(connection, self._engine, self._limits, self._clients.discard)


class LocalClient:
    """One connection, with which its sessions end. Where its frames lie is up to `locate`, `frame` and `forget`."""

    name: ClassVar[str] = "shm"
    message: ClassVar[struct.Struct] = LocalAddress.REQUEST

    def __init__(
        self, connection: socket.socket, engine: Engine, limits: Limits, gone: Callable[[LocalClient], None]
    ) -> None:
        self._connection = connection
        self._engine = engine
        self._limits = limits
        self._gone = gone
        self._files: dict[int, mmap.mmap] = {}
        self._sender = Sender(engine, self.name)
        self._sending = threading.Lock()  # the end may be heard beside a batch, whose replies still come
        self._ended = False

    def ready(self) -> None:
        """A message, or the end of the connection, is there."""
        visit = Visit(self._engine.stats, self.name)
        try:
            message, descriptors, _, _ = socket.recv_fds(self._connection, self.message.size, 1)
        except BlockingIOError:
            return
        except OSError as error:
            logger.info("local client: %s", error)
            message, descriptors = b"", []
        if not message:
            self._engine.queue.unwatch(self._connection)
            self.release()
            return
        number = 0
        try:
            if len(message) != self.message.size:
                raise MalformedMessage(f"local: got {len(message)} bytes, want {self.message.size}")
            number, length = self.locate(message)
            if descriptors:
                self._add(number, descriptors.pop())
            requests = decode_requests(self.frame(number, length), self._limits)
            visit.decoded(requests)
            self._sender.send(requests, lambda replies: self._send(number, visit.frame(replies)))
        except VLAgentsError as error:
            self._send(number, visit.frame([Reply(error=error)]))
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def release(self) -> None:
        """Forget the session and give its memory back."""
        self._sender.release()
        with self._sending:
            self._ended = True  # its descriptor's number may soon be another file's
            self._connection.close()
        self.forget()
        self._gone(self)

    def locate(self, message: bytes) -> tuple[int, int]:
        """Number of the memory that holds the frame, and the frame's length in bytes."""
        number, length = self.message.unpack(message)
        return number, length

    def frame(self, number: int, length: int) -> bytes:
        """A copy: the policy may keep what the client soon overwrites."""
        memory = self._files.get(number)
        if memory is None or length > len(memory):
            raise MalformedMessage(f"local: {length} bytes in memory file {number}, which is not there or shorter")
        return memory[:length]

    def forget(self) -> None:
        """Give the connection's memory back."""
        for memory in self._files.values():
            memory.close()
        self._files.clear()

    def _add(self, number: int, descriptor: int) -> None:
        try:
            size = os.fstat(descriptor).st_size
            if size > 2 * self._limits.body_bytes or (len(self._files) >= _FILES and number not in self._files):
                raise MessageTooLarge(f"local: a memory file of {size} bytes, {len(self._files)} others are mapped")
            # A file that could shrink would kill this process when it is read.
            if not fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
                raise MalformedMessage("local: the memory file is not sealed against shrinking")
            mapped = mmap.mmap(descriptor, size, prot=mmap.PROT_READ)
        except (OSError, ValueError) as error:
            if isinstance(error, VLAgentsError):
                raise
            raise MalformedMessage(f"local: not a memory file ({error})") from error
        finally:
            os.close(descriptor)
        if (old := self._files.pop(number, None)) is not None:
            old.close()
        self._files[number] = mapped

    def _send(self, number: int, frame: bytes) -> None:
        with self._sending:
            if self._ended:
                return
            try:
                if len(frame) <= _INLINE:
                    self._connection.send(LocalAddress.REPLY.pack(number, 0) + frame)
                    return
                descriptor = os.memfd_create("vlagents-ray-reply")
                try:
                    os.write(descriptor, frame)
                    header = LocalAddress.REPLY.pack(number, LocalAddress.IN_FILE)
                    socket.send_fds(self._connection, [header], [descriptor])
                finally:
                    os.close(descriptor)
            except OSError as error:  # gone, or does not read its replies: hearing of the end is up to `ready`
                logger.info("local client: %s", error)
                with contextlib.suppress(OSError):  # gone altogether
                    self._connection.shutdown(socket.SHUT_RDWR)


def peer_uid(connection: socket.socket) -> int:
    """The user of the process at the other end of a Unix socket, as the kernel knows it."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    uid: int = struct.unpack("3i", credentials)[1]
    return uid
