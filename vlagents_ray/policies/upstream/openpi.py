"""Clients of openpi's servers, with one observation or a batch per message, and of RoboArena's."""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.policies.upstream.client import Answer, ClientOptions, WebSocketClient
from vlagents_ray.wire import openpi
from vlagents_ray.wire.outgoing import Outgoing

_RESET = "reset successful"  # the answer of RoboArena's servers to `reset`


class OpenPiClient(WebSocketClient):
    """A client of servers with openpi's protocol, which keep no state between observations."""

    key_scheme = "Api-Key"  # as openpi_client.websocket_client_policy sends it

    @staticmethod
    def is_nested(key: str) -> bool:
        """Return whether a key is a path: `images/cam_high` is one, openpi's keys under `observation/` are not."""
        return not key.startswith("observation/")

    def connect(self, timeout_s: float) -> dict[str, Any]:
        self.open(timeout_s)
        try:
            return self._map(self.recv(timeout_s))
        except VLAgentsError as error:
            self.close()
            raise PolicyUnavailable(f"{error}; its first message must be its metadata") from error

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        return [self._actions(self._call(observation))]

    def _call(self, message: Mapping[str, Any]) -> Any:
        self.send(openpi.encode(message))
        return self._read(self.recv())

    def _read(self, data: bytes | str) -> Any:
        return self._map(data)

    def _map(self, data: bytes | str) -> dict[str, Any]:
        """Return the map in a message; a text message is an error, after which the upstream closes the connection."""
        if isinstance(data, str):
            self.close()
            raise self.failed(data)
        return openpi.decode(data, self.options.limits)

    def _actions(self, reply: Any) -> np.ndarray:
        actions = reply.get("actions") if isinstance(reply, dict) else None
        if not isinstance(actions, np.ndarray):
            got = sorted(map(str, reply))[:8] if isinstance(reply, dict) else type(reply).__name__
            raise self.unreadable(got, "a map with an array `actions`")
        return actions


class OpenPiBatchClient(OpenPiClient):
    """A client that sends `{"batch": [...]}`, as in openpi's pull request 941 and in our own dialect."""

    batches: ClassVar[bool] = True

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        actions = self._actions(self._call({"batch": list(observations)}))
        if actions.ndim != 3 or len(actions) != len(observations):
            raise self.unreadable(f"actions {actions.shape}", f"({len(observations)}, H, D), one chunk an observation")
        return list(actions)


class RoboArenaClient(OpenPiClient):
    """A client of RoboArena's servers, which keep a session for each `session_id` and have a reset."""

    keeps_sessions: ClassVar[bool] = True
    mapping: ClassVar[str | None] = "roboarena"

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._session = uuid.uuid4().hex

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        reply = self._call({**observation, "endpoint": "infer", "session_id": self._session})
        return [reply if isinstance(reply, np.ndarray) else self._actions(reply)]

    def begin(self) -> None:
        self._session = uuid.uuid4().hex
        self.send(openpi.encode({"endpoint": "reset"}))
        answer = self.recv()
        if answer != _RESET:
            self._read(answer)  # vLLM-Omni answers with a map; any text other than `_RESET` is an error

    def differences(self, metadata: Mapping[str, Any], outgoing: Outgoing) -> list[str]:
        cameras = [camera.key.partition("|")[0] for camera in outgoing.mapping.cameras.values()]
        found = []
        external = metadata.get("n_external_cameras")
        have = sum("exterior" in key for key in cameras)
        if isinstance(external, int) and external > have:
            found.append(
                f"cameras: the upstream needs {external} external ones, the mapping has {have}; "
                f"add them to mapping.cameras"
            )
        if metadata.get("needs_wrist_camera") is True and not any("wrist" in key for key in cameras):
            found.append(
                "cameras: the upstream needs one at the wrist, the mapping has none; add it to mapping.cameras"
            )
        return found

    def _read(self, data: bytes | str) -> Any:
        """Return a map, or the array that older servers send; vLLM-Omni sends an error as a map."""
        reply = self._map(data) if isinstance(data, str) else openpi.decode_any(data, self.options.limits)
        if isinstance(reply, dict) and reply.get("type") == "error":
            raise self.failed(reply.get("message"))
        return reply
