"""`serve://APP`, from inside the Ray cluster: a Serve handle, or a plasma channel to a replica on
this node.

A Serve handle may send each request to another replica. This transport therefore picks a replica
once, and sends all requests of the session to it. `vlagents_ray.serve.endpoints.plasma` is the
server's side of the channel.
"""

from __future__ import annotations

import contextlib
import pickle
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any, ClassVar, Protocol

from vlagents_ray.client.transports.base import (
    PROBE_S,
    ConnectReport,
    ReplicaSilent,
    ReplicaWatch,
    connection_lost,
    first_timeout_s,
    no_answer,
)
from vlagents_ray.client.transports.shm import UnixTransport
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.images.codecs import RAW
from vlagents_ray.protocol.frame_layout import Buffer
from vlagents_ray.protocol.frames import decode_replies, encode_requests, request_parts
from vlagents_ray.protocol.messages import (
    LocalAddress,
    PlasmaAddress,
    Reply,
    Request,
    boot_id,
    read_address,
)
from vlagents_ray.ray_tools import private

_PAUSE_S = 0.2  # pause after the loss of a replica before another replica is requested
_QUERY_S = 10.0  # time between two queries for the replicas' nodes, which change over time
# The longest wait for the first query, s. An application without a replica does not answer.
_FIRST_QUERY_S = 3.0
_CHUNK = 2**20  # bytes; Ray copies longer buffers with other threads
# Time limit for a channel to become free; it should be free when a frame is written.
_WRITE_MS = 1000


class ClientApi(Protocol):
    """The methods of a replica that clients inside the cluster call.

    `vlagents_ray.serve.replica.replica.PolicyReplica` implements them. An error of this package is
    returned, as in `vlagents_ray.serve.scaling.sibling_replicas.SiblingApi`: Serve would log it
    with a traceback.
    """

    async def attach(
        self, node: str = "", boot_id: str = "", must_be_near: bool = False
    ) -> tuple[dict[str, Any], Any]:
        """Return the metadata and the actor of the best replica for a client on this node."""

    async def call(self, session_id: str, frame: Any, pause: float) -> bytes | float:
        """Return the replies to a frame of requests.

        If the replica's process was paused while the frame may have been waiting, nothing is
        executed, since the client may have left. The result is then a number that identifies the
        pause; the client sends the frame again with this number.

        Args:
            session_id: The caller's own session.
            frame: The requests.
            pause: The last number that the replica returned; 0.0 before the first one.
        """

    async def lease(self, length: int) -> tuple[bytes, int] | VLAgentsError:
        """Lease a plasma channel for frames of `length` bytes; return its id and its capacity,
        bytes, or the error.
        """

    async def nodes(self) -> dict[str, int]:
        """Return the number of replicas that accept sessions on each node."""


class HandleTransport:
    """Sends raw frames as plasma objects, which the replica reads without a copy if it is on this
    node.
    """

    name = "handle"
    holds_sessions = False

    def __init__(
        self, app: str, watch: ReplicaWatch | None = None, *, must_be_near: bool = False
    ) -> None:
        """Set the application.

        Args:
            app: The name of the application.
            watch: Detects whether the replica is frozen.
            must_be_near: Whether to accept only replicas on this machine, even if others have far
                less load.
        """
        self._must_be_near, self._app = must_be_near, app
        self._session = uuid.uuid4().hex
        self._watch = watch or ReplicaWatch()
        self._replica: Any = None
        self._pause = 0.0  # pause of the replica, see `ClientApi.call`
        self._unanswered: list[Any] = []  # attempts to choose a replica that are still pending

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Choose a replica, or another replica if the chosen replica has ended; return its
        metadata.
        """
        import ray

        if not ray.is_initialized():
            raise ConfigError(
                f"serve://{self._app}: this process is in no Ray cluster; call ray.init() "
                "(`vlagents-ray eval` does, with --address), or use http://"
            )

        try:
            return self._attach_until(time.monotonic() + timeout_s, timeout_s)
        finally:
            for attaching in self._unanswered:
                attaching.cancel()
            self._unanswered.clear()

    def _attach_until(self, deadline: float, timeout_s: float) -> dict[str, Any]:
        attempt_s = first_timeout_s(timeout_s)
        report = ConnectReport(f"serve://{self._app}", timeout_s)
        while True:
            try:
                return self._attach(max(0.0, min(attempt_s, deadline - time.monotonic())))
            except ConnectionLost as error:  # Serve detects the loss of a node with a delay
                if time.monotonic() + _PAUSE_S > deadline:
                    raise PolicyUnavailable(str(error)) from error
                report.failed(error)
                time.sleep(_PAUSE_S)
            except DeadlineExceeded as error:
                # The replica may hang; the handle may choose another replica at the next attempt.
                if time.monotonic() >= deadline:
                    raise PolicyUnavailable(
                        f"serve://{self._app}: no replica within {timeout_s:g} s"
                    ) from error
                report.failed(error)
                attempt_s *= 2

    def _attach(self, timeout_s: float) -> dict[str, Any]:
        import ray
        from ray import serve
        from ray.serve.exceptions import RayServeException

        try:
            handle = serve.get_app_handle(self._app)
            attaching = handle.attach.remote(this_node() or "", boot_id(), self._must_be_near)
            metadata: dict[str, Any]
            metadata, self._replica = attaching.result(timeout_s=timeout_s)
            self._pause = 0.0
        except ray.exceptions.RayTaskError as error:
            raise PolicyUnavailable(f"serve://{self._app}: {error.cause}") from error
        except RayServeException as error:
            raise PolicyUnavailable(f"serve://{self._app}: {error}") from error
        except TimeoutError as error:
            # While this request is pending, Serve counts it as load, and chooses another replica
            # next.
            self._unanswered.append(attaching)
            raise DeadlineExceeded(
                f"serve://{self._app}: no replica within {timeout_s:g} s"
            ) from error
        except ray.exceptions.RayError as error:
            raise ConnectionLost(f"serve://{self._app}: {error}") from error
        return metadata

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Make an actor call, and repeat it if the first call may have waited while the replica was
        paused. The frame is in plasma until the reply.
        """
        import ray

        deadline = time.monotonic() + timeout_s

        # Ray stores a plain buffer in plasma, outside the pickle. The pickle of an array would
        # depend on the version of numpy.
        content = pickle.PickleBuffer(encode_requests(requests, RAW))
        try:
            frame = ray.put(content)
        except ray.exceptions.RayError as error:  # neither the object store nor the disk has room
            raise PolicyUnavailable(
                f"serve://{self._app}: {len(content.raw())} bytes cannot be sent: {error}"
            ) from error
        pending: Any = None
        try:
            while True:
                pending = call_replica(
                    self._replica,
                    ClientApi.call,
                    self._session,
                    frame,
                    self._pause,
                    request_id=requests[0].request_id,
                )
                answer = self._answer(pending, deadline)
                if not isinstance(answer, float):
                    return decode_replies(answer)
                self._pause = answer
        # May be a TimeoutError that the replica raised.
        except ray.exceptions.RayTaskError as error:
            # It is unknown whether the replica executed the request.
            raise ConnectionLost(
                f"serve://{self._app}: the replica failed: {error.cause}; reset again"
            ) from error
        except ReplicaSilent:
            ray.cancel(pending)
            raise
        except TimeoutError as error:
            ray.cancel(pending)
            raise no_answer(f"serve://{self._app}", timeout_s) from error
        except ray.exceptions.RayError as error:
            # The replica is gone, or the node with the frame or the answer is gone.
            raise self._lost(error) from error

    def lease(self, length: int, timeout_s: float) -> tuple[bytes, int]:
        """Call `ClientApi.lease` of the chosen replica.

        Raises:
            VLAgentsError: The replica returned this error.
        """
        import ray

        try:
            leased: tuple[bytes, int] | VLAgentsError = ray.get(
                call_replica(self._replica, ClientApi.lease, length), timeout=timeout_s
            )
        except ray.exceptions.GetTimeoutError as error:
            raise DeadlineExceeded(
                f"serve://{self._app}: no answer within {timeout_s:g} s"
            ) from error
        except ray.exceptions.RayTaskError as error:
            raise PolicyUnavailable(f"serve://{self._app}: {error.cause}") from error
        except ray.exceptions.RayError as error:
            raise self._lost(error) from error
        if isinstance(leased, VLAgentsError):
            raise leased
        return leased

    def close(self) -> None:
        """Release the chosen replica."""
        self._replica = None

    def _answer(self, pending: Any, deadline: float) -> bytes | float:
        """Wait for the answer to a call of the replica, ping the replica meanwhile, and return the
        answer.
        """
        import ray

        replica = self._replica

        def is_alive() -> bool:
            with contextlib.suppress(ray.exceptions.RayError):
                ray.get(private.ping_replica(replica), timeout=PROBE_S)
                return True
            return False

        answers: list[bytes | float] = []

        def is_ready(limit_s: float) -> bool:
            with contextlib.suppress(ray.exceptions.GetTimeoutError):
                if not answers:
                    answers.append(ray.get(pending, timeout=limit_s))
            return bool(answers)

        self._watch.begin()
        self._watch.wait_until(is_ready, deadline, partial(self._watch.probe, is_alive))
        self._watch.received()
        return answers[0]

    def _lost(self, error: Exception) -> ConnectionLost:
        return connection_lost(
            f"serve://{self._app}", f"the replica is gone ({type(error).__name__}); reset again"
        )


class ReplicaNodes:
    """Queries the nodes on which an application has replicas, while blocking the caller as little
    as possible.
    """

    def __init__(self, app: str) -> None:
        self._app = app
        self._nodes: dict[str, int] = {}
        self._asked: float | None = None  # time of the last query, time.monotonic()
        self._answer: Any = None  # the pending answer

    def query(self) -> dict[str, int]:
        """Return the number of replicas on each node, by Ray's node id, from the last answer; {}
        before the first answer.
        """
        import ray
        from ray import serve
        from ray.serve.exceptions import RayServeException

        now = time.monotonic()
        wait_s = _FIRST_QUERY_S if self._asked is None else 0.0
        try:
            if self._answer is None and (self._asked is None or now - self._asked > _QUERY_S):
                self._asked = now
                self._answer = serve.get_app_handle(self._app).nodes.remote()
            if self._answer is not None:
                self._nodes = self._answer.result(timeout_s=wait_s)
                self._answer = None
        except TimeoutError:
            pass  # the answer follows later
        except (RayServeException, ray.exceptions.RayError):
            self._nodes, self._answer = {}, None
        return self._nodes


def call_replica(replica: Any, method: Callable[..., Any], *args: Any, request_id: str = "") -> Any:
    """Call a method of one particular replica, as Serve's own router does; a Serve handle cannot
    choose the replica.

    `method` is a method of `ClientApi` or of `SiblingApi`.
    """
    header = private.replica_request(request_id or uuid.uuid4().hex, method.__name__)
    return replica.handle_request.remote(header, *args)


# The plasma transport, for a client on the node of its replica, writes frames into mutable objects
# of the node's store.


class PlasmaTransport(UnixTransport):
    """Writes raw frames into a channel that the replica leases to this connection, which is one
    session.

    Any process of the cluster on the replica's node can use it: an actor, a task or a driver. If a
    frame is too large for the channel, the client leases a larger channel.
    """

    name: ClassVar[str] = "plasma"

    def __init__(self, app: str, watch: ReplicaWatch | None = None) -> None:
        super().__init__(watch)
        self._app = app
        self._handle = HandleTransport(app, must_be_near=True)
        self._channel: Any = None  # the ObjectRef of the channel
        self._capacity = 0
        self._unread = False  # whether the last frame may still be unread

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Choose a replica with the Serve handle, connect to its socket, and return its metadata.

        Raises:
            ConfigError: The replica runs on another node, or this process does not run on a node of
                Ray.
        """
        deadline = time.monotonic() + timeout_s
        metadata = self._handle.connect(timeout_s)
        self.connect_to(self._handle, metadata, max(1.0, deadline - time.monotonic()))
        return metadata

    def connect_to(
        self, handle: HandleTransport, metadata: dict[str, Any], timeout_s: float
    ) -> None:
        """Connect like `connect`, but to the replica that `handle` chose, whose metadata is
        `metadata`.
        """
        node = this_node()
        if node is None:
            raise ConfigError(
                f"serve://{self._app}: expected a process on a node of the cluster for transport "
                "'plasma', got a Ray client (ray://); use http://"
            )

        address = read_address(PlasmaAddress, metadata.get("plasma"))
        if address is None:
            raise ConfigError(
                f"serve://{self._app}: the replica has no plasma endpoint; use transport 'handle'"
            )
        if address.node != node:
            raise ConfigError(
                f"serve://{self._app}: expected a replica on this node ({node[:8]}) for transport "
                f"'plasma', got a replica on {address.node[:8]}; use transport 'handle', or 'auto'"
            )

        self._handle = handle
        self._server = address.socket
        self._open(timeout_s)

    def _is_free(self) -> bool:
        return not self._unread

    def _write(self, requests: Sequence[Request], deadline: float) -> tuple[bytes, int | None]:
        written = self._writer.write(requests)
        buffers = request_parts(requests, RAW) if written is None else written.parts()
        frame = private.channel_content(PlasmaAddress.TAG, _chunks(buffers))

        if frame.total_bytes > self._capacity:
            import ray

            key, self._capacity = self._handle.lease(
                frame.total_bytes, max(1e-3, deadline - time.monotonic())
            )
            # The id is sufficient, as the replica owns the object and keeps it until the replica
            # ends.
            self._channel = ray.ObjectRef(key)
            private.register_writer(self._channel)

        reason = private.write_channel(self._channel, frame, _WRITE_MS)
        if reason is not None:
            raise OSError(f"the channel cannot be written ({reason})")
        self._unread = True

        flags = 0 if written is None else LocalAddress.COMPACT
        message: bytes = PlasmaAddress.REQUEST.pack(self._channel.binary(), flags)
        return (message if written is None else message + written.message), None

    def _unsent(self) -> None:
        self._unread = False  # if this frame is still unread, the channel rejects the next frame

    def _answered(self, freed: int) -> None:
        self._unread = False

    def close(self) -> None:
        """End the session; the replica then reclaims the channel."""
        super().close()
        self._channel, self._capacity, self._unread = None, 0, False


def _chunks(buffers: Iterable[Buffer]) -> Iterator[memoryview]:
    """Divide buffers into chunks. Ray copies longer buffers with six threads, and starting the
    threads takes longer than the copy.
    """
    for buffer in buffers:
        for start in range(0, len(buffer), _CHUNK):
            yield memoryview(buffer)[start : start + _CHUNK]


def this_node() -> str | None:
    """Return the id of the Ray node of this process; None for a Ray client, or without Ray."""
    if private.node_of_this_process() is None:
        return None
    import ray

    node: str = ray.get_runtime_context().get_node_id()
    return node
