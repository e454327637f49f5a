"""The endpoint for processes of the Ray cluster on this node: frames in mutable plasma objects.

The replica keeps a pool of observation channels (mutable objects, on which Ray's `Channel` is
built) and leases them to clients. A client writes its frames into a channel as raw bytes, so that
nothing is unpickled and the client may use another version of numpy. The module
`vlagents_ray.serve.endpoints.shm` does the rest: a message on a Unix socket announces a frame, the
policy thread reads the frame and replies, and the end of the connection, whatever its cause,
returns the channel to the pool.

A socket accompanies the channel because Ray's readers wait by polling (an idle `Channel.read` takes
one CPU, with a timeout or without) and do not notice the death of the writer. The channels are
pooled because Ray frees a channel's memory only when all processes that registered as its readers
or writers have ended. The socket is in Ray's own folder, next to the socket of the object store. It
is therefore reachable wherever the store is, including other network namespaces.
"""

from __future__ import annotations

import contextlib
import logging
import secrets
import socket
import threading
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import ray
from ray.exceptions import RayChannelError, RayChannelTimeoutError

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.protocol.messages import LocalAddress, MessageLimits, PlasmaAddress
from vlagents_ray.ray_tools import private
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.connection import BACKLOG
from vlagents_ray.serve.endpoints.shm import UnixServer, counted_array
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.engine import Engine

logger = logging.getLogger(__name__)

# Maximum share of the node's object store; beyond the store's size Ray silently puts channels on
# disk.
_SHARE = 0.5
_LEAST_BYTES = 64 * 1024  # minimum size of a channel
_HEADER_BYTES = 64  # size of Ray's own metadata
_CLAIM_S = 60.0  # time after which an unclaimed lease ends, s; its client is then gone


@dataclass(slots=True)
class Channel:
    """A mutable object that this process reads and one client at a time writes."""

    ref: Any
    capacity: int  # maximum size of a frame, bytes
    leased: float = 0.0  # time of the latest lease, s, monotonic

    def read(self) -> np.ndarray:
        """Return a copy of the frame, (N,) uint8, without waiting; raise `MalformedMessage` if
        there is none.
        """
        content = self._take()
        # Ray's parser below trusts its input, so a frame of another program is rejected here.
        if content.metadata != PlasmaAddress.TAG:
            raise MalformedMessage(
                "plasma: expected a frame in the channel, got other data; is this a client of "
                "vlagents_ray?"
            )
        return np.frombuffer(b"".join(private.channel_pieces(content.data)), np.uint8)

    def clear(self) -> bool:
        """Discard an unread frame; return False if the channel is unusable, since its writer was
        killed during a write, which locks the channel.
        """
        with contextlib.suppress(MalformedMessage):
            self._take()
        try:
            private.register_writer(self.ref)
            content = private.channel_content(PlasmaAddress.TAG, [memoryview(b"x")])
            if private.write_channel(self.ref, content, 0) is not None:
                return False
            self._take()
        except (RayChannelError, MalformedMessage):
            return False
        return True

    def _take(self) -> Any:
        """Return the latest frame, with its metadata, in place; it is valid while it is
        referenced.
        """
        try:
            return private.read_channel(self.ref)
        except RayChannelTimeoutError as error:
            raise MalformedMessage(
                "plasma: expected a frame in the channel of the message, got none"
            ) from error


class Pool:
    """The channels of one replica: as many as have ever been used at the same time. Thread-safe."""

    def __init__(self, limits: MessageLimits) -> None:
        self._limits = limits
        self._lock = threading.Lock()
        self._free: list[Channel] = []
        self._leased: dict[bytes, Channel] = {}
        self._bytes = 0  # size of all channels

    def lease(self, length: int) -> tuple[bytes, int]:
        """Lease a channel for frames of `length` bytes to a client; this takes milliseconds.

        Returns:
            The id of the channel and the maximum size of its frames, bytes.

        Raises:
            MessageTooLarge: `length` is over `limits.body_bytes`, or the object store is too small.
        """
        # The length includes Ray's framing; the decoder checks the exact limit.
        if length > 2 * self._limits.body_bytes:
            raise MessageTooLarge(
                f"frame: expected at most {self._limits.body_bytes} bytes, got {length}"
            )

        with self._lock:
            oldest = time.monotonic() - _CLAIM_S
            for lost in [key for key, channel in self._leased.items() if channel.leased < oldest]:
                self._return_channel(self._leased.pop(lost))

            fitting = [free for free in self._free if free.capacity >= length]
            channel = min(fitting, key=lambda free: free.capacity, default=None)
            if channel is not None:
                self._free.remove(channel)

        if channel is None:
            next_power_of_two = 1 << (length - 1).bit_length()
            channel = self._create(max(_LEAST_BYTES, next_power_of_two))
        channel.leased = time.monotonic()
        key: bytes = channel.ref.binary()
        with self._lock:
            self._leased[key] = channel
        return key, channel.capacity

    def claim(self, key: bytes) -> Channel:
        """Return the leased channel `key`, which then belongs to the connection that has sent the
        key.
        """
        with self._lock:
            channel = self._leased.pop(key, None)
        if channel is None:
            raise MalformedMessage("plasma: this channel is not leased; request a channel first")
        return channel

    def release(self, channel: Channel) -> None:
        """Return a channel to the pool, for the next client."""
        with self._lock:
            self._return_channel(channel)

    def _return_channel(self, channel: Channel) -> None:
        if channel.clear():
            self._free.append(channel)
            return
        logger.warning(
            "plasma: a client was killed while it wrote; its channel of %d bytes is lost until "
            "this replica ends",
            channel.capacity,
        )

    def _create(self, capacity: int) -> Channel:
        """Create a channel without the lock, which the policy thread needs: allocation can be
        slow.
        """
        node_id = ray.get_runtime_context().get_node_id()
        node = next(node for node in ray.nodes() if node["NodeID"] == node_id)
        store_bytes: float = node["Resources"]["object_store_memory"]

        with self._lock:
            if self._bytes + capacity > _SHARE * store_bytes:
                raise MessageTooLarge(
                    f"plasma: no room for a channel of {capacity} bytes: this node's object store "
                    f"has {store_bytes:.0f} bytes, of which a replica's channels may take "
                    f"{_SHARE:.0%}, and they already take {self._bytes} bytes; start Ray with a "
                    "larger object_store_memory (`ray start --object-store-memory BYTES`), or use "
                    "transport 'shm'"
                )
            self._bytes += capacity

        try:
            ref = private.create_channel(capacity + _HEADER_BYTES)
        except BaseException:
            with self._lock:
                self._bytes -= capacity
            raise
        return Channel(ref, capacity)


class PlasmaServer(UnixServer):
    """Accepts the clients that have leased a channel from its pool."""

    name: ClassVar[str] = "plasma"

    def __init__(self, engine: Engine, limits: MessageLimits) -> None:
        """Prepare the pool and the socket; `limits` are the limits of a frame."""
        self.pool = Pool(limits)
        payload = partial(LeasedChannel, self.pool, engine.admission)
        super().__init__(engine, NoKey.INSIDE, limits, payload)

        folder = private.plasma_folder()
        # The name is not longer than the name of the store's socket in the same folder, since the
        # length of socket paths is limited.
        self._path = folder / f"vla{secrets.token_hex(4)}"
        self.plasma = PlasmaAddress(str(self._path), ray.get_runtime_context().get_node_id())

    def open(self) -> None:
        """Listen, and then give the socket its file name. Remove the sockets of killed replicas."""
        for other in self._path.parent.glob("vla????????"):
            _remove_if_dead(other)
        hidden = self._path.with_name(f".{self._path.name}")
        self._listener.bind(str(hidden))
        hidden.chmod(0o600)
        self._listener.listen(BACKLOG)
        hidden.rename(self._path)
        super().open()

    def close(self) -> None:
        """Close the listener and all connections, and remove the socket; call this after the
        engine has ended.
        """
        super().close()
        self._path.unlink(missing_ok=True)


class LeasedChannel:
    """A `Payload`: the channel of one client, which leases a larger channel for larger frames."""

    def __init__(self, pool: Pool, admission: Admission) -> None:
        self._pool = pool
        self._admission = admission
        self._channel: Channel | None = None

    def read(
        self, message: memoryview, descriptors: list[int]
    ) -> tuple[np.ndarray, bool, memoryview]:
        """Return a copy of the frame in the message's channel, whether the frame is compact, and
        the remaining bytes of the message.
        """
        if len(message) < PlasmaAddress.REQUEST.size:
            raise MalformedMessage(
                f"plasma: expected at least {PlasmaAddress.REQUEST.size} bytes, got {len(message)}"
            )
        key, flags = PlasmaAddress.REQUEST.unpack_from(message)
        if self._channel is None or self._channel.ref.binary() != key:
            self.free()
            self._channel = self._pool.claim(key)
        memory = counted_array(self._admission, self._channel.capacity, self._channel.read)
        return memory, bool(flags & LocalAddress.COMPACT), message[PlasmaAddress.REQUEST.size :]

    def freed(self) -> int:
        """Return 0, since frames are copied and a reply implies that the channel is free."""
        return 0

    def free(self) -> None:
        """Release the channel for other clients."""
        if self._channel is not None:
            self._pool.release(self._channel)
            self._channel = None


def _remove_if_dead(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) as probe:
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
        except OSError:  # the socket is busy or belongs to another user, so its replica is running
            return
