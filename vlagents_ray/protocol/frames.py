"""The binary frame: a complete message, with its images and arrays as aligned raw bytes.

HTTP bodies, WebSocket messages and shared memory contain the same frame. Its header (see
`vlagents_ray.protocol.frame_layout`) is one request or reply. For a vector of environments, it is a
list of them under "requests" or "replies".
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from vlagents_ray.errors import (
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    TooManyRequests,
    VLAgentsError,
    from_code,
    shown,
)
from vlagents_ray.images.codecs import RAW, ImageCodec
from vlagents_ray.interface import Act
from vlagents_ray.protocol.frame_layout import Buffer, assemble, dump, pack, unpack
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    MOST_DEADLINE_MS,
    NAME_CHARACTERS,
    OPS,
    PRIORITIES,
    Budget,
    MessageLimits,
    Op,
    Reply,
    Request,
    is_name,
)
from vlagents_ray.protocol.values import ValueReader, ValueWriter, is_number, read_obs, write_obs

CONTENT_TYPE = "application/x-vlagents-frame"
# The optional keys of a request, with their defaults.
_OPTIONAL: dict[str, Any] = {
    "request_id": "",
    "session": "",
    "priority": "robot",
    "deadline_ms": None,
}
_WITH_OBS = ("reset", "act")
_RESET_PARAMETERS = {"self", "obs", "instruction"}  # names that `kwargs` must not contain
_OF_RESET = ("instruction", "kwargs", "contract", "history")
_OF_CLOSE = ("op", "step", *_OPTIONAL)
_REQUEST_KEYS = {
    "op",
    "obs",
    "instruction",
    "kwargs",
    "contract",
    "history",
    "blobs",
    "step",
    *_OPTIONAL,
}
_INNER_KEYS = {"prepared"}  # further keys, which only a replica may send, see `INNER_OPS`


def encode_requests(requests: Sequence[Request], codec: ImageCodec = RAW) -> bytes:
    """Encode requests as one frame, the inverse of `decode_requests`."""
    return b"".join(request_parts(requests, codec))


def request_parts(requests: Sequence[Request], codec: ImageCodec = RAW) -> list[Buffer]:
    """Return the pieces of a frame of requests, in order. Raw images and arrays are views, not
    copies.
    """
    writer = ValueWriter()
    nodes = [_write_request(request, writer, codec) for request in requests]
    return pack(nodes[0] if len(nodes) == 1 else {"requests": nodes}, writer.blobs)


def _write_request(request: Request, writer: ValueWriter, codec: ImageCodec) -> dict[str, Any]:
    node: dict[str, Any] = {"op": request.op}
    if request.obs is not None:
        node["obs"] = write_obs(request.obs, writer, codec)
    if request.instruction is not None:
        node["instruction"] = request.instruction
    if request.kwargs:
        node["kwargs"] = writer.value(request.kwargs)
    if request.contract is not None:
        node["contract"] = request.contract
    if request.history:
        node["history"] = [write_obs(obs, writer, codec) for obs in request.history]
    for name, default in _OPTIONAL.items():
        value = getattr(request, name)
        if value != default:
            node[name] = value
    if request.step is not None:
        node["step"] = str(request.step)
    if request.prepared:
        node["prepared"] = request.prepared
    return node


class Decoded(NamedTuple):
    """The requests decoded from a frame, and the error replies to unreadable requests, by the index
    of the request in the frame.
    """

    requests: list[Request]
    refused: dict[int, Reply]


def decode_requests(data: Buffer, budget: Budget, ops: Sequence[Op] = OPS) -> Decoded:
    """Decode the requests in a frame.

    Args:
        budget: The budget of the message, which may reject it before any of it is parsed, and each
            request before its images are decoded.

    Raises:
        MalformedMessage: The data are not a frame of requests.
        MessageTooLarge: The frame, or its number of requests, exceeds a limit.
        TooManyRequests: The sender's key is over its rate.
    """
    budget.begin_message()
    limits = budget.limits
    header, blobs = unpack(data, limits, budget)
    nodes = header.get("requests", [header])
    if not isinstance(nodes, list) or {*map(type, nodes)} != {dict}:
        raise MalformedMessage(f"requests: expected a list of requests, got {shown(nodes)}")
    if len(nodes) > limits.requests:
        raise MessageTooLarge(
            f"requests: expected at most {limits.requests} in one frame, got {len(nodes)}"
        )

    decoded = Decoded([], {})
    reader = ValueReader(blobs, budget)
    for index, node in enumerate(nodes):
        try:
            budget.begin(node.get("op"), node.get("priority"))
            reader.begin()
            decoded.requests.append(_read_request(node, reader, ops))
        except VLAgentsError as error:
            request_id = node.get("request_id")
            if not (isinstance(request_id, str) and is_name(request_id)):
                request_id = ""
            decoded.refused[index] = Reply(request_id, error=error)
    return decoded


def _read_request(node: dict[str, Any], reader: ValueReader, ops: Sequence[Op]) -> Request:
    limits = reader.limits
    keys = _REQUEST_KEYS | _INNER_KEYS if "prepare" in ops else _REQUEST_KEYS
    unknown = node.keys() - keys
    if unknown:
        raise MalformedMessage(
            f"request: expected keys of {sorted(_REQUEST_KEYS)}, got {shown(sorted(unknown))}"
        )
    if node.get("op") not in ops:
        raise MalformedMessage(f"op: expected one of {list(ops)}, got {shown(node.get('op'))}")
    if node["op"] == "close":  # a close has no payload and costs nothing
        node = {name: value for name, value in node.items() if name in _OF_CLOSE}

    obs = node.get("obs")
    history = node.get("history") or []
    if not isinstance(history, list):
        raise MalformedMessage(
            f"history: expected a list of observations, got {type(history).__name__}"
        )
    if len(history) > limits.history:
        raise MessageTooLarge(
            f"history: expected at most {limits.history} observations, got {len(history)}"
        )

    request = Request(
        op=cast(Op, node["op"]),
        obs=None if obs is None else read_obs(obs, reader),
        instruction=node.get("instruction"),
        kwargs=reader.value(node.get("kwargs") or {}),
        contract=node.get("contract"),
        history=[read_obs(earlier_obs, reader) for earlier_obs in history],
        step=_step(node),
        prepared=node.get("prepared", 0),
        **{name: node.get(name, default) for name, default in _OPTIONAL.items()},
    )
    return check_request(request, limits)


def _step(node: dict[str, Any]) -> Any:
    """Return the `step` of a request or reply. The step is sent as text, since some JSON parsers
    round numbers above 2**53.
    """
    step = node.get("step")
    if step is None:
        return None
    if not (isinstance(step, str) and step.isascii() and step.isdecimal() and len(step) < 20):
        raise MalformedMessage(
            f"step: expected the text of the last answer, such as '7', got {shown(step)}"
        )
    return int(step)


def check_request(request: Request, limits: MessageLimits) -> Request:
    """Check the types and sizes that JSON itself does not enforce, and return the request. The
    request may have been decoded from any format.
    """
    # A JSON object may be a reference to an array, bytes or a number.
    if not isinstance(request.kwargs, dict):
        raise MalformedMessage(f"kwargs: expected an object, got {type(request.kwargs).__name__}")
    if request.contract is not None and not isinstance(request.contract, dict):
        raise MalformedMessage(
            f"contract: expected an object, got {type(request.contract).__name__}"
        )

    if request.op in ("act", "close"):
        reset_fields = [name for name in _OF_RESET if getattr(request, name)]
        if reset_fields:
            raise MalformedMessage(
                f"{request.op}: expected no {reset_fields}, which only a reset may set, got "
                "them; leave them out"
            )
    if request.obs is None and request.op in _WITH_OBS and not request.prepared:
        raise MalformedMessage(f"{request.op}: no 'obs'; send the observation")

    for name in ("instruction", "request_id", "session"):
        text = getattr(request, name)
        if not isinstance(text, str) and not (name == "instruction" and text is None):
            raise MalformedMessage(f"{name}: expected text, got {type(text).__name__}")
        if text and len(text) > (limits.text if name == "instruction" else NAME_CHARACTERS):
            raise MessageTooLarge(f"{name}: expected fewer characters, got {len(text)}; shorten it")
        if text and name != "instruction" and not is_name(text):
            raise MalformedMessage(
                f"{name}: expected visible ASCII characters without spaces, got {text[:40]!r}"
            )

    if request.op == "reset":
        parameters = _RESET_PARAMETERS & request.kwargs.keys()
        if parameters:
            raise MalformedMessage(
                "kwargs: expected names other than the parameters of `reset` itself, got "
                f"{sorted(parameters)}; rename them"
            )
    if not isinstance(request.priority, str) or request.priority not in PRIORITIES:
        raise MalformedMessage(
            f"priority: expected one of {list(PRIORITIES)}, got {shown(request.priority)}"
        )
    if request.deadline_ms is not None and not (
        is_number(request.deadline_ms) and 0 < request.deadline_ms < MOST_DEADLINE_MS
    ):
        raise MalformedMessage(
            f"deadline_ms: expected a number above 0 and below {MOST_DEADLINE_MS:g}, got "
            f"{shown(request.deadline_ms)}"
        )
    return request


def encode_replies(replies: Sequence[Reply], *, arrived: float | None = None) -> bytes:
    """Encode the replies to one frame of requests as one frame, in the order of the requests.

    `arrived` is the time of `time.perf_counter()` at which the requests arrived, s. If it is set,
    the `timing` of each reply without an error also has `encode_ms` and `total_ms`, which exclude
    only the final joining of the frame.
    """
    begun = time.perf_counter()
    writer = ValueWriter()
    nodes = [dump(_write_reply(reply, writer)) for reply in replies]

    if len(nodes) > 1 and sum(map(len, (*nodes, *writer.blobs))) > DEFAULT_LIMITS.body_bytes:
        error = MessageTooLarge(
            f"replies: expected at most {DEFAULT_LIMITS.body_bytes} bytes in total, got more; "
            "request fewer at once"
        )
        error_replies = [Reply(reply.request_id, error=error) for reply in replies]
        return encode_replies(error_replies, arrived=arrived)

    if arrived is not None:
        ended = time.perf_counter()
        times_ms = {"encode_ms": (ended - begun) * 1e3, "total_ms": (ended - arrived) * 1e3}
        for reply in replies:
            if reply.error is None:
                reply.timing |= times_ms

    # The timing is encoded last, in a separate loop, so that it includes the encoding of everything
    # else.
    for i, reply in enumerate(replies):
        if reply.timing:  # 4 decimals (0.1 us): all digits would take a third of the encoding time
            times = ",".join(
                [
                    f'"{k}":{v:.4f}' if type(v) is float else f'"{k}":{v}'
                    for k, v in reply.timing.items()
                ]
            )
            nodes[i] = f'{nodes[i][:-1]},"timing":{{{times}}}}}'

    blobs = f"[{','.join([str(len(blob)) for blob in writer.blobs])}]"
    head = nodes[0][1:-1] if len(nodes) == 1 else f'"replies":[{",".join(nodes)}]'
    return b"".join(assemble(f'{{{head},"blobs":{blobs}}}', writer.blobs))


def _write_reply(reply: Reply, writer: ValueWriter) -> dict[str, Any]:
    node: dict[str, Any] = {"request_id": reply.request_id}
    if reply.error is not None:
        node["error"] = describe_error(reply.error)
    if reply.act is not None:
        node["act"] = {
            "action": writer.array(reply.act.action),
            "done": bool(reply.act.done),
            "info": writer.value(reply.act.info),
        }
    if reply.info is not None:
        node["info"] = writer.value(reply.info)
    if reply.step is not None:
        node["step"] = str(reply.step)
    if reply.draining:
        node["draining"] = True
    return node


def decode_replies(data: Buffer) -> list[Reply]:
    """Decode the replies in a frame, which contains at least one reply."""
    header, blobs = unpack(data, DEFAULT_LIMITS)
    nodes = header.get("replies", [header])
    if not isinstance(nodes, list) or {*map(type, nodes)} != {dict}:
        raise MalformedMessage(f"replies: expected a list of replies, got {shown(nodes)}")
    return [_read_reply(node, ValueReader(blobs, Budget(DEFAULT_LIMITS))) for node in nodes]


def _read_reply(node: dict[str, Any], reader: ValueReader) -> Reply:
    reply = Reply(
        request_id=str(node.get("request_id", "")),
        step=_step(node),
        draining=bool(node.get("draining")),
        timing=_timing(node.get("timing")),
    )
    error_node = node.get("error")
    act = node.get("act")
    if error_node is not None:
        reply.error = read_error(error_node)
    elif act is not None:
        try:
            reply.act = Act(
                reader.blob(act["action"]), bool(act["done"]), _info(act["info"], reader)
            )
        except (KeyError, TypeError) as error:
            raise MalformedMessage(
                f"reply: expected action, done and info, got {shown(act)}"
            ) from error
        if not isinstance(reply.act.action, np.ndarray):
            raise MalformedMessage(
                f"reply: action: expected an array, got {shown(reply.act.action)}"
            )
    else:
        reply.info = _info(node.get("info") or {}, reader)
    return reply


def _info(node: object, reader: ValueReader) -> dict[str, Any]:
    """Return the `info` of a reply."""
    value = reader.value(node)
    if not isinstance(value, dict):
        raise MalformedMessage(f"reply: info: expected an object, got {shown(node)}")
    return value


def _timing(node: object) -> dict[str, float]:
    """Return the `timing` of a reply."""
    if node is None:
        return {}
    if not isinstance(node, dict) or not all(is_number(value) for value in node.values()):
        raise MalformedMessage(f"reply: timing: expected numbers by name, got {shown(node)}")
    return node


def describe_error(error: VLAgentsError) -> dict[str, Any]:
    """Return an error as a node of a reply or of a problem+json document. This is the inverse of
    `read_error`.
    """
    node: dict[str, Any] = {"code": error.code, "detail": str(error)}
    if isinstance(error, TooManyRequests | Overloaded):
        node["retry_after_s"] = round(error.retry_after_s, 3)
    return node


def read_error(node: Any) -> VLAgentsError:
    """Return the error that a reply or a problem+json document describes."""
    if not isinstance(node, dict):
        return VLAgentsError(str(node))
    error = from_code(str(node.get("code", "")), str(node.get("detail", "")))
    wait_s: Any = node.get("retry_after_s")
    if isinstance(error, TooManyRequests | Overloaded) and is_number(wait_s) and wait_s >= 0:
        error.retry_after_s = float(wait_s)
    return error
