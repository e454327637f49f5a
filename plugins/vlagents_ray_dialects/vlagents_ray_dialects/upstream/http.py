"""Clients of the protocols over HTTP: OpenVLA's `vla-scripts/deploy.py`, SGLang's actions and
FlashRT's server.
"""

from __future__ import annotations

import abc
import base64
import http.client
import json
import re
import ssl
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar
from urllib.parse import urlsplit

import numpy as np

from vlagents_ray.client.http_connection import ServerConnection
from vlagents_ray.errors import (
    ConnectionLost,
    InvalidObservation,
    MessageTooLarge,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects.messages import openpi, openvla
from vlagents_ray_dialects.messages.outgoing import Outgoing
from vlagents_ray_dialects.upstream.client import Answer, ClientOptions, UpstreamClient

_BUSY = (408, 429, 502, 503, 504)  # statuses of an upstream that is busy or unavailable


class HttpClient(UpstreamClient):
    """A client that posts one observation per request, over a connection that stays open."""

    schemes: ClassVar[tuple[str, ...]] = ("http", "https")
    path: ClassVar[str]  # the path of the requests if the URL has no path
    about: ClassVar[str | None] = None  # path of the upstream's metadata, a JSON object
    media_type: ClassVar[str] = "application/json"

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._url = urlsplit(options.url)
        self._path = self._url.path.rstrip("/") or self.path
        self._headers = {"Content-Type": self.media_type, "Accept": self.media_type}
        if options.key is not None:
            self._headers["Authorization"] = f"Bearer {options.key}"
        self._connection: ServerConnection | None = None

    @abc.abstractmethod
    def encode(self, observation: Mapping[str, Any]) -> bytes:
        """Return the body of the request with an observation."""

    @abc.abstractmethod
    def decode(self, body: bytes) -> np.ndarray:
        """Return the actions in the body of an answer, (D,) or (H, D)."""

    @property
    def is_open(self) -> bool:
        """Whether the connection is open, as far as this process knows."""
        # uvicorn closes a connection that is idle for 5 s.
        return self._connection is not None and self._connection.is_open

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect, and return the upstream's metadata, if the protocol has some."""
        metadata: Any = {}
        if self.about is not None:
            self._open(timeout_s)
            path = f"{self._path.removesuffix(self.path)}{self.about}"
            try:
                metadata = json_numpy.loads(self._request("GET", path, None), self.options.limits)
            except VLAgentsError as error:
                raise PolicyUnavailable(f"{error}; expected its metadata at {path}") from error
            finally:
                self.close()  # the upstream may have closed the connection
        self._open(timeout_s)
        return metadata if isinstance(metadata, dict) else {}

    def _open(self, timeout_s: float) -> None:
        """Open a connection."""
        context = ssl.create_default_context() if self._url.scheme == "https" else None
        try:
            self._connection = ServerConnection(self._url, context, timeout_s)
        except OSError as error:
            raise self.unreachable(error) from error

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        return [self.decode(self._request("POST", self._path, self.encode(observation)))]

    def _request(self, method: str, path: str, content: bytes | None) -> bytes:
        """Send a request, and return the body of the answer."""
        if self._connection is None:
            raise self.closed()

        max_bytes = self.options.limits.body_bytes
        pieces = () if content is None else (content,)
        try:
            self._connection.send(method, path, self._headers, pieces, self.options.timeout_s)
            response = self._connection.receive(method)
            body = response.read(max_bytes + 1)
        except (http.client.HTTPException, OSError) as error:
            raise self.lost(error) from error

        if len(body) > max_bytes:
            self.close()
            raise MessageTooLarge(
                f"upstream {self.options.url}: expected an answer of at most {max_bytes} bytes, "
                "got a larger one"
            )
        if response.will_close:
            self.close()
        if response.status in _BUSY:
            raise ConnectionLost(
                f"upstream {self.options.url}: it answered with HTTP {response.status}"
            )
        if response.status != http.HTTPStatus.OK:
            raise self.failed(body[:2000], f"HTTP {response.status}")
        return body

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


class OpenVLAClient(HttpClient):
    """A client of `/act`, with arrays in the format of `json-numpy`."""

    mapping: ClassVar[str | None] = "openvla"
    path: ClassVar[str] = "/act"

    @staticmethod
    def is_nested(key: str) -> bool:  # noqa: ARG004 - overrides
        return False  # an observation is one flat map

    def encode(self, observation: Mapping[str, Any]) -> bytes:
        return openvla.encode(observation)

    def decode(self, body: bytes) -> np.ndarray:
        action = openvla.decode_action(body, self.options.limits)
        if action is None:
            raise self.failed("error")
        return action


class SGLangClient(HttpClient):
    """A client of SGLang's `/v1/actions`, in msgpack, which its WebSocket at `/openpi/policy`
    also uses.
    """

    path: ClassVar[str] = "/v1/actions/generations"
    about: ClassVar[str | None] = "/v1/actions/metadata"
    media_type: ClassVar[str] = "application/msgpack"

    def encode(self, observation: Mapping[str, Any]) -> bytes:
        return openpi.encode(
            {"input": {"observation": observation}, "runtime": {"response_format": "raw"}}
        )

    def decode(self, body: bytes) -> np.ndarray:
        return self.actions(openpi.decode(body, self.options.limits))


class FlashRTClient(HttpClient):
    """A client of FlashRT's `/predict`, which reads images without names in base64, in the order of
    the mapping.

    Without images the server draws random ones, without a prompt it uses the last prompt of any
    client, and if an image is missing, it uses the next one instead. So a mapping in which an image
    or the prompt is optional is rejected.
    """

    path: ClassVar[str] = "/predict"
    about: ClassVar[str | None] = "/health"
    takes_key: ClassVar[bool] = False

    def differences(self, metadata: Mapping[str, Any], outgoing: Outgoing) -> list[str]:
        """Return the entries of the mapping that FlashRT cannot read, each with its cure."""
        cameras = outgoing.mapping.cameras
        unfit = []
        for name, camera in cameras.items():
            if camera.optional or not re.fullmatch(r"images/[^/|*]+", camera.key):
                unfit.append(name)

        differences = []
        if unfit or not cameras:
            differences.append(
                f"cameras: expected images/NAME for each, none optional, got {unfit}; change "
                "mapping.cameras"
            )
        instruction = outgoing.mapping.instruction
        if instruction != "prompt":
            differences.append(
                f"instruction: expected 'prompt', got {instruction!r}; change mapping.instruction"
            )
        return differences

    def encode(self, observation: Mapping[str, Any]) -> bytes:
        images = list(observation["images"].values())
        shapes = sorted({image.shape for image in images})
        if len(shapes) != 1 or not observation.get("prompt"):
            raise InvalidObservation(
                f"flashrt: expected images of one shape and a prompt, got images of {shapes} and "
                f"the keys {sorted(observation)}; resize them, and reset with an instruction"
            )

        body: dict[str, Any] = {}
        for name, value in observation.items():
            body[name] = value.tolist() if isinstance(value, np.ndarray) else value
        body["images"] = [base64.b64encode(image.tobytes()).decode() for image in images]
        return json.dumps(body | {"image_shape": shapes[0]}).encode()

    def decode(self, body: bytes) -> np.ndarray:
        reply = json_numpy.loads(body, self.options.limits)
        actions = reply.get("actions") if isinstance(reply, dict) else None
        if not isinstance(actions, list):
            raise self.unreadable(type(actions).__name__, "a map with a list `actions`")
        return json_numpy.rows(actions)
