"""The Serve handle transport, `serve://APP`: from inside the Ray cluster, with the observation in plasma.

The Serve handle picks a replica once; from then on the session's requests go to that replica, since a handle may send
each request to another one.
"""

from __future__ import annotations

import pickle
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from vlagents_ray.client.transports.base import ConnectReport, first_timeout_s
from vlagents_ray.errors import ConfigError, ConnectionLost, DeadlineExceeded, PolicyUnavailable, VLAgentsError
from vlagents_ray.images.codecs import RAW
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import Reply, Request, boot_id
from vlagents_ray.ray_tools.private import is_connected, replica_request

_PAUSE_S = 0.2  # s before another replica is requested in place of one that is gone
_QUERY_S = 10.0  # s between two queries for the replicas' nodes, which change over time
_FIRST_QUERY_S = 3.0  # s to wait for the first query; an application without a replica does not answer


class ClientApi(Protocol):
    """The methods of a replica that clients inside the cluster call.

    `vlagents_ray.serve.replica.replica.PolicyReplica` implements them.
    """

    async def attach(self, node: str = "", boot_id: str = "", must_be_near: bool = False) -> tuple[dict[str, Any], Any]:
        """Return the metadata of the replica that suits a client on that node best, and its actor."""
        ...

    async def call(self, session_id: str, frame: Any) -> bytes:
        """Return the replies to a frame of requests."""
        ...

    async def lease(self, length: int) -> tuple[bytes, int]:
        """Lease a plasma channel for frames of `length` bytes; return its id and its capacity in bytes."""
        ...

    async def nodes(self) -> dict[str, int]:
        """Return the number of replicas that accept sessions on each node."""
        ...


class HandleTransport:
    """Sends raw frames as plasma objects, which the replica reads in place if it is on this node."""

    name = "handle"
    holds_sessions = False

    def __init__(self, app: str, *, must_be_near: bool = False) -> None:
        """Set the application.

        `must_be_near` accepts only a replica on this machine, even if others have far less load.
        """
        self._must_be_near = must_be_near
        self._app = app
        self._session = uuid.uuid4().hex
        self._replica: Any = None

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Choose a replica, again if the chosen one is gone; return the metadata."""
        import ray

        if not ray.is_initialized():
            raise ConfigError(
                f"serve://{self._app}: this process is in no Ray cluster; call ray.init() (`vlagents-ray eval` does, "
                f"with --address), or use http://"
            )
        deadline = time.monotonic() + timeout_s
        attempt_s, report = first_timeout_s(timeout_s), ConnectReport(f"serve://{self._app}", timeout_s)
        while True:
            try:
                return self._attach(max(0.0, min(attempt_s, deadline - time.monotonic())))
            except ConnectionLost as error:  # Serve takes a while to notice that a node was lost
                if time.monotonic() + _PAUSE_S > deadline:
                    raise PolicyUnavailable(str(error)) from error
                report.failed(error)
                time.sleep(_PAUSE_S)
            except DeadlineExceeded as error:  # for instance of a hung replica: the handle may choose another
                if time.monotonic() >= deadline:
                    raise PolicyUnavailable(f"serve://{self._app}: no replica within {timeout_s:g} s") from error
                report.failed(error)
                attempt_s *= 2

    def _attach(self, timeout_s: float) -> dict[str, Any]:
        import ray
        from ray import serve
        from ray.serve.exceptions import RayServeException

        try:
            handle = serve.get_app_handle(self._app)
            here = ray.get_runtime_context().get_node_id() if is_connected() else ""
            attaching = handle.attach.remote(here, boot_id(), self._must_be_near)
            metadata, self._replica = attaching.result(timeout_s=timeout_s)
        except ray.exceptions.RayTaskError as error:
            raise PolicyUnavailable(f"serve://{self._app}: {error.cause}") from error
        except RayServeException as error:
            raise PolicyUnavailable(f"serve://{self._app}: {error}") from error
        except TimeoutError as error:
            attaching.cancel()
            raise DeadlineExceeded(f"serve://{self._app}: no replica within {timeout_s:g} s") from error
        except ray.exceptions.RayError as error:
            raise ConnectionLost(f"serve://{self._app}: {error}") from error
        found: dict[str, Any] = metadata
        return found

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Make one actor call; the frame lies in plasma and is freed with the reply."""
        import ray

        # A bare buffer lies in plasma apart from its pickle; an array's pickle depends on the version of numpy.
        content = pickle.PickleBuffer(encode_requests(requests, RAW))
        try:
            frame = ray.put(content)
        except ray.exceptions.RayError as error:  # neither the object store nor the disk has room
            raise PolicyUnavailable(
                f"serve://{self._app}: {len(content.raw())} bytes cannot be sent: {error}"
            ) from error
        pending = call_replica(self._replica, ClientApi.call, self._session, frame, request_id=requests[0].request_id)
        try:
            return decode_replies(ray.get(pending, timeout=timeout_s))
        except ray.exceptions.GetTimeoutError as error:
            ray.cancel(pending)
            raise DeadlineExceeded(f"serve://{self._app}: no answer within {timeout_s:g} s") from error
        except ray.exceptions.RayTaskError as error:  # it is unknown whether the replica acted on the request
            raise ConnectionLost(f"serve://{self._app}: the replica failed: {error.cause}; reset again") from error
        except ray.exceptions.RayError as error:  # the replica is gone, or its node with the frame or the answer
            raise self._lost(error) from error

    def lease(self, length: int, timeout_s: float) -> tuple[bytes, int]:
        """Call `ClientApi.lease` of the chosen replica; errors of this package are raised here."""
        import ray

        try:
            leased: tuple[bytes, int] = ray.get(call_replica(self._replica, ClientApi.lease, length), timeout=timeout_s)
        except ray.exceptions.GetTimeoutError as error:
            raise DeadlineExceeded(f"serve://{self._app}: no answer within {timeout_s:g} s") from error
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, VLAgentsError):
                raise error.cause from None
            raise PolicyUnavailable(f"serve://{self._app}: {error.cause}") from error
        except ray.exceptions.RayError as error:
            raise self._lost(error) from error
        return leased

    def close(self) -> None:
        """Forget the replica."""
        self._replica = None

    def _lost(self, error: Exception) -> ConnectionLost:
        return ConnectionLost(f"serve://{self._app}: the replica is gone ({type(error).__name__}); reset again")


class ReplicaNodes:
    """The nodes on which an application has its replicas, queried without blocking the caller for long."""

    def __init__(self, app: str) -> None:
        self._app = app
        self._nodes: dict[str, int] = {}
        self._asked: float | None = None  # time.monotonic() of the last query
        self._answer: Any = None  # the pending answer

    def query(self) -> dict[str, int]:
        """Return the number of replicas on each node, by Ray's id, as of the last answer; {} if it is not known."""
        import ray
        from ray import serve
        from ray.serve.exceptions import RayServeException

        now, wait_s = time.monotonic(), 0.0 if self._asked is not None else _FIRST_QUERY_S
        try:
            if self._answer is None and (self._asked is None or now - self._asked > _QUERY_S):
                self._asked = now
                self._answer = serve.get_app_handle(self._app).nodes.remote()
            if self._answer is not None:
                self._nodes = self._answer.result(timeout_s=wait_s)
                self._answer = None
        except TimeoutError:
            pass  # the answer comes later
        except (RayServeException, ray.exceptions.RayError):
            self._nodes, self._answer = {}, None
        return self._nodes


def call_replica(replica: Any, method: Callable[..., Any], *args: Any, request_id: str = "") -> Any:
    """Call a method of one replica, as Serve's own router does; a Serve handle cannot choose its replica.

    `method` is one of `ClientApi`, or one that replicas call on each other.
    """
    header = replica_request(request_id or uuid.uuid4().hex, method.__name__)
    return replica.handle_request.remote(header, *args)
