"""`serve://APP` on the replica's own node: frames in mutable plasma objects; see `vlagents_ray.serve.plasma`."""

from __future__ import annotations

import pickle
import select
import socket
import time
from collections.abc import Sequence
from typing import Any

from vlagents_ray.client.handle import HandleTransport
from vlagents_ray.client.shm import ShmTransport
from vlagents_ray.errors import ConfigError
from vlagents_ray.wire.arrays import Buffer
from vlagents_ray.wire.codecs import RAW
from vlagents_ray.wire.frames import request_parts
from vlagents_ray.wire.messages import LocalAddress, PlasmaAddress, Reply, Request

_CHUNK = 2**20  # bytes; Ray copies no longer ones in the calling thread
_WRITE_MS = 1000  # the channel is free when a frame is written; if not, something is wrong with it


class PlasmaTransport(ShmTransport):
    """Raw frames written into a channel that the replica leases to this connection, which is a session.

    Any process of the cluster on the replica's node can use it: actors, tasks, drivers. A frame that
    outgrows the channel gets a larger one.
    """

    name = "plasma"

    def __init__(self, app: str) -> None:
        self._app = app
        self._handle = HandleTransport(app, must_be_near=True)
        self._plasma: PlasmaAddress | None = None
        self._channel: Any = None  # its ObjectRef
        self._capacity = 0
        self._unread = False  # the replica may still have to read the last frame
        super().__init__({"socket": "", "boot_id": ""})

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Let the Serve handle choose a replica, and connect to its door. Returns the metadata.

        `ConfigError` if that replica runs on another node, or this process is not itself on a node.
        """
        deadline = time.monotonic() + timeout_s
        metadata = self._handle.connect(timeout_s)
        self.connect_to(self._handle, metadata, max(1.0, deadline - time.monotonic()))
        return metadata

    def connect_to(self, handle: HandleTransport, metadata: dict[str, Any], timeout_s: float) -> None:
        """As `connect`, to the replica that `handle` chose, and whose metadata this is."""
        node = this_node()
        if node is None:
            raise ConfigError(
                f"serve://{self._app}: transport 'plasma' needs a process on a node of the cluster; "
                f"a Ray client (ray://) is none: use http://"
            )
        address = metadata.get("plasma")
        if address is None:
            raise ConfigError(f"serve://{self._app}: its replica offers no plasma door; use transport 'handle'")
        if address["node"] != node:
            raise ConfigError(
                f"serve://{self._app}: transport 'plasma' needs the replica on this node ({node[:8]}), the chosen one "
                f"is on {address['node'][:8]}; use transport 'handle', or 'auto'"
            )
        self._handle = handle
        self._plasma = PlasmaAddress(**address)
        self._open(timeout_s)

    def server(self) -> str:
        """The path of the replica's socket."""
        return "" if self._plasma is None else self._plasma.socket

    def hand_over(self, connection: socket.socket, requests: Sequence[Request], deadline: float) -> None:
        """Write a frame into the channel, and say so. `TimeoutError`, `OSError` if that fails."""
        from ray._private.worker import global_worker
        from ray.exceptions import RayChannelError

        written = self._acts.write(requests)
        frame = _gather(request_parts(requests, RAW) if written is None else written.parts())
        while self._unread:  # a request whose deadline passed here: its answer says that the channel is free
            try:
                self.receive(connection)
            except BlockingIOError:
                self.wait(connection, select.POLLIN, deadline)
        if frame.total_bytes > self._capacity:
            self._lease(frame.total_bytes, deadline)
        try:
            global_worker.core_worker.experimental_channel_put_serialized(frame, self._channel, 1, _WRITE_MS)
        except RayChannelError as error:
            raise OSError(f"the channel cannot be written ({error})") from error
        message = PlasmaAddress.REQUEST.pack(self._channel.binary(), 0 if written is None else LocalAddress.COMPACT)
        self.send(connection, message if written is None else message + written.message, deadline)
        self._unread = True

    def receive(self, connection: socket.socket) -> list[Reply]:
        """The next replies, to whichever frame; the channel is free again."""
        replies = super().receive(connection)
        self._unread = False
        return replies

    def close(self) -> None:
        """End the session; the replica takes the channel back."""
        super().close()
        self._channel, self._capacity, self._unread = None, 0, False

    def _lease(self, length: int, deadline: float) -> None:
        import ray
        from ray._private.worker import global_worker

        key, self._capacity = self._handle.ask("lease", length, timeout_s=max(1e-3, deadline - time.monotonic()))
        # By its id alone: the replica owns the object, and keeps it as long as it lives.
        self._channel = ray.ObjectRef(key)
        global_worker.core_worker.experimental_channel_register_writer(self._channel, {})


def _gather(parts: list[Buffer]) -> Any:
    """The pieces of a frame for Ray to copy straight into the channel, one after the other.

    Ray's writer of out-of-band buffers, with nothing pickled in band. It copies longer buffers with six
    threads, started anew each time, which takes longer than the copy: hence the chunks.
    """
    from ray._raylet import Pickle5SerializedObject, Pickle5Writer  # type: ignore[attr-defined]

    writer = Pickle5Writer()
    for part in parts:
        for at in range(0, len(part), _CHUNK):
            writer.buffer_callback(pickle.PickleBuffer(memoryview(part)[at : at + _CHUNK]))
    return Pickle5SerializedObject(PlasmaAddress.TAG, b"", writer, [])


def this_node() -> str | None:
    """The Ray node that this process runs on; None for a Ray client, and without Ray."""
    import ray
    from ray._private.worker import global_worker

    if not global_worker.connected:
        return None
    node: str = ray.get_runtime_context().get_node_id()
    return node
