"""`serve://APP` on the replica's own node: frames in mutable plasma objects.

`vlagents_ray.serve.endpoints.plasma` is the server's side.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, ClassVar

from vlagents_ray.client.transports.serve_handle import HandleTransport
from vlagents_ray.client.transports.unix_messages import UnixTransport
from vlagents_ray.errors import ConfigError
from vlagents_ray.images.codecs import RAW
from vlagents_ray.protocol.arrays import Buffer
from vlagents_ray.protocol.frames import request_parts
from vlagents_ray.protocol.messages import (
    LocalAddress,
    PlasmaAddress,
    Request,
)
from vlagents_ray.ray_tools.private import channel_content, is_connected, register_writer, write_channel

_CHUNK = 2**20  # bytes; Ray copies longer buffers in other threads
_WRITE_MS = 1000  # the channel is free when a frame is written; if not, something is wrong with it


class PlasmaTransport(UnixTransport):
    """Writes raw frames into a channel that the replica leases to this connection, which is a session.

    Any process of the cluster on the replica's node can use it: actors, tasks, drivers. A frame that outgrows the
    channel gets a larger one.
    """

    name: ClassVar[str] = "plasma"

    def __init__(self, app: str) -> None:
        super().__init__()
        self._app = app
        self._handle = HandleTransport(app, must_be_near=True)
        self._channel: Any = None  # the ObjectRef of the channel
        self._capacity = 0
        self._unread = False  # the replica may still have to read the last frame

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Let the Serve handle choose a replica, and connect to its socket.

        Returns:
            The metadata of the replica.

        Raises:
            ConfigError: The replica runs on another node, or this process is not on a node itself.
        """
        deadline = time.monotonic() + timeout_s
        metadata = self._handle.connect(timeout_s)
        self.connect_to(self._handle, metadata, max(1.0, deadline - time.monotonic()))
        return metadata

    def connect_to(self, handle: HandleTransport, metadata: dict[str, Any], timeout_s: float) -> None:
        """Connect like `connect`, to the replica that `handle` chose and whose metadata this is."""
        node = this_node()
        if node is None:
            raise ConfigError(
                f"serve://{self._app}: transport 'plasma' needs a process on a node of the cluster; "
                f"a Ray client (ray://) is none: use http://"
            )
        address = metadata.get("plasma")
        if address is None:
            raise ConfigError(f"serve://{self._app}: its replica offers no plasma endpoint; use transport 'handle'")
        if address["node"] != node:
            raise ConfigError(
                f"serve://{self._app}: transport 'plasma' needs the replica on this node ({node[:8]}), the chosen one "
                f"is on {address['node'][:8]}; use transport 'handle', or 'auto'"
            )
        self._handle = handle
        self._server = PlasmaAddress(**address).socket
        self._open(timeout_s)

    def _is_free(self) -> bool:
        return not self._unread

    def _write(self, requests: Sequence[Request], deadline: float) -> tuple[bytes, int | None]:
        written = self._writer.write(requests)
        frame = _gather(request_parts(requests, RAW) if written is None else written.parts())
        if frame.total_bytes > self._capacity:
            self._lease(frame.total_bytes, deadline)
        if (reason := write_channel(self._channel, frame, _WRITE_MS)) is not None:
            raise OSError(f"the channel cannot be written ({reason})")
        self._unread = True
        flags = 0 if written is None else LocalAddress.COMPACT
        message: bytes = PlasmaAddress.REQUEST.pack(self._channel.binary(), flags)
        return (message if written is None else message + written.message), None

    def _unsent(self) -> None:
        self._unread = False  # the channel refuses a later frame if this one was not read

    def _answered(self, freed: int) -> None:
        self._unread = False

    def close(self) -> None:
        """End the session; the replica takes the channel back."""
        super().close()
        self._channel, self._capacity, self._unread = None, 0, False

    def _lease(self, length: int, deadline: float) -> None:
        import ray

        key, self._capacity = self._handle.lease(length, max(1e-3, deadline - time.monotonic()))
        # The id is enough: the replica owns the object, and keeps it as long as the replica lives.
        self._channel = ray.ObjectRef(key)
        register_writer(self._channel)


def _gather(parts: list[Buffer]) -> Any:
    """Return the pieces of a frame in a form that Ray copies straight into the channel, one after the other.

    Ray copies longer buffers with six threads, which it starts for each copy and which takes longer than the copy:
    hence the chunks.
    """
    pieces = (memoryview(part)[at : at + _CHUNK] for part in parts for at in range(0, len(part), _CHUNK))
    return channel_content(PlasmaAddress.TAG, pieces)


def this_node() -> str | None:
    """Return the id of the Ray node that this process runs on; None for a Ray client, and without Ray."""
    import ray

    if not is_connected():
        return None
    node: str = ray.get_runtime_context().get_node_id()
    return node
