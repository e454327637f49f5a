"""The `Publisher`, which pushes a learner's weights to served policies, and its three kinds of
targets.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import asdict
from itertools import chain
from typing import Any
from urllib.parse import urlencode

from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.http import HttpTransport, http_url
from vlagents_ray.client.transports.websocket import ProxiedSocket, open_websocket
from vlagents_ray.errors import (
    ConfigError,
    Forbidden,
    InvalidWeights,
    PolicyUnavailable,
    UnknownApp,
    VLAgentsError,
)
from vlagents_ray.protocol.frames import read_error
from vlagents_ray.registry import pip_install
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.weights import PushMode, PushOptions, Rest
from vlagents_ray.weights.safetensors import MESSAGE_BYTES, header_of, parts_of
from vlagents_ray.weights.shared_values import NotShared, gpu_of, shared
from vlagents_ray.weights.trainable import is_array, portable
from vlagents_ray_learn.weight_push import ThisReplica, Values, WeightPusher, WeightsReplica
from vlagents_ray_learn.weights_endpoint import PART, PATH

logger = logging.getLogger(__name__)

_ANSWER_S = 10.0  # time limit for the request of the versions
_PART_S = 60.0  # time limit for sending a part of 1 MiB
_PUSH_S = 600.0  # time limit for a push, which includes the transfer to all nodes
_DISTRIBUTION = "vlagents-ray-learn"
# The number of parts, 1 MiB each, that may be unacknowledged on the network. With one, each part
# would take a round trip.
_WINDOW = 16


class Publisher(AbstractContextManager["Publisher"]):
    """Pushes new weights from the learner's memory to a served policy, without a checkpoint.

        # Or "https://gpu:8000", with a key of the scope "weights".
        with Publisher("serve://pi0") as weights:
            version = weights.push(model.state_dict())
            assert weights.acknowledged(version) == 2  # replicas

    Every replica checks and stores a version before any replica uses it, so that a push succeeds at
    all replicas or at none.
    """

    def __init__(
        self,
        target: str | Engine,
        *,
        api_key: str | None = None,
        ca: str | os.PathLike[str] | None = None,
        certificate: tuple[str | os.PathLike[str], str | os.PathLike[str]] | None = None,
    ) -> None:
        """Connect to the policy.

        Args:
            target: "serve://APP", from a process in the Ray cluster; the URL of a server,
                "http(s)://HOST:PORT"; or an engine in this process.
            api_key: A key of the scope "weights", for a URL; by default the value of
                `VLAGENTS_RAY_API_KEY`.
            ca: As for `RemoteAgent`.
            certificate: As for `RemoteAgent`.

        Raises:
            ConfigError: The target is none of these, or this process is not in a Ray cluster.
        """
        self._target: EngineTarget | AppTarget | ServerTarget
        if isinstance(target, Engine):
            self._target = EngineTarget(target)
        elif isinstance(target, str) and target.startswith("serve://"):
            self._target = AppTarget(target.removeprefix("serve://").rstrip("/"))
        elif isinstance(target, str) and target.startswith(("http://", "https://")):
            self._target = ServerTarget(target, Credentials(api_key, ca, certificate))
        else:
            raise ConfigError(
                "Publisher: expected 'serve://APP', 'http(s)://HOST:PORT' or an Engine, got "
                f"{target!r}"
            )

    def push(
        self,
        values: Mapping[str, Any],
        *,
        mode: PushMode = "next_episode",
        partial: bool = False,
        allow_same: bool = False,
        pin: bool = False,
        version: int | None = None,
    ) -> int:
        """Push new weights to the policy, and return their version once all replicas have them.

        Args:
            values: The values under the names of `Trainable.parameters`: numpy or JAX arrays or
                torch tensors, e.g. a `state_dict`. They are copied before this method returns, so
                that the learner can continue.
            mode: When sessions that follow the newest version change to it: at their next reset
                ("next_episode"), or between two calls of the policy ("keep"). Robots follow only if
                they reset with `weights="follow"`.
            partial: Whether names may be missing, as when only some layers are trained. The missing
                values do not change.
            allow_same: Whether all values may be equal to the values of the policy.
            pin: Whether robots, and other sessions that do not follow the newest version, also use
                this version after their next reset.
            version: The number of the version, such as the step of training; by default the number
                of the newest version + 1.

        Returns:
            The version, as in `act.info["policy"]["version"]`.

        Raises:
            InvalidWeights: The values do not fit the policy; nothing was changed.
            UnchangedWeights: The values are equal to the values of the policy.
            InvalidInput: The version is not above the newest one.
            NotTrainable: The policy names no parameters to train.
            Overloaded: Another push is in progress.
            PolicyUnavailable: A replica cannot be reached; nothing was changed.
            Forbidden: The API key lacks the scope "weights".
            ConfigError: The server does not accept weights, since it lacks this package.
        """
        if not isinstance(values, Mapping):
            raise InvalidWeights(
                "weights: expected values by name, such as a state_dict, got "
                f"{type(values).__name__}"
            )
        return self._target.push(values, PushOptions(mode, partial, allow_same, pin, version))

    def sleep(self, *, offload: bool = True, at_most_s: float = 600.0) -> None:
        """Stop the policy while the learner needs the GPU.

        Running batches finish first. Requests wait until `wake`.

        Args:
            offload: Whether to move the weights to the memory of the host, and free CUDA graphs.
                Otherwise both stay on the GPU, and only unused memory is freed.
            at_most_s: The time after which the policy wakes by itself, s. The learner may have
                died.

        Raises:
            NotTrainable: The policy names no parameters, which `offload` would move.
            Overloaded: The policy is already asleep.
            PolicyUnavailable: A replica cannot be reached; the others are awake.
            Forbidden: The API key lacks the scope "weights".
        """
        self._target.rest(Rest("sleep", offload, at_most_s))

    def wake(
        self, values: Mapping[str, Any] | None = None, *, mode: PushMode = "keep", **options: Any
    ) -> int | None:
        """Let the policy answer requests again after `sleep`, with the same weights or new ones.

        Free the learner's memory on the GPU before this call.

        Args:
            values: New weights for the policy; None keeps the weights that it had before `sleep`.
            mode: As for `push`.
            options: Further options of `push`.

        Returns:
            The version of the new weights; None if there are none.

        Raises:
            PolicyUnavailable: The GPU has too little memory; the policy is still asleep.
            VLAgentsError: The errors of `push`. The policy then uses its former weights.
        """
        self._target.rest(Rest("restore"))
        try:
            return None if values is None else self.push(values, mode=mode, **options)
        finally:
            self._target.rest(Rest("wake"))

    def acknowledged(self, version: int) -> int:
        """Return the number of replicas that use this version or a later one.

        Args:
            version: The result of `push`.
        """
        return sum(newest >= version for newest in self._target.versions())

    def close(self) -> None:
        """Close the connection. The policy keeps its weights."""

    def __exit__(self, *exc: object) -> None:
        self.close()


class EngineTarget:
    """An engine in this process.

    Tensors are copied once, on their device. The three kinds of targets have the same methods:
    `push` returns the version, `rest` makes all replicas sleep, restore their memory or wake, and
    `versions` returns the newest version of each replica.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    def push(self, values: Mapping[str, Any], options: PushOptions) -> int:
        return asyncio.run(self._pusher().push(values, options)).version

    def rest(self, rest: Rest) -> None:
        asyncio.run(self._pusher().rest(rest))

    def _pusher(self) -> WeightPusher:
        return WeightPusher(ThisReplica("this process", self._engine.weights), _no_siblings)

    def versions(self) -> list[int]:
        return [self._engine.weights.number]


class AppTarget:
    """An application of this process's Ray cluster.

    If the learner and all replicas have their weights on the same GPU, the replicas copy the
    weights from the learner's memory. Otherwise, the values are put into Ray's object store once.
    All replicas of this node read the values there, without a copy if the policy is on the CPU. Ray
    transfers the values once to each other node.
    """

    def __init__(self, app: str) -> None:
        """Push to the application `app`.

        Raises:
            ConfigError: This process is not in a Ray cluster.
        """
        import ray

        if not ray.is_initialized():
            raise ConfigError(
                f"serve://{app}: this process is in no Ray cluster; call ray.init() first"
            )
        self._app = app

    def push(self, values: Mapping[str, Any], options: PushOptions) -> int:
        """Push through the GPU's memory if possible, otherwise through the object store."""
        if gpu_of(values):
            try:
                with shared(values) as shared_values:
                    return self._push(shared_values, options)
            except NotShared as error:
                logger.info(
                    "serve://%s: the weights are sent through Ray's object store: %s",
                    self._app,
                    error,
                )
        import ray

        return self._push([ray.put(_portable(values))], options)

    def _push(self, values: Values, options: PushOptions) -> int:
        return int(self._call("push", values, options, timeout_s=_PUSH_S).version)

    def rest(self, rest: Rest) -> None:
        self._call("rest_all", rest, timeout_s=_PUSH_S)

    def versions(self) -> list[int]:
        return list(self._call("versions", timeout_s=_ANSWER_S))

    def _call(self, method: str, *args: Any, timeout_s: float) -> Any:
        """Call a method of the `WeightsPart` of any replica.

        The method is passed as a name, since the part's module imports Ray, which this module does
        not need.
        """
        import ray
        from ray import serve
        from ray.serve.exceptions import RayServeException

        try:
            handle = serve.get_app_handle(self._app)
            answer = handle.call_part.remote(PART, method, *args).result(timeout_s=timeout_s)
        except ray.exceptions.RayTaskError as error:
            if type(error.cause) is LookupError:  # raised by `ReplicaParts.call`
                raise _has_no_part(f"serve://{self._app}") from error
            raise PolicyUnavailable(f"serve://{self._app}: {error.cause}") from error
        except (RayServeException, ray.exceptions.RayError, TimeoutError) as error:
            raise _unknown_outcome(f"serve://{self._app}", error) from error
        if isinstance(answer, VLAgentsError):
            raise answer
        return answer


class ServerTarget:
    """A server, which may be on another machine.

    Each push opens a WebSocket and sends the values in parts.
    """

    def __init__(self, url: str, credentials: Credentials) -> None:
        """Push to the server at a URL.

        Args:
            url: "http(s)://HOST:PORT", with the path of an application if it has one.
            credentials: The API key and the certificates.
        """
        base = http_url(url)
        credentials.use_at(base.geturl())
        self._credentials = credentials
        self._base = url
        scheme = "wss" if base.scheme == "https" else "ws"
        self._url = base._replace(scheme=scheme, path=base.path.rstrip("/") + PATH).geturl()

    def push(self, values: Mapping[str, Any], options: PushOptions) -> int:
        """Send the header, wait for its answer, and then send the parts of the values."""
        arrays = _portable(values)
        for name, value in arrays.items():
            if not is_array(value):
                raise InvalidWeights(
                    f"weights: {name!r}: expected an array, got {type(value).__name__}"
                )
        header = header_of(arrays)
        if len(header) > MESSAGE_BYTES:
            raise InvalidWeights(
                f"weights: {len(arrays)} names take {len(header)} bytes, the limit is "
                f"{MESSAGE_BYTES}"
            )

        query = {
            name: str(value).lower() for name, value in asdict(options).items() if value is not None
        }
        with self._explained():
            socket = open_websocket(f"{self._url}?{urlencode(query)}", self._credentials, _ANSWER_S)

        with closing(socket):
            unanswered = 0
            window = 1  # the server answers the header before any value is sent
            for message in chain((header,), parts_of(arrays)):
                # If the connection is closed, the server has rejected the push, and its answer has
                # the reason.
                with suppress(ConnectionClosed, OSError):
                    socket.send(message, _PART_S)
                unanswered += 1
                if unanswered >= window:
                    answer = self._receive_answer(socket)
                    unanswered -= 1
                    window = _WINDOW
            for _ in range(unanswered):
                answer = self._receive_answer(socket)
        return int(answer["version"])

    def _receive_answer(self, socket: ProxiedSocket) -> dict[str, Any]:
        """Return the answer to the oldest unacknowledged part.

        If the answer is an error, raise it.
        """
        try:
            answer: dict[str, Any] = json.loads(socket.recv(_PUSH_S))
        except (ConnectionClosed, OSError) as error:
            if _is_refused(error):
                self.versions()  # raises the reason
            raise _unknown_outcome(self._url, error) from error
        if "code" in answer:
            raise read_error(answer)
        return answer

    def rest(self, rest: Rest) -> None:
        query = urlencode({"offload": str(rest.offload).lower(), "at_most_s": rest.at_most_s})
        with self._explained(), self._http() as http:
            http.get(f"{PATH}/{rest.step}?{query}", _PUSH_S, method="POST")

    def versions(self) -> list[int]:
        with self._explained(), self._http() as http:
            return list(http.get(PATH, _ANSWER_S)["versions"])

    def _http(self) -> closing[HttpTransport]:
        return closing(HttpTransport(self._base, CodecChoice("raw"), self._credentials))

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Raise errors of a server without the part, which lacks these paths, with an
        explanation.
        """
        try:
            yield
        except (Forbidden, UnknownApp) as error:
            if self._may_have_part():
                raise
            raise _has_no_part(self._base) from error

    def _may_have_part(self) -> bool:
        """Return whether the server's metadata contains the part, or cannot be read."""
        try:
            with self._http() as http:
                return PART in http.get("/v1/metadata", _ANSWER_S)["parts"]
        except (VLAgentsError, LookupError):
            return True


def _portable(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values by name, with arrays and tensors converted to numpy arrays."""
    return {name: portable(value) if is_array(value) else value for name, value in values.items()}


def _is_refused(error: Exception) -> bool:
    """Return whether the server closed the connection because of this client, for instance because
    its key was revoked.
    """
    return (
        isinstance(error, ConnectionClosed)
        and error.rcvd is not None
        and error.rcvd.code == CloseCode.POLICY_VIOLATION
    )


def _has_no_part(url: str) -> ConfigError:
    return ConfigError(
        f"{url}: this server takes no new weights; run `{pip_install(distribution=_DISTRIBUTION)}` "
        f"in its environment, and remove `{PART}: null` from the `parts` of its deployment file"
    )


def _unknown_outcome(url: str, error: Exception) -> PolicyUnavailable:
    return PolicyUnavailable(
        f"{url}: {str(error) or 'no answer'}; whether it acts with the version is unknown: look at "
        "`acknowledged`, and push again"
    )


async def _no_siblings() -> Sequence[WeightsReplica]:
    return ()
