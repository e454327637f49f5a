"""A compact form of acts with raw images, which omits the fields that are the same at each step.

An observation's layout (session, priority, names and sizes of cameras and state) is sent once, as
JSON. Later messages of the connection refer to the layout by its number. The remaining part of a
request is an `ITEM` and its arrays, which are stored in sequence, each at an offset that is a
multiple of 64. A reply consists of an `ANSWER`, the action, and the `WEIGHTS` that computed the
action. All other messages (a reset, `info`, an error) are sent as frames; see
`vlagents_ray.protocol.frames`.

Processes of one machine store the arrays in shared memory. On a WebSocket, a message is a
`STREAM_TAG`, the size of the text, the text and the arrays, and its answer is a `STREAM_TAG` and
the replies. Only the Python client sends this form, if the server's metadata have `compact`.
"""

from __future__ import annotations

import json
import math
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.interface import POLICY, Act, Obs
from vlagents_ray.protocol.frame_layout import Buffer, parse_json
from vlagents_ray.protocol.frames import Decoded, check_request
from vlagents_ray.protocol.messages import (
    Budget,
    MessageLimits,
    PriorityName,
    Reply,
    Request,
    is_name,
)
from vlagents_ray.protocol.values import require_array_name

_ALIGN = 64
_ID_BYTES = 40  # maximum length of a request's id
# Maximum number of layouts of one connection, and of the bytes of their texts.
_MAX_LAYOUTS, _LAYOUTS_BYTES = 1024, 2**18
_NONE = float("nan")
_UINT8, _FLOAT32 = np.dtype(np.uint8), np.dtype(np.float32)

STREAM_TAG = b"VLAc"
_STREAM_HEAD = struct.Struct("<4sI")  # tag, size of the text, bytes
COUNT = struct.Struct("<I")
# An act: number of its layout, size of the layout's JSON, step or -1, deadline in ms, gripper,
# request id.
ITEM = struct.Struct(f"<IIqdd{_ID_BYTES}s")
# A reply: request id, step, flags, number of dimensions, H, D, batch size, times in ms.
ANSWER = struct.Struct(f"<{_ID_BYTES}sqBB2xIIIddddd")
_DONE, _DRAINING, _POLICY = 1, 2, 4
# The weights of an answer, after all actions, if the flag _POLICY is set: version, digest.
WEIGHTS = struct.Struct("<q16s")


@dataclass(frozen=True, slots=True)
class Layout:
    """The constant part of a session's requests, with the offsets of their arrays."""

    session: str
    priority: PriorityName
    cameras: tuple[tuple[str, tuple[int, ...], int], ...]  # name, (H, W, 3) uint8, offset in bytes
    state: tuple[tuple[str, tuple[int, ...], int], ...]  # name, (D,) float32, offset in bytes
    size: int  # total size of the arrays, bytes

    @classmethod
    def from_shapes(
        cls, session: str, priority: PriorityName, cameras: Sequence[Any], state: Sequence[Any]
    ) -> Layout:
        """Compute the layout of arrays, given as pairs of name and shape: (H, W, 3) for cameras,
        (D,) for states.
        """
        at = 0
        placed: tuple[list[Any], list[Any]] = ([], [])
        for group, arrays, width in zip(placed, (cameras, state), (1, 4), strict=True):
            for name, shape in arrays:
                group.append((name, tuple(shape), at))
                at += -(-math.prod(shape) * width // _ALIGN) * _ALIGN
        return cls(session, priority, tuple(placed[0]), tuple(placed[1]), at)

    def placed(self, request: Request, at: int) -> list[tuple[int, np.ndarray]] | None:
        """Return the offset of each array if the first array is at `at`; None if the request is not
        an act with this layout.

        Comparing each array is faster than computing the request's `_key`.
        """
        obs = request.obs
        if obs is None or not _is_plain(request, obs) or request.priority != self.priority:
            return None
        if len(obs.cameras) != len(self.cameras) or len(obs.state) != len(self.state):
            return None

        arrays = []
        for (name, shape, offset), (camera, image) in zip(
            self.cameras, obs.cameras.items(), strict=True
        ):
            if (
                type(image) is not np.ndarray
                or camera != name
                or image.shape != shape
                or image.dtype != _UINT8
            ):
                return None
            arrays.append((at + offset, image))
        for (name, shape, offset), (state_name, values) in zip(
            self.state, obs.state.items(), strict=True
        ):
            if (
                type(values) is not np.ndarray
                or state_name != name
                or values.shape != shape
                or values.dtype.kind != "f"
            ):
                return None
            numbers = values if values.dtype == _FLOAT32 else values.astype(np.float32)
            arrays.append((at + offset, numbers))
        return arrays


class CompactWriter:
    """Writes the acts of one connection, and remembers the layouts that the receiver has."""

    def __init__(self) -> None:
        self._text_bytes = 0  # size of the texts of all layouts
        self._known: dict[Any, tuple[int, Layout]] = {}
        # The layout of the last act of each session; its next act probably has the same layout.
        self._latest: dict[str, tuple[int, Layout]] = {}

    def write(self, requests: Sequence[Request]) -> Written | None:
        """Return the message and the offsets of the arrays; None if the requests must be sent as a
        frame.
        """
        items, texts = [COUNT.pack(len(requests))], []
        arrays: list[tuple[int, np.ndarray]] = []
        new: dict[Any, tuple[int, Layout]] = {}
        latest: dict[str, tuple[int, Layout]] = {}
        at, text_bytes = 0, self._text_bytes
        for request in requests:
            text = b""
            known = self._latest.get(request.session)
            placed = None if known is None else known[1].placed(request, at)
            if known is None or placed is None:
                key = _key(request)
                if key is None:
                    return None
                known = self._known.get(key) or new.get(key)
                if known is None:
                    number = len(self._known) + len(new)
                    text = json.dumps(key).encode()
                    text_bytes += len(text)
                    if number >= _MAX_LAYOUTS or text_bytes > _LAYOUTS_BYTES:
                        return None
                    known = new[key] = (number, Layout.from_shapes(*key))
                    texts.append(text)
                latest[request.session] = known
                placed = known[1].placed(request, at) or []

            number, layout = known
            arrays += placed
            at += layout.size

            obs: Obs = request.obs  # type: ignore[assignment]  # a request with a layout has an obs
            step = -1 if request.step is None else request.step
            deadline_ms = _NONE if request.deadline_ms is None else request.deadline_ms
            gripper = _NONE if obs.gripper is None else obs.gripper
            items.append(
                ITEM.pack(
                    number, len(text), step, deadline_ms, gripper, request.request_id.encode()
                )
            )

        if latest:
            self._known |= new
            self._latest |= latest
            self._text_bytes = text_bytes
        return Written(b"".join(items + texts), max(at, _ALIGN), arrays)


@dataclass(slots=True)
class Written:
    """Acts in compact form: the message, and the arrays for the shared memory."""

    message: bytes
    size: int  # size of the memory for the arrays, bytes
    arrays: list[tuple[int, np.ndarray]]  # pairs of offset in bytes and array

    def parts(self) -> list[Buffer]:
        """Return the content of the memory: the arrays, which are not copied if possible, and the
        gaps between them.
        """
        pieces: list[Buffer] = []
        end = 0
        for at, array in self.arrays:
            if array.size:
                pieces += (bytes(at - end), np.ascontiguousarray(array).data.cast("B"))
                end = at + array.nbytes
        pieces.append(bytes(self.size - end))
        return pieces

    def stream_parts(self) -> list[Buffer]:
        """Return the pieces of a message on a WebSocket, in order."""
        head = _STREAM_HEAD.pack(STREAM_TAG, len(self.message)) + self.message
        return [head, bytes(-len(head) % _ALIGN), *self.parts()]


class CompactReader:
    """Reads the acts of one connection."""

    def __init__(self, limits: MessageLimits) -> None:
        self._limits = limits
        self._known: dict[int, Layout] = {}
        self._text_bytes = 0  # size of the texts of all layouts

    def read_stream(self, message: bytes, budget: Budget) -> Decoded:
        """Return the requests of a message on a WebSocket, whose arrays are views of the message.

        Raises:
            InvalidInput: The message is malformed.
            TooManyRequests: The sender's key is over its rate.
        """
        budget.begin_message()
        if len(message) < _STREAM_HEAD.size:
            raise MalformedMessage(
                f"act: expected at least {_STREAM_HEAD.size} bytes, got {len(message)}"
            )
        _, size = _STREAM_HEAD.unpack_from(message)
        end = _STREAM_HEAD.size + size
        text = memoryview(message)[_STREAM_HEAD.size : end]
        arrays = np.frombuffer(message, np.uint8)[end + -end % _ALIGN :]
        return self.read(text, arrays, budget)

    def read(
        self, message: memoryview, memory: np.ndarray, budget: Budget | None = None
    ) -> Decoded:
        """Return the requests of a message, whose arrays are views of `memory`, (N,) uint8.

        Args:
            budget: The budget of the message, which may reject each request; None for memory of a
                process of the same user.

        Raises:
            InvalidInput: The message is malformed.
        """
        try:
            (count,) = COUNT.unpack_from(message)
            if count > self._limits.requests:
                raise MessageTooLarge(
                    f"act: expected at most {self._limits.requests} acts in one message, got "
                    f"{count}"
                )

            text_at = COUNT.size + count * ITEM.size
            decoded = Decoded([], {})
            at = 0
            for index, item in enumerate(ITEM.iter_unpack(message[COUNT.size : text_at])):
                number, text_bytes, step, deadline_ms, gripper, request_id = item
                if text_bytes:
                    self._learn(number, bytes(message[text_at : text_at + text_bytes]))
                    text_at += text_bytes
                layout = self._known[number]
                if at + layout.size > memory.size:
                    raise MalformedMessage(
                        f"act: expected at least {at + layout.size} bytes of memory for the "
                        f"arrays, got {memory.size}"
                    )

                id_bytes = request_id.rstrip(b"\0")
                name_of_request = id_bytes.decode()
                # `isalnum` is faster than `is_name`, and most ids pass it.
                if not id_bytes.isalnum() and not is_name(name_of_request):
                    raise MalformedMessage(
                        "act: request_id: expected visible ASCII characters, got "
                        f"{name_of_request!r}"
                    )

                obs = Obs(gripper=None if math.isnan(gripper) else gripper)
                for name, shape, offset in layout.cameras:
                    obs.cameras[name] = np.ndarray(shape, _UINT8, memory, at + offset)
                for name, shape, offset in layout.state:
                    obs.state[name] = np.ndarray(shape, _FLOAT32, memory, at + offset)
                at += layout.size

                request = Request(
                    "act",
                    obs,
                    session=layout.session,
                    priority=layout.priority,
                    step=None if step < 0 else step,
                    request_id=name_of_request,
                    deadline_ms=None if math.isnan(deadline_ms) else deadline_ms,
                )
                try:
                    if budget is not None:
                        budget.begin("act", layout.priority)
                        budget.count(layout.size)
                except VLAgentsError as error:
                    decoded.refused[index] = Reply(name_of_request, error=error)
                else:
                    decoded.requests.append(request)
        except (struct.error, ValueError, KeyError, TypeError) as error:
            if isinstance(error, InvalidInput):
                raise
            raise MalformedMessage(f"act: not an act ({type(error).__name__}: {error})") from error

        found = len(decoded.requests) + len(decoded.refused)
        if found != count or not count:
            raise MalformedMessage(
                f"act: expected {count} acts, as the message announces, got {found}"
            )
        return decoded

    def _learn(self, number: int, text: bytes) -> None:
        """Remember a layout; raise an error if it exceeds the limits of a connection."""
        if number >= _MAX_LAYOUTS:
            raise MessageTooLarge(f"act: expected a layout below {_MAX_LAYOUTS}, got {number}")
        if number == 0:  # the client begins again, after a message was rejected
            self._known.clear()
            self._text_bytes = 0
        self._text_bytes += len(text)
        if self._text_bytes > _LAYOUTS_BYTES:
            raise MessageTooLarge(
                f"act: expected layouts of at most {_LAYOUTS_BYTES} bytes in all, got "
                f"{self._text_bytes}"
            )
        self._known[number] = self._layout(text)

    def _layout(self, text: bytes) -> Layout:
        """Read a layout, the JSON text of a `_key`; raise an error if it exceeds the limits."""
        limits = self._limits
        session, priority, cameras, state = parse_json(text, "act: the layout is")
        check_request(Request("close", session=session, priority=priority), limits)
        if not isinstance(cameras, list) or not isinstance(state, list):
            raise MalformedMessage("act: expected lists of names and shapes as cameras and state")
        if max(len(cameras), len(state)) > limits.cameras:
            raise MessageTooLarge(
                f"obs: expected at most {limits.cameras} cameras and states, got {len(cameras)} "
                f"cameras and {len(state)} states"
            )

        for (name, shape), dimensions, max_size in (
            *((camera, 3, limits.pixels) for camera in cameras),
            *((state_part, 1, limits.state_values) for state_part in state),
        ):
            if not isinstance(name, str) or not isinstance(shape, list) or len(shape) != dimensions:
                raise MalformedMessage(
                    f"act: expected a name and {dimensions} dimensions, got {name!r} of {shape!r}"
                )
            require_array_name(name)
            if not all(type(n) is int and n >= 0 for n in shape) or (
                dimensions == 3 and shape[2] != 3
            ):
                raise MalformedMessage(
                    f"act: {name!r}: expected a shape (H, W, 3) or (D,), got {shape!r}"
                )
            size = math.prod(shape[:2])
            if size > max_size:
                raise MessageTooLarge(
                    f"act: {name!r}: expected at most {max_size} pixels or values, got {size}"
                )
        return Layout.from_shapes(session, priority, cameras, state)


def _is_plain(request: Request, obs: Obs) -> bool:
    """Return whether the fields of a request, except its arrays, can be sent in compact form."""
    if request.op != "act" or obs.info or len(request.request_id) > _ID_BYTES:
        return False
    # An invalid value is sent as a frame, so that the server answers with an error.
    return obs.gripper is None or 0.0 <= obs.gripper <= 1.0


def _key(request: Request) -> tuple[Any, ...] | None:
    """Return the key of the layout; None if the request must be sent as a frame."""
    obs = request.obs
    if obs is None or request.prepared or not _is_plain(request, obs):
        return None
    for image in obs.cameras.values():
        if (
            type(image) is not np.ndarray
            or image.dtype != _UINT8
            or image.ndim != 3
            or image.shape[2] != 3
        ):
            return None
    for values in obs.state.values():
        if type(values) is not np.ndarray or values.ndim != 1 or values.dtype.kind != "f":
            return None

    return (
        request.session,
        request.priority,
        tuple([(name, image.shape) for name, image in obs.cameras.items()]),
        tuple([(name, values.shape) for name, values in obs.state.items()]),
    )


def is_compact(message: Buffer) -> bool:
    """Return whether a message on a WebSocket is in compact form."""
    return message[: len(STREAM_TAG)] == STREAM_TAG


def write_answers(replies: Sequence[Reply], *, arrived: float) -> bytes | None:
    """Encode the replies to acts, with the `timing` of `encode_replies`; return None if they must
    be sent as a frame.
    """
    begun = time.perf_counter()
    actions, weights = [], []
    for reply in replies:
        act = reply.act
        if reply.error is not None or act is None or act.action.dtype != _FLOAT32:
            return None
        if act.info:
            packed = _packed(act.info)
            if packed is None:
                return None
            weights.append(packed)
        if (
            act.action.ndim not in (1, 2)
            or act.action.shape[0] > 0xFFFF
            or len(reply.request_id) > _ID_BYTES
        ):
            return None
        actions.append(act.action.tobytes())

    # The compact form has weights for all replies or for none.
    if weights and len(weights) != len(replies):
        return None
    weights_flag = _POLICY if weights else 0

    ended = time.perf_counter()
    parts = [COUNT.pack(len(replies))]
    for reply in replies:
        act = reply.act
        timing = reply.timing
        encode_ms = timing["encode_ms"] = (ended - begun) * 1e3
        total_ms = timing["total_ms"] = (ended - arrived) * 1e3
        shape = act.action.shape  # type: ignore[union-attr]
        flags = weights_flag | (_DONE if act.done else 0) | (_DRAINING if reply.draining else 0)  # type: ignore[union-attr]
        parts.append(
            ANSWER.pack(
                reply.request_id.encode(),
                reply.step or 0,
                flags,
                len(shape),
                shape[0],
                shape[-1],
                int(timing["batch_size"]),
                timing["queue_ms"],
                timing["inference_ms"],
                timing["decode_ms"],
                encode_ms,
                total_ms,
            )
        )
    return b"".join(parts + actions + weights)


def _packed(info: Mapping[str, Any]) -> bytes | None:
    """Encode the weights in the info of an act; return None if the info contains anything else."""
    policy = info.get(POLICY)
    if len(info) != 1 or type(policy) is not dict or len(policy) != 2:
        return None
    try:
        return _pack(policy["version"], policy["fingerprint"])
    except (KeyError, TypeError, AttributeError, ValueError, struct.error):
        # The policy uses this key for other data.
        return None


@lru_cache(64)
def _pack(version: int, digest: str) -> bytes | None:
    """Encode the weights of an answer; None if the digest does not fit."""
    if len(digest) > 16 or "\0" in digest:
        return None
    return WEIGHTS.pack(version, digest.encode("ascii"))


@lru_cache(64)
def _text(digest: bytes) -> str:
    """Decode the digest of weights."""
    return digest.rstrip(b"\0").decode("ascii")


def read_answers(message: memoryview) -> list[Reply]:
    """Decode the replies in a message, the inverse of `write_answers`."""
    (count,) = COUNT.unpack_from(message)
    action_at = COUNT.size + count * ANSWER.size
    # The offset of the next answer's weights, if the flag _POLICY is set.
    weights_at = len(message) - count * WEIGHTS.size

    replies = []
    for answer in ANSWER.iter_unpack(message[COUNT.size : action_at]):
        (
            request_id,
            step,
            flags,
            dimensions,
            rows,
            columns,
            batch_size,
            queue,
            inference,
            decode,
            encode,
            total,
        ) = answer
        count_of_numbers = columns if dimensions == 1 else rows * columns
        action = np.frombuffer(message, _FLOAT32, count_of_numbers, action_at).copy()
        action_at += action.nbytes
        if dimensions == 2:
            action = action.reshape(rows, columns)
        timing = {
            "queue_ms": queue,
            "inference_ms": inference,
            "decode_ms": decode,
            "encode_ms": encode,
            "total_ms": total,
            "batch_size": batch_size,
        }
        info = {}
        if flags & _POLICY:
            version, digest = WEIGHTS.unpack_from(message, weights_at)
            weights_at += WEIGHTS.size
            info = {POLICY: {"version": version, "fingerprint": _text(digest)}}

        replies.append(
            Reply(
                request_id.rstrip(b"\0").decode(),
                Act(action, bool(flags & _DONE), info),
                step=step,
                draining=bool(flags & _DRAINING),
                timing=timing,
            )
        )
    return replies
