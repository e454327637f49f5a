"""Clients of the protocols over WebSockets: openpi's (single observations and batches), RoboArena's
and vla-eval's.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import inspect
import logging
import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.protocol import State
from websockets.sync.client import connect

from vlagents_ray.client.limited_websocket import LimitedWebSocket, SharedConnection
from vlagents_ray.errors import PolicyUnavailable, Unauthorized, VLAgentsError, shown
from vlagents_ray_dialects.messages import openpi, vla_eval
from vlagents_ray_dialects.messages.outgoing import Outgoing
from vlagents_ray_dialects.upstream.client import Answer, ClientOptions, UpstreamClient

_LOG = logging.getLogger("vlagents_ray.upstream.websocket")
# `websockets` logs each lost connection as an error, but also raises it.
_LOG.setLevel(logging.CRITICAL)
_CLOSE_S = 1  # the time limit for the closing handshake, s
_REFUSED = (401, 403)  # statuses of an upstream that rejects the API key
# No pings are sent, since an upstream that computes on its event loop does not answer them during
# the computation. Older versions of `websockets` never send pings.
_NO_PINGS: dict[str, Any] = (
    {"ping_interval": None} if "ping_interval" in inspect.signature(connect).parameters else {}
)


class WebSocketClient(UpstreamClient):
    """A client over a WebSocket, with limits on the size of messages and on the waiting time.

    A separate thread answers the upstream's pings, so that a connection stays open while no session
    sends requests.
    """

    schemes: ClassVar[tuple[str, ...]] = ("ws", "wss")
    # The word before the API key in the header `Authorization`.
    key_scheme: ClassVar[str] = "Bearer"

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._headers: dict[str, str] = {}
        if options.key is not None:
            self._headers["Authorization"] = f"{self.key_scheme} {options.key}"
        self._websocket: LimitedWebSocket | None = None
        self._open = contextlib.ExitStack()

    @property
    def is_open(self) -> bool:
        websocket = self._websocket
        return websocket is not None and websocket.connection.protocol.state is State.OPEN

    def open(self, timeout_s: float) -> None:
        """Connect.

        Raises:
            PolicyUnavailable: The upstream cannot be reached.
            Unauthorized: It rejects the API key.
        """
        url = self.options.url
        try:
            opening = connect(
                url,
                open_timeout=timeout_s,
                close_timeout=_CLOSE_S,
                compression=None,
                max_size=self.options.limits.body_bytes,
                additional_headers=self._headers,
                create_connection=SharedConnection,
                logger=_LOG,
                **_NO_PINGS,
            )
            self._websocket = LimitedWebSocket(self._open.enter_context(opening))
        except InvalidStatus as error:
            if error.response.status_code in _REFUSED:
                raise Unauthorized(
                    f"upstream {url}: it rejects the API key (HTTP {error.response.status_code}); "
                    "name the environment variable with the right one in key_env"
                ) from error
            raise PolicyUnavailable(
                f"upstream {url}: rejected the connection with HTTP {error.response.status_code}"
            ) from error
        except (OSError, InvalidHandshake, ConnectionClosed, TimeoutError) as error:
            raise self.unreachable(error) from error

    def send(self, message: bytes) -> None:
        """Send a message; raise `ConnectionLost` if the upstream does not accept it in time."""
        try:
            self._opened().send(message, self.options.timeout_s)
        except (ConnectionClosed, OSError) as error:
            raise self.lost(error) from error

    def recv(self, timeout_s: float | None = None) -> bytes | str:
        """Return the next message.

        Raises:
            ConnectionLost: The connection is lost, or no message arrives in time.
        """
        wait_s = self.options.timeout_s if timeout_s is None else timeout_s
        try:
            return self._opened().connection.recv(timeout=wait_s)
        except TimeoutError as error:
            raise self.lost(f"no answer within {wait_s:.3g} s") from error
        except (ConnectionClosed, OSError) as error:
            raise self.lost(error) from error

    def close(self) -> None:
        websocket, self._websocket = self._websocket, None
        if websocket is not None:
            websocket.close(2 * _CLOSE_S)
        self._open.close()

    def _opened(self) -> LimitedWebSocket:
        """Return the connection; raise `ConnectionLost` if it is closed."""
        if self._websocket is None:
            raise self.closed()
        return self._websocket


class OpenPiClient(WebSocketClient):
    """A client of servers with openpi's protocol, which keep no state between observations."""

    key_scheme = "Api-Key"  # as openpi_client.websocket_client_policy sends it

    @staticmethod
    def is_nested(key: str) -> bool:
        """Return whether a key is a path, as `images/cam_high` is; openpi's keys under
        `observation/` are not.
        """
        return not key.startswith("observation/")

    def connect(self, timeout_s: float) -> dict[str, Any]:
        self.open(timeout_s)
        try:
            return self._map(self.recv(timeout_s))
        except VLAgentsError as error:
            self.close()
            raise PolicyUnavailable(
                f"{error}; expected its metadata as the first message"
            ) from error

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        return [self.actions(self._call(observation))]

    def _call(self, message: Mapping[str, Any]) -> Any:
        """Send a message, and return the value of its reply."""
        self.send(openpi.encode(message))
        return self._read(self.recv())

    def _read(self, data: bytes | str) -> Any:
        """Return the value of a reply."""
        return self._map(data)

    def _map(self, data: bytes | str) -> dict[str, Any]:
        """Return the map in a message; an error that is a text, or has the key `error`, ends the
        connection.
        """
        reply = data if isinstance(data, str) else openpi.decode(data, self.options.limits)
        value: dict[str, Any] = self._without_error(reply)
        return value

    def _without_error(self, reply: Any) -> Any:
        """Return a reply; raise `PolicyFailed` if it is an error. openpi's errors are texts,
        SGLang's and vLLM-Omni's are maps.
        """
        if isinstance(reply, str):
            self.close()
            raise self.failed(reply)
        if isinstance(reply, dict) and reply.get("error") is not None:
            self.close()
            raise self.failed(reply["error"])
        if isinstance(reply, dict) and reply.get("type") == "error":
            raise self.failed(reply.get("message"))
        return reply


class OpenPiBatchClient(OpenPiClient):
    """A client that sends `{"batch": [...]}`, as in openpi's pull request 941 and in our own
    dialect.
    """

    batches: ClassVar[bool] = True

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        actions = self.actions(self._call({"batch": list(observations)}))
        if actions.ndim != 3 or len(actions) != len(observations):
            raise self.unreadable(
                f"actions {actions.shape}", f"({len(observations)}, H, D), one chunk an observation"
            )
        return list(actions)


_RESET = "reset successful"  # the answer of RoboArena's servers to `reset`


class RoboArenaClient(OpenPiClient):
    """A client of RoboArena's servers, which keep a session for each `session_id` and have a
    reset.
    """

    keeps_sessions: ClassVar[bool] = True
    mapping: ClassVar[str | None] = "roboarena"

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._session = uuid.uuid4().hex

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        reply = self._call({**observation, "endpoint": "infer", "session_id": self._session})
        return [reply if isinstance(reply, np.ndarray) else self.actions(reply)]

    def begin(self) -> None:
        self._session = uuid.uuid4().hex
        self.send(openpi.encode({"endpoint": "reset"}))
        answer = self.recv()
        if answer != _RESET:
            # vLLM-Omni answers with a map; any text other than `_RESET` is an error.
            self._read(answer)

    def differences(self, metadata: Mapping[str, Any], outgoing: Outgoing) -> list[str]:
        """Return a message for each camera that the upstream needs and the mapping lacks, with its
        cure.
        """
        differences = []
        cameras = [camera.key.partition("|")[0] for camera in outgoing.mapping.cameras.values()]
        wrist_cameras = [key for key in cameras if "wrist" in key]

        # vLLM-Omni's π0 has no key with "exterior", so all cameras but the wrist's are external.
        have = len(cameras) - len(wrist_cameras)
        external = metadata.get("n_external_cameras")
        if isinstance(external, int) and external > have:
            differences.append(
                f"cameras: expected {external} external ones, which the upstream needs, got "
                f"{have} in the mapping; add them to mapping.cameras"
            )
        if metadata.get("needs_wrist_camera") is True and not wrist_cameras:
            differences.append(
                "cameras: expected one at the wrist, which the upstream needs, got none in the "
                "mapping; add it to mapping.cameras"
            )
        return differences

    def _read(self, data: bytes | str) -> Any:
        """Return a map, or the array that older servers and vLLM-Omni send."""
        reply = data if isinstance(data, str) else openpi.decode_any(data, self.options.limits)
        return self._without_error(reply)


# The keys of a server's `hello` that are its metadata.
_METADATA_KEYS = (
    "model_server",
    "harness_version",
    "protocol_version",
    "observation_params",
    "action_spec",
)


class VlaEvalClient(WebSocketClient):
    """A client that announces episodes, and requests one action per step."""

    keeps_sessions: ClassVar[bool] = True
    mapping: ClassVar[str | None] = "vla-eval"

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._seq = 0  # the number of the last message
        self._begun = -1  # the number of the last message that began an episode

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect, and return the upstream's metadata."""
        self.open(timeout_s)
        version = importlib.metadata.version("vlagents-ray")
        payload = {
            "harness_version": f"vlagents-ray {version}",
            "protocol_version": vla_eval.PROTOCOL_VERSION,
        }
        try:
            self._send("hello", payload)
            hello = self._answer("hello", timeout_s)
        except VLAgentsError as error:
            self.close()
            raise PolicyUnavailable(f"{error}; it did not answer `hello`") from error

        theirs = hello.get("protocol_version")
        if theirs != vla_eval.PROTOCOL_VERSION:
            self.close()
            raise PolicyUnavailable(
                f"upstream {self.options.url}: expected protocol version "
                f"{vla_eval.PROTOCOL_VERSION}, got {shown(theirs, 20)}"
            )
        return {key: hello[key] for key in _METADATA_KEYS if key in hello}

    def begin(self) -> None:
        self._send("episode_start", {})
        self._begun = self._seq

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        """Send one observation, and return its action."""
        [observation] = observations
        self._send("observation", dict(observation))
        payload = self._answer("action", self.options.timeout_s)
        actions = payload.get("actions", payload.get("action"))
        if isinstance(actions, list):
            are_numbers = all(isinstance(value, int | float) for value in actions)
            actions = np.asarray(actions, np.float32) if are_numbers else None
        if not isinstance(actions, np.ndarray):
            raise self.unreadable(
                sorted(map(str, payload))[:8], "a payload with an array `actions`"
            )
        return [actions]

    def differences(self, metadata: Mapping[str, Any], outgoing: Outgoing) -> list[str]:
        """Return a message about the state, with its cure, if the upstream needs it and the mapping
        lacks it.
        """
        params = metadata.get("observation_params")
        wants_state = isinstance(params, dict) and params.get("send_state") is True
        if wants_state and not outgoing.mapping.state:
            sentence = (
                "state: expected one, which the upstream needs (send_state), got none in the "
                "mapping; add it to mapping.state"
            )
            return [sentence]
        return []

    def _send(self, message_type: vla_eval.Kind, payload: dict[str, Any]) -> None:
        """Send a message with the next number."""
        self._seq += 1
        self.send(vla_eval.encode(vla_eval.VlaEvalMessage(message_type, payload, self._seq)))

    def _answer(self, message_type: vla_eval.Kind, timeout_s: float) -> dict[str, Any]:
        """Return the payload of the answer to the last message, which has the given type; skip
        older answers.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            data = self.recv(max(0.0, deadline - time.monotonic()))
            if isinstance(data, str):
                self.close()
                raise self.unreadable("a text", "a binary map")
            message = vla_eval.decode(data, self.options.limits)
            if message.kind == "error" and message.seq in (self._seq, self._begun):
                raise self.failed(message.payload)
            if message.seq == self._seq and message.kind == message_type:
                return message.payload
