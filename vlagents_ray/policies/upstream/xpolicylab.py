"""A client of XPolicyLab's policy servers, each of which has one model with one state."""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.policies.upstream.client import Answer, ClientOptions, UpstreamClient, UpstreamSocket
from vlagents_ray.wire import xpolicylab

_EVALUATION = "vlagents-ray"


class XPolicyLabClient(UpstreamClient):
    """A client that resets the model where an episode begins."""

    keeps_sessions: ClassVar[bool] = True
    one_session: ClassVar[bool] = True
    schemes: ClassVar[tuple[str, ...]] = ("ws", "wss")
    takes_key: ClassVar[bool] = False

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._socket = UpstreamSocket(options, {})
        self._trial: str | None = None
        self._step = 0

    @property
    def is_open(self) -> bool:
        return self._socket.is_open

    def connect(self, timeout_s: float) -> dict[str, Any]:
        self._socket.open(timeout_s)
        try:
            self._call("hello", {}, timeout_s)
        except VLAgentsError as error:
            self.close()
            raise PolicyUnavailable(f"{error}; it did not answer `hello`") from error
        return {}

    def begin(self) -> None:
        self._trial, self._step = uuid.uuid4().hex, 0
        self._call("reset", {"trial_id": self._trial}, self.options.timeout_s)

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        payload = self._call("infer", xpolicylab.observed(observation), self.options.timeout_s)
        self._step += 1
        return [xpolicylab.read_actions(payload)]

    def close(self) -> None:
        self._socket.close()

    def _call(self, kind: str, payload: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send a request and return the payload of its reply; replies to older requests are skipped."""
        name, deadline = uuid.uuid4().hex, time.monotonic() + timeout_s
        self._socket.send(xpolicylab.write_request(kind, name, payload, _EVALUATION, self._trial, self._step))
        while True:
            data = self._socket.recv(max(0.0, deadline - time.monotonic()))
            if isinstance(data, str):
                self.close()
                raise self.unreadable("a text", "a binary map")
            reply = xpolicylab.read_reply(data, self.options.limits)
            if reply.message_id != name:
                continue
            if reply.kind == xpolicylab.ERROR:
                raise self.failed(reply.payload)
            if reply.kind != xpolicylab.REPLIES[kind]:
                raise self.unreadable(f"a message {reply.kind[:40]!r}", xpolicylab.REPLIES[kind])
            return reply.payload
