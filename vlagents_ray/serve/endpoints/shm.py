"""The endpoints for processes on the same machine: messages on Unix sockets that locate
observations in shared memory.

A `Payload` reads that memory: the client's memory files, or channels in the node's object store
(`vlagents_ray.serve.endpoints.plasma`). For memory files, a client connects to an abstract socket
whose unguessable name is in the metadata, and passes descriptors of the files that contain its
frames. Neither side creates a file name, so the memory and the socket are freed when their
processes end for any reason. Only processes of the same user may connect.
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
import time
import weakref
from array import array
from collections.abc import Callable, Sequence
from functools import partial
from typing import ClassVar, Protocol

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, PolicyUnavailable, VLAgentsError
from vlagents_ray.protocol import compact
from vlagents_ray.protocol.frames import Decoded, decode_requests, encode_replies
from vlagents_ray.protocol.messages import (
    OPS,
    LocalAddress,
    MessageLimits,
    Op,
    Reply,
    boot_id,
    peer_process,
)
from vlagents_ray.protocol.websocket_frames import CONTROL_FRAMES, CONTROL_FRAMES_PER_S
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey
from vlagents_ray.serve.access.charges import REFUSALS, REFUSED
from vlagents_ray.serve.endpoints import answers
from vlagents_ray.serve.endpoints.connection import (
    BACKLOG,
    BACKLOGGED,
    DECODING,
    MALFORMED,
    MOST_UNANSWERED,
    POLICY_VIOLATION,
    STAMP_SPACE,
    AncillaryData,
    KeyCheck,
    PolledConnection,
    PolledServer,
    ReadBuffer,
    enable_timestamps,
    has_unread,
    time_in_socket_s,
)
from vlagents_ray.serve.engine.admission import Admission, MessageAdmission
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender, message_admission
from vlagents_ray.serve.requests import IncomingMessage
from vlagents_ray.serve.token_bucket import TokenBucket

logger = logging.getLogger(__name__)

_MESSAGE_BYTES = 256 * 1024
# Room for one descriptor and the time stamp.
_CONTROL = socket.CMSG_SPACE(struct.calcsize("i")) + STAMP_SPACE
_INLINE = 64 * 1024  # a longer reply is sent in a memory file
_KEY_S = 5.0  # time within which a client must send its key
_KEY_BYTES = 4096  # maximum size of a key
# A request is copied if the policy already holds views of this many memory files.
_MAX_VIEWS = 8

# Each message is processed before the next message is read.
_read_buffer = ReadBuffer(_MESSAGE_BYTES)


class Payload(Protocol):
    """The memory outside of the messages that contains the requests of one connection."""

    def read(
        self, message: memoryview, descriptors: list[int]
    ) -> tuple[np.ndarray, bool, memoryview]:
        """Return the memory of a message, whether it is in compact form, and the text for that
        form.

        The descriptors in use are removed from `descriptors`.
        """

    def freed(self) -> int:
        """Return a bit field: bit n is set if memory n is free for the client and no reply has
        reported that.
        """

    def free(self) -> None:
        """Free the memory of a closed connection."""


class UnixServer(PolledServer["UnixConnection"]):
    """Accepts processes of the same user at a Unix socket."""

    def __init__(
        self,
        engine: Engine,
        check_key: KeyCheck | NoKey,
        limits: MessageLimits,
        payload: Callable[[], Payload],
        ops: Sequence[Op] = OPS,
    ) -> None:
        """Create the server; `payload` creates the payload of a connection, and `ops` are the
        accepted operations.
        """
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        super().__init__(engine, limits, check_key, listener)
        self.payload = payload
        self.ops = ops

    def _add_client(self, connection: socket.socket) -> None:
        pid, uid = peer_process(connection)
        if uid != os.getuid():
            self.warn(
                "rejected the process %d of user %d, since this server accepts only processes of "
                "its own user",
                pid,
                uid,
            )
            connection.close()
            return

        if len(self._clients) >= self.engine.sessions.limit:
            full = PolicyUnavailable(
                f"this replica has {len(self._clients)} local clients, its limit of sessions"
            )
            with contextlib.suppress(OSError):  # the client is already gone
                connection.send(LocalAddress.REPLY.pack(0, 0) + encode_replies([Reply(error=full)]))
            connection.close()
            return

        self.serve(UnixConnection(self, connection), connection)


def _descriptors_in(control: AncillaryData) -> list[int]:
    """Return the file descriptors in the control data of a message."""
    descriptors: list[int] = []
    for _, kind, packed in control:
        if kind == socket.SCM_RIGHTS:
            descriptors += array("i", packed[: len(packed) // 4 * 4])
    return descriptors


class UnixConnection(PolledConnection):
    """One connection of a process on this machine."""

    def __init__(self, server: UnixServer, connection: socket.socket) -> None:
        super().__init__(server, connection)
        self._engine = server.engine
        self._check_key = server.check_key
        self._limits = server.limits
        self._ops = server.ops
        self._payload = server.payload()
        enable_timestamps(connection)
        self._reader = compact.CompactReader(server.limits)
        self._connected_at = time.monotonic()
        self._key: bytes | None = None  # the key as the client has sent it
        # Sender of the requests; None until the client has sent its key.
        self._sender: Sender | None = None
        self._is_rated = False  # whether the client's key has a rate that it may exceed
        self._refused_keys = 0  # number of messages whose key was rejected
        self._unanswered = 0  # number of unanswered messages
        self._paused = False  # whether too many messages are unanswered
        self._pings = TokenBucket(CONTROL_FRAMES_PER_S, self._connected_at, CONTROL_FRAMES)
        if isinstance(server.check_key, NoKey):
            self.account.identify(server.check_key)
            self._sender = self._new_sender(server.check_key)

    def _new_sender(self, caller: Identity) -> Sender:
        return Sender(
            self._engine, self._name, caller=caller, has_left=self.has_left, can_move=True
        )

    def _read(self) -> None:
        if self._is_rated and self._throttle():
            return

        message = IncomingMessage(self._name)
        try:
            data, control = _read_buffer.receive(self._connection, _MESSAGE_BYTES, _CONTROL)
        except BlockingIOError:
            return
        except OSError as error:
            logger.info("local client: %s", error)
            data, control = memoryview(b""), []

        descriptors = _descriptors_in(control)
        waited_s = time_in_socket_s(control)
        try:
            if not data:
                self.disconnect()
                return
            if self._sender is not None and data == LocalAddress.PING:
                self._answer_ping()
                return
            with self._sending:
                self._unanswered += 1
            sender = self._sender or self._authenticate(bytes(data[:_KEY_BYTES]))
            if sender is None:
                with self._sending:
                    self._unanswered -= 1  # the server does not answer a valid key
            else:
                self._receive(sender, message, waited_s, data, descriptors)
        except VLAgentsError as error:
            self._refuse(message, error)
            self._end_if_refused_too_often()
        finally:
            for descriptor in descriptors:
                os.close(descriptor)

        if self._is_rated:
            self._throttle()
        with self._sending:
            self._paused = self._unanswered >= MOST_UNANSWERED and not self._ended
        if self._paused:
            self._pause(BACKLOGGED)

    def _end_if_refused_too_often(self) -> None:
        """End the connection of a client after too many rejections of its key or its messages;
        called after each rejection.
        """
        if self._sender is None:
            self._refused_keys += 1
            if self._refused_keys >= REFUSALS:
                self.end(f"its key was rejected {REFUSALS} times; connect with another key")
                self.disconnect()  # the client's further messages are not read
        elif self.account.refused_too_often:
            self.end(REFUSED)

    def _answer_ping(self) -> None:
        """Answer a ping; end a connection that sends more pings than a WebSocket may send."""
        if self._pings.take(time.monotonic()) > 0:
            self.end(f"more than {CONTROL_FRAMES} pings at once")
            return
        with self._sending, contextlib.suppress(OSError):  # the client is gone, or does not read
            if not self._ended:
                self._connection.send(LocalAddress.PONG)

    def _receive(
        self,
        sender: Sender,
        message: IncomingMessage,
        waited_s: float,
        data: memoryview,
        descriptors: list[int],
    ) -> None:
        charge = message.charge = self.account.charge()
        # `read` only locates the memory. A client's new memory file is kept even if the message is
        # rejected.
        memory, compact_form, text = self._payload.read(data, descriptors)
        if not compact_form:
            admission = message_admission(self._engine, charge, self._limits)
            submit = partial(self._submit, sender, message, admission, waited_s)
            self.decode(
                partial(decode_requests, memory.data, ops=self._ops),
                admission,
                submit,
                partial(self._refuse, message),
            )
            return

        if self._is_rated:
            charge.require()
        decoded = self._reader.read(text, memory)
        message.decoded(decoded)
        sender.send(message, decoded, self, waited_s=waited_s)

    def _submit(
        self,
        sender: Sender,
        message: IncomingMessage,
        admission: MessageAdmission,
        waited_s: float,
        decoded: Decoded,
    ) -> None:
        message.decoded(decoded)
        if DECODING in self._unpolled_for:
            waited_s += time.perf_counter() - message.arrived
        sender.send(message, decoded, self, admission=admission, waited_s=waited_s)

    def deliver(self, message: IncomingMessage) -> None:
        """Send the answers of a message."""
        self.send_answers(message, self._send_answers, self._engine.stats)

    def _refuse(self, message: IncomingMessage, error: VLAgentsError) -> None:
        message.refuse(error)
        self.deliver(message)
        if isinstance(error, MalformedMessage):
            wait_s = self.account.malformed_s()
            if wait_s > 0 and not self._ended:
                self._pause_for(MALFORMED, wait_s)

    def _authenticate(self, message: bytes) -> Sender | None:
        """Identify the client by the key in its first message.

        A rejected key is checked again at the next messages, `REFUSALS` times.

        Returns:
            The sender of this message; None if the message was the key itself.
        """
        if isinstance(self._check_key, NoKey):
            raise TypeError(f"got a key, although no key is required: {self._check_key.value}")

        is_key = self._key is None
        if self._key is None:
            self._key = message
        caller = self._check_key(self._key.decode(errors="replace"))
        caller.hold()
        caller.note("let in by", self._name)

        self.account.identify(caller)
        self._is_rated = True
        self._sender = self._new_sender(caller)
        return None if is_key else self._sender

    def overdue(
        self, now: float, refusal: Callable[[Caller], str | None]
    ) -> tuple[str, int] | None:
        """Return a reason to end the connection, as in `PolledConnection`; a client that has not
        sent its key after 5 s is overdue.
        """
        if self._sender is not None:
            return super().overdue(now, refusal)
        with self._sending:
            is_late = now - self._connected_at > _KEY_S and not self._ended
            if is_late and not has_unread(self._connection):
                return "no key", POLICY_VIOLATION
        return None

    def _end_sessions(self) -> None:
        if self._sender is not None:
            self._sender.release()

    def _discard(self) -> None:
        self._payload.free()
        # If there are unread messages, the kernel would report a reset to the client before the
        # client reads its last answers.
        with contextlib.suppress(OSError):
            self._connection.shutdown(socket.SHUT_RD)
            while self._connection.recv(1):
                pass

    def _send_answers(self, message: IncomingMessage) -> None:
        frame = answers.as_compact(message)
        flags = LocalAddress.COMPACT
        if frame is None:
            frame = answers.as_frame(message)
            flags = 0

        with self._sending:
            self._unanswered -= 1
            if self._paused and self._unanswered < MOST_UNANSWERED:
                self._paused = False
                self._call_soon(partial(self._resume, BACKLOGGED))
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
            except OSError as error:
                # The client is gone, or does not read its replies. `ready` handles the end.
                logger.info("local client: %s", error)
                with contextlib.suppress(OSError):  # the connection is already closed
                    self._connection.shutdown(socket.SHUT_RDWR)


class ShmServer(UnixServer):
    """Accepts the clients that read its address in the metadata."""

    name: ClassVar[str] = "shm"

    def __init__(
        self,
        engine: Engine,
        limits: MessageLimits,
        check_key: KeyCheck | NoKey,
        ops: Sequence[Op] = OPS,
    ) -> None:
        """Create the server and the address for the metadata; see `UnixServer`."""
        super().__init__(
            engine, check_key, limits, partial(MemoryFiles, limits, engine.admission), ops
        )
        self.address = LocalAddress(
            f"vlagents-ray-{secrets.token_hex(16)}",
            boot_id(),
            keyed=not isinstance(check_key, NoKey),
        )

    def open(self) -> None:
        """Listen at the address in the metadata; call this before the engine starts."""
        self._listener.bind(f"\0{self.address.socket}")
        self._listener.listen(BACKLOG)
        super().open()


class MemoryFiles:
    """A `Payload`: the memory files of one client, read in place and returned when no view is
    left.
    """

    def __init__(self, limits: MessageLimits, admission: Admission) -> None:
        self._limits = limits
        self._admission = admission
        self._files: dict[int, mmap.mmap] = {}
        # The array over the memory of each file, until the array is garbage-collected.
        self._views: dict[int, weakref.ref[np.ndarray]] = {}
        self._freed: set[int] = set()  # freed files that no reply has reported yet

    def read(
        self, message: memoryview, descriptors: list[int]
    ) -> tuple[np.ndarray, bool, memoryview]:
        """Return the frame in the message's memory file, whether the frame is compact, and the
        remaining bytes of the message.
        """
        if len(message) < LocalAddress.REQUEST.size:
            raise MalformedMessage(
                f"local: expected at least {LocalAddress.REQUEST.size} bytes, got {len(message)}"
            )
        number, flags, length = LocalAddress.REQUEST.unpack_from(message)
        if descriptors:
            self._add(number, descriptors.pop(0))

        file = self._files.get(number)
        if file is None or length > len(file):
            raise MalformedMessage(
                f"local: {length} bytes in memory file {number}, which is not there or shorter"
            )

        # The memory is read in place: the client does not write into it until a reply reports it as
        # freed.
        memory = np.frombuffer(file, np.uint8, length)
        if len(self._views) < _MAX_VIEWS:
            self._views[number] = weakref.ref(memory, partial(self._release, number))
        else:  # the policy already holds views of many files
            self._freed.add(number)
            memory = counted_array(self._admission, length, memory.copy)
        return memory, bool(flags & LocalAddress.COMPACT), message[LocalAddress.REQUEST.size :]

    def freed(self) -> int:
        """Return the bits of the files freed since the last call."""
        bits = 0
        while self._freed:
            bits |= 1 << self._freed.pop()
        return bits

    def free(self) -> None:
        """Free all memory; memory that the policy still views is freed with the last view."""
        self._files.clear()

    def _release(self, number: int, _: object) -> None:
        self._views.pop(number, None)
        self._freed.add(number)

    def _add(self, number: int, descriptor: int) -> None:
        try:
            size = os.fstat(descriptor).st_size
            max_bytes = 2 * self._limits.body_bytes
            if size > max_bytes:
                raise MessageTooLarge(
                    f"local: expected a message of at most {max_bytes} bytes, got {size}; send "
                    "smaller images, or raise `limits.body_bytes` of the deployment"
                )
            if number >= LocalAddress.FILES:
                raise MessageTooLarge(
                    f"local: expected at most {LocalAddress.FILES} memory files of a connection, "
                    "got one more"
                )
            # Reading beyond the end of a file that has shrunk would kill this process.
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


def counted_array(admission: Admission, size: int, read: Callable[[], np.ndarray]) -> np.ndarray:
    """Return the array of `size` bytes that `read` creates, counted as in flight for as long as
    anything views it.

    Raises the errors of `Admission.hold`, before the array is created. The bytes reserved for
    robots are not used.
    """
    admission.hold(size, False, 0)
    try:
        memory = read()
    except BaseException:
        admission.release(size)
        raise
    memory.flags.writeable = False
    weakref.finalize(memory, admission.release, size).atexit = False
    return memory
