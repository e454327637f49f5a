"""Requests and replies for clients that do not use this project's frames: JSON, with images as
separate JPEG or PNG files.

The JSON of a request contains `instruction`, `gripper`, `state`, `info`, and for reset `kwargs` and
`contract`; each camera is a separate file. Arrays in a reply become lists.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, VLAgentsError, shown
from vlagents_ray.naming import without_duplicate_keys
from vlagents_ray.protocol.frame_layout import parse_json
from vlagents_ray.protocol.frames import check_request, describe_error
from vlagents_ray.protocol.messages import Budget, Op, Reply, Request
from vlagents_ray.protocol.values import ValueReader, read_obs

PROBLEM_TYPE = "application/problem+json"
CAMERA_PREFIX = "cameras."
_KEYS = {
    "instruction",
    "gripper",
    "state",
    "info",
    "kwargs",
    "contract",
    "request_id",
    "deadline_ms",
}


def request_from_parts(
    op: Op, text: str | bytes, images: Mapping[str, bytes], budget: Budget
) -> Request:
    """Build a request from its JSON document and its images by camera name, each a JPEG or PNG
    file.

    The `budget` is charged before anything is decoded.
    """
    budget.begin(op)
    document = parse_json(text, "obs:", without_duplicate_keys, budget=budget)
    if not isinstance(document, dict):
        raise MalformedMessage(f"obs: expected an object, got {type(document).__name__}")

    unknown = document.keys() - _KEYS
    if "cameras" in unknown:
        raise MalformedMessage(
            "obs: expected no 'cameras' in the JSON document, got some; send "
            "multipart/form-data, in it the document as part 'obs' and each image as a file "
            "'cameras.<name>', JPEG or PNG"
        )
    if unknown:
        raise MalformedMessage(
            f"obs: expected keys of {sorted(_KEYS)}, got {shown(sorted(unknown))}"
        )

    names = [] if op == "close" else list(images)  # a close has no payload and costs nothing
    reader = ValueReader([images[name] for name in names], budget)
    obs = {key: document[key] for key in ("gripper", "state", "info") if key in document}
    obs["cameras"] = {name: {"$": ["img", index]} for index, name in enumerate(names)}
    request = Request(
        op=op,
        obs=read_obs(obs, reader),
        instruction=document.get("instruction"),
        kwargs=reader.value(document.get("kwargs") or {}),
        contract=document.get("contract"),
        request_id=document.get("request_id", ""),
        deadline_ms=document.get("deadline_ms"),
    )
    return check_request(request, budget.limits)


def reply_to_json(reply: Reply) -> dict[str, Any]:
    """Convert a reply without an error to plain JSON values."""
    document: dict[str, Any] = {"request_id": reply.request_id}
    if reply.act is not None:
        document |= {
            "action": reply.act.action.tolist(),
            "done": reply.act.done,
            "info": plain_values(reply.act.info),
        }
    else:
        document["info"] = plain_values(reply.info or {})
    return document | {"timing": reply.timing}


def problem(error: VLAgentsError, request_id: str = "") -> dict[str, Any]:
    """Return the problem+json document (RFC 9457) of an error. Clients should test its `code`,
    which never changes.
    """
    return {
        "type": "about:blank",
        "title": type(error).__name__,
        "status": error.status,
        **describe_error(error),
        "request_id": request_id,
    }


def plain_values(value: Any) -> Any:
    """Convert a value to JSON types.

    Arrays become lists, bytes become base64, and NaN and infinity, which JSON cannot represent,
    become None.
    """
    if isinstance(value, Mapping):
        return {key: plain_values(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_values(item) for item in value]
    if isinstance(value, np.ndarray):
        items = value.tolist()
        is_finite = value.dtype.kind != "f" or np.isfinite(value).all()
        return items if is_finite else plain_values(items)
    if isinstance(value, np.generic):
        return plain_values(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, (bytes, bytearray, memoryview)):
        return base64.b64encode(value).decode()
    # A frame also encodes other sequences, such as a deque, as lists.
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [plain_values(item) for item in value]
    return value
