"""A client of vla-eval's model servers, which keep a session for each connection."""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.policies.upstream.client import Answer, ClientOptions, WebSocketClient
from vlagents_ray.wire import vla_eval
from vlagents_ray.wire.outgoing import Outgoing
from vlagents_ray.wire.vla_eval import Message

_STATED = ("model_server", "harness_version", "protocol_version", "observation_params", "action_spec")


class VlaEvalClient(WebSocketClient):
    """A client that announces episodes, and requests one action per step."""

    keeps_sessions: ClassVar[bool] = True
    mapping: ClassVar[str | None] = "vla-eval"

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._seq = 0
        self._begun = -1  # the number of the last message that began an episode

    def connect(self, timeout_s: float) -> dict[str, Any]:
        self.open(timeout_s)
        version = importlib.metadata.version("vlagents-ray")
        try:
            self._send(
                "hello", {"harness_version": f"vlagents-ray {version}", "protocol_version": vla_eval.PROTOCOL_VERSION}
            )
            hello = self._answer("hello", timeout_s)
        except VLAgentsError as error:
            self.close()
            raise PolicyUnavailable(f"{error}; it did not answer `hello`") from error
        if (theirs := hello.get("protocol_version")) != vla_eval.PROTOCOL_VERSION:
            self.close()
            raise PolicyUnavailable(
                f"upstream {self.options.url}: got protocol version {str(theirs)[:20]}, "
                f"want {vla_eval.PROTOCOL_VERSION}"
            )
        return {name: hello[name] for name in _STATED if name in hello}

    def begin(self) -> None:
        self._send("episode_start", {})
        self._begun = self._seq

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        self._send("observation", dict(observation))
        payload = self._answer("action", self.options.timeout_s)
        actions = payload.get("actions", payload.get("action"))
        if isinstance(actions, list):
            actions = np.asarray(actions, np.float32) if all(isinstance(one, int | float) for one in actions) else None
        if not isinstance(actions, np.ndarray):
            raise self.unreadable(sorted(map(str, payload))[:8], "a payload with an array `actions`")
        return [actions]

    def differences(self, metadata: Mapping[str, Any], outgoing: Outgoing) -> list[str]:
        params = metadata.get("observation_params")
        wants_state = isinstance(params, dict) and params.get("send_state") is True
        if wants_state and not outgoing.mapping.state:
            return ["state: the upstream needs it (send_state), the mapping has none; add it to mapping.state"]
        return []

    def _send(self, kind: vla_eval.Kind, payload: dict[str, Any]) -> None:
        self._seq += 1
        self.send(vla_eval.encode(Message(kind, payload, self._seq)))

    def _answer(self, kind: vla_eval.Kind, timeout_s: float) -> dict[str, Any]:
        """Return the payload of the answer to the last message; older answers are skipped."""
        deadline = time.monotonic() + timeout_s
        while True:
            data = self.recv(max(0.0, deadline - time.monotonic()))
            if isinstance(data, str):
                self.close()
                raise self.unreadable("a text", "a binary map")
            message = vla_eval.decode(data, self.options.limits)
            if message.kind == "error" and message.seq in (self._seq, self._begun):
                raise self.failed(message.payload)
            if message.seq == self._seq and message.kind == kind:
                return message.payload
