"""The messages of XPolicyLab's policy servers: msgpack maps, with arrays in the format of `msgpack_numpy`.

The facts come from XPolicyLab 7198143, `client_server/ws/protocol` and `model_server.py`. A reply has the `message_id`
of its request. The protocol has no version.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, shown
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
    """Return a request.

    Args:
        kind: One of `REPLIES`.
        message_id: Which the reply repeats.
        payload: Its content.
        evaluation: Name of the evaluation.
        trial: Name of the episode.
        step: Number of the observation in the episode.
    """
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
    """Return the actions in the payload of an `infer_result`.

    Returns:
        (D,) or (H, D); or, if the server answers a map or one for each step, such by its names.

    Raises:
        MalformedMessage: They are none of these.
    """
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
