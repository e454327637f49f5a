"""`serve://APP`: from inside the Ray cluster, with the observation in plasma.

The Serve handle picks a replica once; from then on the session's requests go to that replica, since
a handle may send each request to another one.
"""

from __future__ import annotations

import pickle
import time
import uuid
from collections.abc import Sequence
from typing import Any

from vlagents_ray.errors import ConfigError, ConnectionLost, DeadlineExceeded, PolicyUnavailable, VLAgentsError
from vlagents_ray.wire.codecs import RAW
from vlagents_ray.wire.frames import decode_replies, encode_requests
from vlagents_ray.wire.messages import Reply, Request, boot_id

_PAUSE_S = 0.2  # before another replica is asked for in place of one that is gone
_LOOK_S = 10.0  # between two looks at where replicas are: they come and go
_FIRST_LOOK_S = 3.0  # what is waited for the first; an application without a replica does not answer


class HandleTransport:
    """Raw frames as plasma objects, read in place by the replica if it is on this node."""

    name = "handle"
    holds_sessions = False

    def __init__(self, app: str, *, must_be_near: bool = False) -> None:
        """`must_be_near`: only a replica on this machine will do, even if one elsewhere has far less to do."""
        self._must_be_near = must_be_near
        self._app = app
        self._session = uuid.uuid4().hex
        self._replica: Any = None

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Choose a replica, as long as those chosen turn out to be gone; returns the metadata."""
        import ray

        if not ray.is_initialized():
            raise ConfigError(
                f"serve://{self._app}: this process is in no Ray cluster; call ray.init() (`vlagents-ray eval` does, "
                f"with --address), or use http://"
            )
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                return self._attach(max(0.0, deadline - time.monotonic()))
            except ConnectionLost as error:  # Serve notices after a while that a node was lost
                if time.monotonic() + _PAUSE_S > deadline:
                    raise PolicyUnavailable(str(error)) from error
                time.sleep(_PAUSE_S)

    def _attach(self, timeout_s: float) -> dict[str, Any]:
        import ray
        from ray import serve
        from ray._private.worker import global_worker
        from ray.serve.exceptions import RayServeException

        try:
            handle = serve.get_app_handle(self._app)
            here = ray.get_runtime_context().get_node_id() if global_worker.connected else ""
            attaching = handle.attach.remote(here, boot_id(), self._must_be_near)
            metadata, self._replica = attaching.result(timeout_s=timeout_s)
        except ray.exceptions.RayTaskError as error:
            raise PolicyUnavailable(f"serve://{self._app}: {error.cause}") from error
        except RayServeException as error:
            raise PolicyUnavailable(f"serve://{self._app}: {error}") from error
        except TimeoutError as error:
            raise PolicyUnavailable(f"serve://{self._app}: no replica within {timeout_s:g} s") from error
        except ray.exceptions.RayError as error:
            raise ConnectionLost(f"serve://{self._app}: {error}") from error
        found: dict[str, Any] = metadata
        return found

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """One actor call; the frame lies in plasma and is freed with the reply."""
        import ray

        # A bare buffer, which lies in plasma apart from its pickle: an array's pickle depends on the numpy.
        content = pickle.PickleBuffer(encode_requests(requests, RAW))
        try:
            frame = ray.put(content)
        except ray.exceptions.RayError as error:  # neither the object store nor the disk has room
            raise PolicyUnavailable(
                f"serve://{self._app}: {len(content.raw())} bytes cannot be sent: {error}"
            ) from error
        pending = call_replica(self._replica, "call", self._session, frame, request_id=requests[0].request_id)
        try:
            return decode_replies(ray.get(pending, timeout=timeout_s))
        except ray.exceptions.GetTimeoutError as error:
            ray.cancel(pending)
            raise DeadlineExceeded(f"serve://{self._app}: no answer within {timeout_s:g} s") from error
        except ray.exceptions.RayTaskError as error:  # nobody knows how far it came
            raise ConnectionLost(f"serve://{self._app}: the replica failed: {error.cause}; reset again") from error
        except ray.exceptions.RayError as error:  # the replica is gone, or its node with the frame or the answer
            raise self._lost(error) from error

    def ask(self, method: str, *args: Any, timeout_s: float) -> Any:
        """What a method of the chosen replica returns; what it raises of ours is raised here."""
        import ray

        try:
            return ray.get(call_replica(self._replica, method, *args), timeout=timeout_s)
        except ray.exceptions.GetTimeoutError as error:
            raise DeadlineExceeded(f"serve://{self._app}: no answer within {timeout_s:g} s") from error
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, VLAgentsError):
                raise error.cause from None
            raise PolicyUnavailable(f"serve://{self._app}: {error.cause}") from error
        except ray.exceptions.RayError as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Forget the replica."""
        self._replica = None

    def _lost(self, error: Exception) -> ConnectionLost:
        return ConnectionLost(f"serve://{self._app}: the replica is gone ({type(error).__name__}); reset again")


class ReplicaNodes:
    """On which nodes an application has its replicas, as a caller learns it who has no time to wait."""

    def __init__(self, app: str) -> None:
        self._app = app
        self._nodes: dict[str, int] = {}
        self._asked: float | None = None  # when it was
        self._answer: Any = None  # that is yet to come

    def look(self) -> dict[str, int]:
        """How many replicas there are on which node, by Ray's id, as of the last answer; {} if that is not known."""
        import ray
        from ray import serve
        from ray.serve.exceptions import RayServeException

        now, wait_s = time.monotonic(), 0.0 if self._asked is not None else _FIRST_LOOK_S
        try:
            if self._answer is None and (self._asked is None or now - self._asked > _LOOK_S):
                self._asked = now
                self._answer = serve.get_app_handle(self._app).nodes.remote()
            if self._answer is not None:
                self._nodes = self._answer.result(timeout_s=wait_s)
                self._answer = None
        except TimeoutError:
            pass  # it comes later
        except (RayServeException, ray.exceptions.RayError):
            self._nodes, self._answer = {}, None
        return self._nodes


def call_replica(replica: Any, method: str, *args: Any, request_id: str = "") -> Any:
    """A method of a certain replica, which a Serve handle cannot call: what Serve's own router sends to one."""
    from ray.serve._private.common import RequestMetadata

    request_id = request_id or uuid.uuid4().hex
    metadata = RequestMetadata(request_id=request_id, internal_request_id=request_id, call_method=method)
    return replica.handle_request.remote(pickle.dumps(metadata), *args)
