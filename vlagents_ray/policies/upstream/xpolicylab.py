"""The messages of XPolicyLab's policy servers: msgpack maps, with arrays in the format of `msgpack_numpy`.

The facts come from XPolicyLab 7198143, `client_server/ws/protocol` and `model_server.py`. A reply has the `message_id`
of its request. The protocol has no version.
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.errors import MalformedMessage, PolicyUnavailable, VLAgentsError, shown
from vlagents_ray.policies.upstream.client import Answer, ClientOptions, WebSocketClient
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.protocol.values import is_number
from vlagents_ray.wire import msgpack

REPLIES = {"hello": "hello_ack", "reset": "reset_result", "infer": "infer_result"}
ERROR = "error"
_FORMAT = "v1.0"  # of an observation
_SHOWN = 40  # characters of a server's text in an error


@dataclass(frozen=True, slots=True)
class PolicyReply:
    """A server's reply."""

    kind: str
    message_id: str
    payload: dict[str, Any]


def write_request(
    kind: str, message_id: str, payload: Mapping[str, Any], evaluation: str, trial: str | None, step: int
) -> bytes:
    """Return a request: a kind of `REPLIES`, the id that its reply repeats, its content, and its place."""
    message = {
        "message_type": kind,
        "message_id": message_id,
        "evaluation_id": evaluation,
        "trial_id": trial,
        "step": step,
        "sent_at": datetime.now(timezone.utc).isoformat(),
        "payload": payload,
    }
    return msgpack.pack(message, msgpack.write_packed)


def observed(theirs: Mapping[str, Any]) -> dict[str, Any]:
    """Return the payload of an `infer`; some policies want the number of the environment in each observation."""
    return {"observation": {"data_format_version": _FORMAT, "env_idx": 0, **theirs}}


def read_reply(data: bytes, limits: Limits = DEFAULT_LIMITS) -> PolicyReply:
    """Return a reply; raise `MalformedMessage` or `MessageTooLarge` if it is invalid."""

    def array(node: dict[Any, Any]) -> Any:
        return msgpack.read_packed(node) if msgpack.is_packed(node) else node

    found = msgpack.unpack(data, limits, array)
    if not isinstance(found, dict):
        raise MalformedMessage(f"xpolicylab: got {type(found).__name__}, want a map")
    kind, message_id, payload = (found.get(name) for name in ("message_type", "message_id", "payload"))
    if not (isinstance(kind, str) and isinstance(message_id, str) and isinstance(payload, dict)):
        raise MalformedMessage("xpolicylab: want a message_type and a message_id of text, and a payload, a map")
    return PolicyReply(kind, message_id, payload)


def read_actions(payload: Mapping[str, Any]) -> np.ndarray | dict[str, np.ndarray]:
    """Return the actions in the payload of an `infer_result`, (D,) or (H, D), or such by the server's names."""
    actions = payload.get("actions")
    if isinstance(actions, dict):
        return {_text(name): _numbers(value) for name, value in actions.items()}
    if isinstance(actions, list) and actions and all(isinstance(one, dict) for one in actions):
        names = [_text(name) for name in actions[0]]
        if any(list(one) != names for one in actions):
            raise MalformedMessage("xpolicylab: actions: want the same names in each step")
        return {name: _joined([one[name] for one in actions]) for name in names}
    return _joined(actions) if isinstance(actions, list) and not _is_row(actions) else _numbers(actions)


def _joined(rows: list[Any]) -> np.ndarray:
    found = [np.atleast_1d(_numbers(row)) for row in rows]
    if len({row.shape for row in found}) != 1:
        raise MalformedMessage(
            f"xpolicylab: actions: got {[row.shape for row in found][:4]}, want the same in each step"
        )
    return np.stack(found)


def _numbers(value: Any) -> np.ndarray:
    if isinstance(value, np.ndarray):
        return value
    if is_number(value) or _is_row(value):
        return np.asarray(value, np.float64)
    raise MalformedMessage(f"xpolicylab: actions: got {type(value).__name__}, want arrays of numbers, or such by name")


def _is_row(value: Any) -> bool:
    return isinstance(value, list) and len(value) > 0 and all(is_number(one) for one in value)


def _text(name: Any) -> str:
    if not isinstance(name, str):
        raise MalformedMessage(f"xpolicylab: actions: got the name {shown(name)}, want text")
    return name


_EVALUATION = "vlagents-ray"


class XPolicyLabClient(WebSocketClient):
    """A client that resets the model where an episode begins."""

    keeps_sessions: ClassVar[bool] = True
    one_session: ClassVar[bool] = True
    takes_key: ClassVar[bool] = False

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._trial: str | None = None
        self._step = 0

    def connect(self, timeout_s: float) -> dict[str, Any]:
        self.open(timeout_s)
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
        payload = self._call("infer", observed(observation), self.options.timeout_s)
        self._step += 1
        return [read_actions(payload)]

    def _call(self, kind: str, payload: Mapping[str, Any], timeout_s: float) -> dict[str, Any]:
        """Send a request and return the payload of its reply; replies to older requests are skipped."""
        name, deadline = uuid.uuid4().hex, time.monotonic() + timeout_s
        self.send(write_request(kind, name, payload, _EVALUATION, self._trial, self._step))
        while True:
            data = self.recv(max(0.0, deadline - time.monotonic()))
            if isinstance(data, str):
                self.close()
                raise self.unreadable("a text", "a binary map")
            reply = read_reply(data, self.options.limits)
            if reply.message_id != name:
                continue
            if reply.kind == ERROR:
                raise self.failed(reply.payload)
            if reply.kind != REPLIES[kind]:
                raise self.unreadable(f"a message {reply.kind[:40]!r}", REPLIES[kind])
            return reply.payload
