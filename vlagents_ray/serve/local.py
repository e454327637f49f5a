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
import weakref
from array import array
from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.auth import Caller
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.porter import Porter
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire import compact, cores
from vlagents_ray.wire.frames import decode_requests, encode_replies
from vlagents_ray.wire.messages import OPS, Limits, LocalAddress, Op, Reply, Request, boot_id

logger = logging.getLogger(__name__)

_KEPT = 8  # of them that a policy may keep
_MESSAGE_BYTES = 256 * 1024
_CONTROL = socket.CMSG_SPACE(struct.calcsize("i"))  # for one descriptor
_INLINE = 64 * 1024  # a longer reply travels in a memory file
_BACKLOG = 128

Admit = Callable[[str | None], "Caller | None"]  # who holds that key; `Unauthorized`, `Forbidden`


class LocalDoor:
    """Listens from `open` on; everything else happens where the batch queue hears."""

    def __init__(self, engine: Engine, limits: Limits, admit: Admit | None = None, ops: Sequence[Op] = OPS) -> None:
        """`admit`, where there are keys, says whose a client's is, or raises that it is none. `ops` are let in."""
        self._engine = engine
        self._limits = limits
        self._admit = admit
        self._ops = ops
        self._clients: set[LocalClient] = set()
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self._porter = Porter(self._listener, self._welcome)
        self.address = LocalAddress(f"vlagents-ray-{secrets.token_hex(16)}", boot_id(), keyed=admit is not None)

    def open(self) -> None:
        """Start to listen; before the engine starts."""
        self.listen()
        self._engine.queue.watch(self._listener, self._porter.accept)

    def listen(self) -> None:
        """Give the socket its name."""
        self._listener.bind(f"\0{self.address.socket}")
        self._listener.listen(_BACKLOG)

    def close(self) -> None:
        """Hang up; after the engine has ended."""
        self._listener.close()
        self._porter.close()
        for client in list(self._clients):
            client.release()

    def _welcome(self, connection: socket.socket) -> None:
        if peer_uid(connection) != os.getuid():
            logger.warning("a process of another user tried the local door")
            connection.close()
            return
        if len(self._clients) >= self._engine.sessions.limit:
            full = PolicyUnavailable(f"this replica has {len(self._clients)} local clients, its limit of sessions")
            with contextlib.suppress(OSError):  # gone already
                connection.send(LocalAddress.REPLY.pack(0, 0, -1) + encode_replies([Reply(error=full)]))
            connection.close()
            return
        client = self.client(connection)
        self._clients.add(client)
        self._engine.queue.watch(connection, client.ready)

    def client(self, connection: socket.socket) -> LocalClient:
        """What serves a connection that was let in."""
        return LocalClient(connection, self._engine, self._limits, self._clients.discard, self._admit, self._ops)


class LocalClient:
    """One connection, with which its sessions end. Where its requests lie is up to `read` and `forget`."""

    name: ClassVar[str] = "shm"

    def __init__(
        self,
        connection: socket.socket,
        engine: Engine,
        limits: Limits,
        gone: Callable[[LocalClient], None],
        admit: Admit | None = None,
        ops: Sequence[Op] = OPS,
    ) -> None:
        self._ops = ops
        self._connection = connection
        self._engine = engine
        self._limits = limits
        self._gone = gone
        self._files: dict[int, mmap.mmap] = {}
        self._kept: dict[int, weakref.ref[np.ndarray]] = {}  # what views each file, and if only to be collected
        self._freed: set[int] = set()  # of which the client has yet to be told
        self._acts = compact.Reader(limits)
        self._admit = admit  # until the client has shown its key
        self._sender = Sender(engine, self.name)
        self._sending = threading.Lock()  # the end may be heard beside a batch, whose replies still come
        self._ended = False

    def ready(self) -> None:
        """A message, or the end of the connection, is there."""
        try:
            self._listen()
        except Exception:
            logger.exception("local client: hung up on it")
            self._hang_up()

    def _listen(self) -> None:
        visit = Visit(self._engine.stats, self.name)
        buffer = _buffers.bytes
        try:
            size, control, _, _ = self._connection.recvmsg_into([buffer], _CONTROL)
        except BlockingIOError:
            return
        except OSError as error:
            logger.info("local client: %s", error)
            size, control = 0, []
        descriptors: list[int] = []
        for _, _, data in control:
            descriptors += array("i", data[: len(data) // 4 * 4])
        try:
            if not size:
                self._hang_up()
                return
            if self._admit is not None:
                self._show(self._admit, bytes(buffer[:size]))
                return
            requests = self.read(memoryview(buffer)[:size], descriptors)
            visit.decoded(requests)
            self._sender.send(requests, lambda replies: self._answer(visit, replies))
        except VLAgentsError as error:
            self._answer(visit, [Reply(error=error)])
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

    def _show(self, admit: Admit, key: bytes) -> None:
        """The client's first message. Without a right key there, all others are taken for a key, and refused."""
        self._sender = Sender(self._engine, self.name, caller=admit(key.decode(errors="replace")))
        self._admit = None

    def _hang_up(self) -> None:
        if not self._ended:
            self._engine.queue.unwatch(self._connection)
            self.release()

    def release(self) -> None:
        """Forget the sessions and give their memory back."""
        self._sender.release()
        with self._sending:
            self._ended = True  # its descriptor's number may soon be another file's
            self._connection.close()
        self.forget()
        self._gone(self)

    def read(self, message: memoryview, descriptors: list[int]) -> Sequence[Request | Reply]:
        """The requests of a message, whose arrays view the client's memory. Takes the descriptors it needs."""
        if len(message) < LocalAddress.REQUEST.size:
            raise MalformedMessage(f"local: got {len(message)} bytes, want at least {LocalAddress.REQUEST.size}")
        number, flags, length = LocalAddress.REQUEST.unpack_from(message)
        if descriptors:
            self._add(number, descriptors.pop(0))
        memory = self._memory(number, length)
        if flags & LocalAddress.COMPACT:
            return self._acts.read(message[LocalAddress.REQUEST.size :], memory)
        return decode_requests(memory.data, self._limits, self._ops)

    def forget(self) -> None:
        """Give the connection's memory back; what a policy keeps of it goes when the policy lets go."""
        self._files.clear()

    def _memory(self, number: int, length: int) -> np.ndarray:
        """The client's memory in place, which it leaves alone until nobody views it any more and it is told so.

        Of a policy that keeps much of what it sees, a copy.
        """
        file = self._files.get(number)
        if file is None or length > len(file):
            raise MalformedMessage(f"local: {length} bytes in memory file {number}, which is not there or shorter")
        memory = np.frombuffer(file, np.uint8, length)
        if len(self._kept) >= _KEPT:
            self._freed.add(number)
            memory = memory.copy()
            memory.flags.writeable = False
            return memory
        self._kept[number] = weakref.ref(memory, lambda _: self._let_go(number))
        return memory

    def _let_go(self, number: int) -> None:
        self._kept.pop(number, None)
        self._freed.add(number)

    def _add(self, number: int, descriptor: int) -> None:
        try:
            size = os.fstat(descriptor).st_size
            if size > 2 * self._limits.body_bytes or number >= LocalAddress.FILES:
                raise MessageTooLarge(
                    f"local: memory file {number} of {size} bytes; {LocalAddress.FILES} files are the limit"
                )
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
        self._files[number] = mapped

    def _answer(self, visit: Visit, replies: list[Reply]) -> None:
        frame, compact_form = visit.packed(replies)
        self._send(frame, compact_form)
        visit.record(replies)

    def _send(self, frame: bytes, compact_form: bool) -> None:
        flags = LocalAddress.COMPACT if compact_form else 0
        with self._sending:
            if self._ended:
                return
            freed = 0
            while self._freed:
                freed |= 1 << self._freed.pop()
            try:
                if len(frame) <= _INLINE:
                    self._connection.send(LocalAddress.REPLY.pack(freed, flags, cores.here()) + frame)
                    return
                descriptor = os.memfd_create("vlagents-ray-reply")
                try:
                    os.write(descriptor, frame)
                    header = LocalAddress.REPLY.pack(freed, flags | LocalAddress.IN_FILE, -1)
                    socket.send_fds(self._connection, [header], [descriptor])
                finally:
                    os.close(descriptor)
            except OSError as error:  # gone, or does not read its replies: hearing of the end is up to `ready`
                logger.info("local client: %s", error)
                with contextlib.suppress(OSError):  # gone altogether
                    self._connection.shutdown(socket.SHUT_RDWR)


class _Buffers(threading.local):
    """For the message that is being read, one a thread: it is read to its end before the next one."""

    def __init__(self) -> None:
        self.bytes = bytearray(_MESSAGE_BYTES)


_buffers = _Buffers()


def peer_uid(connection: socket.socket) -> int:
    """The user of the process at the other end of a Unix socket, as the kernel knows it."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    uid: int = struct.unpack("3i", credentials)[1]
    return uid
