"""The door for processes of the Ray cluster on this node: frames in mutable plasma objects.

The replica keeps a pool of observation channels (mutable objects, the memory under Ray's `Channel`)
and leases them out: a client writes its frames into one, as raw bytes, so that nothing is unpickled
and another numpy can write them. The rest is `vlagents_ray.serve.local`: a message on a Unix socket
says that a frame is there, the policy's own thread reads it and answers, and the end of the
connection, however it comes, gives the channel back to the pool.

Why a socket beside the channel: Ray's readers wait by polling (an idle `Channel.read` takes one CPU,
with a time-out or without), and hear nothing of the writer's death. Why a pool: Ray gives a channel's
memory back only when all processes that registered as its readers or writers have ended. The socket
lies in Ray's own folder, beside the object store's, so that it reaches whatever the store reaches,
other network namespaces too.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import ray
from ray._raylet import RawSerializedObject, unpack_pickle5_buffers  # type: ignore[attr-defined]
from ray.exceptions import RayChannelError, RayChannelTimeoutError

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.local import LocalClient, LocalDoor
from vlagents_ray.wire.frames import decode_requests
from vlagents_ray.wire.messages import Limits, LocalAddress, PlasmaAddress, Reply, Request

logger = logging.getLogger(__name__)

_SHARE = 0.5  # of the node's object store; beyond its size Ray would put channels on the disk, silently
_LEAST = 64 * 1024  # bytes of a channel
_HEADER = 64  # bytes of Ray's own metadata
_CLAIM_S = 60.0  # a lease that no connection has used for so long belongs to a client that is gone
_BACKLOG = 128


@dataclass(slots=True)
class Channel:
    """A mutable object that this process reads, and one client at a time writes."""

    ref: Any
    capacity: int  # bytes of the longest frame
    leased: float = 0.0  # s, monotonic

    def read(self) -> bytes:
        """A copy of the frame that was written; `MalformedMessage` if there is none. Never waits."""
        found = self._take()
        if found.metadata != PlasmaAddress.TAG:  # Ray's parser below trusts its input, as it does everywhere
            raise MalformedMessage("plasma: what the channel holds is no frame; is this a client of vlagents_ray?")
        _, pieces = unpack_pickle5_buffers(found.data)  # finds them; there is nothing to unpickle
        return b"".join(pieces)

    def intact(self) -> bool:
        """Discard what nobody read. False if its writer was killed while it wrote: then it is locked for good."""
        with contextlib.suppress(MalformedMessage):
            self._take()
        try:
            _core().experimental_channel_register_writer(self.ref, {})
            _core().experimental_channel_put_serialized(RawSerializedObject(b"x"), self.ref, 1, 0)
            self._take()
        except (RayChannelError, MalformedMessage):
            return False
        return True

    def _take(self) -> Any:
        """What was written last, in place, as long as the caller holds it."""
        try:
            return _core().get_objects([self.ref], 0)[0]
        except RayChannelTimeoutError as error:
            raise MalformedMessage("plasma: a message came without a frame in its channel") from error


class Pool:
    """The channels of one replica: as many as were ever in use at once. Thread-safe."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._lock = threading.Lock()
        self._free: list[Channel] = []
        self._leased: dict[bytes, Channel] = {}
        self._bytes = 0

    def lease(self, length: int) -> tuple[bytes, int]:
        """A channel for frames of `length` bytes: its id, and how long its frames can be. Takes milliseconds.

        `MessageTooLarge` over `limits.body_bytes`, and where the object store is too small.
        """
        if length > 2 * self._limits.body_bytes:  # with Ray's framing; the exact check is the decoder's
            raise MessageTooLarge(f"frame: got {length} bytes, the limit is {self._limits.body_bytes}")
        with self._lock:
            oldest = time.monotonic() - _CLAIM_S
            for lost in [key for key, channel in self._leased.items() if channel.leased < oldest]:
                self._back(self._leased.pop(lost))
            fitting = [channel for channel in self._free if channel.capacity >= length]
            channel = min(fitting, key=lambda one: one.capacity, default=None)
            if channel is not None:
                self._free.remove(channel)
        if channel is None:
            channel = self._create(max(_LEAST, 1 << (length - 1).bit_length()))
        channel.leased = time.monotonic()
        key: bytes = channel.ref.binary()
        with self._lock:
            self._leased[key] = channel
        return key, channel.capacity

    def claim(self, key: bytes) -> Channel:
        """The leased channel, which from now on belongs to the connection that named it."""
        with self._lock:
            channel = self._leased.pop(key, None)
        if channel is None:
            raise MalformedMessage("plasma: this channel is not leased; ask for one")
        return channel

    def give_back(self, channel: Channel) -> None:
        """Keep for the next client."""
        with self._lock:
            self._back(channel)

    def counts(self) -> tuple[int, int]:
        """Channels that are free, and bytes of all channels."""
        with self._lock:
            return len(self._free), self._bytes

    def _back(self, channel: Channel) -> None:
        if channel.intact():
            self._free.append(channel)
            return
        logger.warning(
            "plasma: a client was killed while it wrote; its channel of %d bytes is lost until this replica ends",
            channel.capacity,
        )

    def _create(self, capacity: int) -> Channel:
        """Not under the lock: the policy's thread takes that, and making memory can take long."""
        store = _store_bytes()
        with self._lock:
            if self._bytes + capacity > _SHARE * store:
                raise MessageTooLarge(
                    f"plasma: no room for a channel of {capacity} bytes: this node's object store has {store:.0f}, "
                    f"a replica's channels may take {_SHARE:.0%} of it and take {self._bytes}; start Ray with a larger "
                    f"object_store_memory (`ray start --object-store-memory BYTES`), or use transport 'shm'"
                )
            self._bytes += capacity
        try:
            ref = ray._private.worker.global_worker.put_object(bytes(capacity + _HEADER), _is_experimental_channel=True)
            _core().experimental_channel_register_reader(ref)
        except BaseException:
            with self._lock:
                self._bytes -= capacity
            raise
        return Channel(ref, capacity)


class PlasmaDoor(LocalDoor):
    """As the local door, with frames in channels that `lease` gives out."""

    def __init__(self, engine: Engine, limits: Limits) -> None:
        super().__init__(engine, limits)
        self.pool = Pool(limits)
        folder = Path(ray._private.worker.global_worker.node.plasma_store_socket_name).parent
        # No longer than the store's own name beside it, since paths of sockets are limited.
        self._path = folder / f"vla{secrets.token_hex(4)}"
        self.plasma = PlasmaAddress(str(self._path), ray.get_runtime_context().get_node_id())

    def listen(self) -> None:
        """Give the socket its name, once it listens, and remove what killed replicas left of theirs."""
        for other in self._path.parent.glob("vla????????"):
            _remove_if_dead(other)
        hidden = self._path.with_name(f".{self._path.name}")
        self._listener.bind(str(hidden))
        hidden.chmod(0o600)
        self._listener.listen(_BACKLOG)
        hidden.rename(self._path)

    def close(self) -> None:
        """Hang up; after the engine has ended."""
        super().close()
        self._path.unlink(missing_ok=True)

    def client(self, connection: socket.socket) -> LocalClient:
        """What serves a connection that was let in."""
        return _PlasmaClient(self.pool, connection, self._engine, self._limits, self._clients.discard)


class _PlasmaClient(LocalClient):
    """A connection whose messages name the channel that holds a frame."""

    name: ClassVar[str] = "plasma"

    def __init__(self, pool: Pool, *args: Any) -> None:
        super().__init__(*args)
        self._pool = pool
        self._channel: Channel | None = None

    def read(self, message: memoryview, descriptors: list[int]) -> Sequence[Request | Reply]:
        """The requests in the channel that the message names; the client changes it when its frames outgrow it."""
        if len(message) < PlasmaAddress.REQUEST.size:
            raise MalformedMessage(f"plasma: got {len(message)} bytes, want at least {PlasmaAddress.REQUEST.size}")
        key, flags = PlasmaAddress.REQUEST.unpack_from(message)
        if self._channel is None or self._channel.ref.binary() != key:
            self.forget()
            self._channel = self._pool.claim(key)
        content = self._channel.read()
        if flags & LocalAddress.COMPACT:
            return self._acts.read(message[PlasmaAddress.REQUEST.size :], np.frombuffer(content, np.uint8))
        return decode_requests(content, self._limits)

    def forget(self) -> None:
        """The channel is another client's to use."""
        if self._channel is not None:
            self._pool.give_back(self._channel)
            self._channel = None


def _core() -> Any:
    return ray._private.worker.global_worker.core_worker


def _store_bytes() -> float:
    node_id = ray.get_runtime_context().get_node_id()
    size: float = next(node["Resources"]["object_store_memory"] for node in ray.nodes() if node["NodeID"] == node_id)
    return size


def _remove_if_dead(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
        except OSError:  # busy, or another user's: alive
            return
