"""The binary frame: one message, whole, with its images and arrays as aligned raw bytes.

    offset 0   b"VLA" and the version byte 1
           4   length of the header in bytes, uint32 little-endian
           8   header: JSON in UTF-8, its key "blobs" lists the length of each blob
           …   blobs, each beginning at a multiple of 8 from the start of the frame

The same frame travels in an HTTP body, in a WebSocket message and through shared memory, so it
holds everything that a request needs but its session, which the carrier knows.
"""

from __future__ import annotations

import json
import struct
import time
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from vlagents_ray import images
from vlagents_ray.errors import (
    InvalidInput,
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    VLAgentsError,
    from_code,
)
from vlagents_ray.interface import Act, Obs
from vlagents_ray.wire.messages import DEFAULT_LIMITS, OPS, PROTOCOL_VERSION, Limits, Op, Reply, Request
from vlagents_ray.wire.tree import Buffer, Reader, Writer

CONTENT_TYPE = "application/x-vlagents-frame"
_PREFIX = struct.Struct("<3sBI")
_ALIGN = 8
_dump = json.JSONEncoder(separators=(",", ":")).encode  # made once: `json.dumps` makes one each time
_REQUEST_KEYS = {"op", "obs", "instruction", "kwargs", "contract", "request_id", "deadline_ms", "blobs"}
_OBS_KEYS = {"cameras", "gripper", "state", "info"}


@dataclass(frozen=True, slots=True)
class ImageCodec:
    """How cameras are written: raw pixels, or JPEG. Lossy coding is the caller's choice."""

    name: str = "jpeg"  # "jpeg" or "raw"
    quality: int = 85
    subsampling: str = "444"

    def __post_init__(self) -> None:
        if self.name not in ("jpeg", "raw"):
            raise InvalidInput(f"codec: got {self.name!r}, want 'jpeg' or 'raw'")


RAW = ImageCodec("raw")
JPEG = ImageCodec("jpeg")


def encode_request(request: Request, codec: ImageCodec = RAW) -> bytes:
    """A request as one frame. `request.obs` is left as it is."""
    return b"".join(request_parts(request, codec))


def request_parts(request: Request, codec: ImageCodec = RAW) -> list[Buffer]:
    """The pieces of a request's frame, in order; raw images and arrays are views, not copies."""
    writer = Writer()
    header: dict[str, Any] = {"op": request.op}
    if request.obs is not None:
        header["obs"] = _write_obs(request.obs, writer, codec)
    if request.instruction is not None:
        header["instruction"] = request.instruction
    if request.kwargs:
        header["kwargs"] = writer.value(request.kwargs)
    if request.contract is not None:
        header["contract"] = request.contract
    if request.request_id:
        header["request_id"] = request.request_id
    if request.deadline_ms is not None:
        header["deadline_ms"] = request.deadline_ms
    return _parts(header, writer.blobs)


def decode_request(data: Buffer, limits: Limits = DEFAULT_LIMITS) -> Request:
    """The request in a frame. Its arrays view `data`; nothing in it is executed or unpickled."""
    header, blobs = _split(data, limits)
    unknown = header.keys() - _REQUEST_KEYS
    if unknown:
        raise MalformedMessage(f"request: unknown keys {sorted(unknown)}, want some of {sorted(_REQUEST_KEYS)}")
    if header.get("op") not in OPS:
        raise MalformedMessage(f"op: got {str(header.get('op'))[:40]!r}, want one of {list(OPS)}")
    reader = Reader(blobs, limits)
    obs = header.get("obs")
    return check_request(
        Request(
            op=cast(Op, header["op"]),
            obs=None if obs is None else read_obs(obs, reader, limits),
            instruction=header.get("instruction"),
            kwargs=reader.value(header.get("kwargs") or {}),
            contract=header.get("contract"),
            request_id=header.get("request_id", ""),
            deadline_ms=header.get("deadline_ms"),
        ),
        limits,
    )


def check_request(request: Request, limits: Limits) -> Request:
    """Types and sizes of the parts that JSON leaves open, whichever format they came in."""
    if request.obs is None and request.op != "close":
        raise MalformedMessage(f"{request.op}: no 'obs'; send the observation")
    for name in ("instruction", "request_id"):
        text = getattr(request, name)
        if text is not None and not isinstance(text, str):
            raise MalformedMessage(f"{name}: got {type(text).__name__}, want text")
        if text and len(text) > limits.text:
            raise MessageTooLarge(f"{name}: got {len(text)} characters, the limit is {limits.text}")
    for name in ("kwargs", "contract"):
        value = getattr(request, name)
        if value is not None and not isinstance(value, dict):
            raise MalformedMessage(f"{name}: got {type(value).__name__}, want an object")
    if request.deadline_ms is not None and not (_is_number(request.deadline_ms) and request.deadline_ms > 0):
        raise MalformedMessage(f"deadline_ms: got {str(request.deadline_ms)[:40]}, want a positive number")
    return request


def encode_reply(reply: Reply, *, arrived: float | None = None) -> bytes:
    """A reply as one frame.

    With `arrived`, the `time.perf_counter()` at which its request was here, `reply.timing` also gets
    `encode_ms` and `total_ms`, in ms and true up to the joining of the frame's parts.
    """
    begun = time.perf_counter()
    writer = Writer()
    header: dict[str, Any] = {"request_id": reply.request_id}
    if reply.error is not None:
        header["error"] = {"code": reply.error.code, "detail": str(reply.error)}
    if reply.act is not None:
        header["act"] = {
            "action": writer.array(reply.act.action),
            "done": bool(reply.act.done),
            "info": writer.value(reply.act.info),
        }
    if reply.info is not None:
        header["info"] = writer.value(reply.info)
    head = _head(header, writer.blobs)
    if arrived is not None:
        ended = time.perf_counter()
        reply.timing |= {"encode_ms": (ended - begun) * 1e3, "total_ms": (ended - arrived) * 1e3}
    if reply.timing:  # last and apart, so that it can tell what the rest has cost
        head = f'{head[:-1]},"timing":{_timing(reply.timing)}}}'
    return b"".join(_assemble(head.encode(), writer.blobs))


def decode_reply(data: Buffer, limits: Limits = DEFAULT_LIMITS) -> Reply:
    """The reply in a frame; a server's error comes back as the same class that it raised."""
    header, blobs = _split(data, limits)
    reader = Reader(blobs, limits)
    reply = Reply(request_id=str(header.get("request_id", "")), timing=header.get("timing") or {})
    if (error := header.get("error")) is not None:
        reply.error = read_error(error)
    elif (act := header.get("act")) is not None:
        try:
            reply.act = Act(reader.blob(act["action"]), bool(act["done"]), reader.value(act["info"]))
        except (KeyError, TypeError) as error:
            raise MalformedMessage(f"reply: got {str(act)[:80]}, want action, done and info") from error
    else:
        reply.info = reader.value(header.get("info") or {})
    return reply


def read_error(node: Any) -> VLAgentsError:
    """The error that a reply or a problem+json document stands for."""
    if not isinstance(node, dict):
        return VLAgentsError(str(node))
    return from_code(str(node.get("code", "")), str(node.get("detail", "")))


def read_obs(node: Any, reader: Reader, limits: Limits) -> Obs:
    """An observation from its JSON form, in which cameras and state parts may be references or lists."""
    if not isinstance(node, dict):
        raise MalformedMessage(f"obs: got {type(node).__name__}, want an object")
    unknown = node.keys() - _OBS_KEYS
    if unknown:
        raise MalformedMessage(f"obs: unknown keys {sorted(unknown)}, want some of {sorted(_OBS_KEYS)}")
    cameras, state = node.get("cameras") or {}, node.get("state") or {}
    info, gripper = node.get("info") or {}, node.get("gripper")
    for name, value in (("cameras", cameras), ("state", state), ("info", info)):
        if not isinstance(value, dict):
            raise MalformedMessage(f"obs.{name}: got {type(value).__name__}, want an object")
    if max(len(cameras), len(state)) > limits.cameras:
        raise MessageTooLarge(f"obs: got {len(cameras)} cameras and {len(state)} states, the limit is {limits.cameras}")
    if gripper is not None and not _is_number(gripper):
        raise InvalidObservation(f"gripper: got {str(gripper)[:40]!r}, want a number in [0, 1] where 1 = open")
    return Obs(
        cameras={name: _read_camera(name, image, reader, limits) for name, image in cameras.items()},
        gripper=None if gripper is None else float(gripper),
        state={name: _read_state(name, part, reader, limits) for name, part in state.items()},
        info=reader.value(info),
    )


def _read_camera(name: str, node: Any, reader: Reader, limits: Limits) -> np.ndarray:
    image = reader.blob(node)
    if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        got = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise InvalidObservation(f"camera {name!r}: got {got}, want (H, W, 3) uint8 RGB")
    if image.shape[0] * image.shape[1] > limits.pixels:
        raise MessageTooLarge(f"camera {name!r}: got {image.shape[:2]} pixels, the limit is {limits.pixels}")
    return image


def _read_state(name: str, node: Any, reader: Reader, limits: Limits) -> np.ndarray:
    part = reader.blob(node) if isinstance(node, dict) else node
    if isinstance(part, list):
        if len(part) > limits.state_values:
            raise MessageTooLarge(f"state {name!r}: got {len(part)} values, the limit is {limits.state_values}")
        if not all(_is_number(x) for x in part):
            raise InvalidObservation(f"state {name!r}: want a list of numbers")
        return np.asarray(part, dtype=np.float32)
    if not isinstance(part, np.ndarray) or part.ndim != 1 or part.dtype.kind not in "fiu":
        got = f"{part.shape} {part.dtype}" if isinstance(part, np.ndarray) else type(part).__name__
        raise InvalidObservation(f"state {name!r}: got {got}, want (D,) float32")
    if part.size > limits.state_values:
        raise MessageTooLarge(f"state {name!r}: got {part.size} values, the limit is {limits.state_values}")
    return part.astype(np.float32, copy=False)


def _write_obs(obs: Obs, writer: Writer, codec: ImageCodec) -> dict[str, Any]:
    if codec.name == "raw":
        cameras = {name: writer.array(image) for name, image in obs.cameras.items()}
    else:
        cameras = {
            name: writer.image(images.encode_jpeg(image, codec.quality, codec.subsampling))
            for name, image in obs.cameras.items()
        }
    return {
        "cameras": cameras,
        "gripper": None if obs.gripper is None else float(obs.gripper),
        "state": {name: writer.array(np.asarray(part, np.float32)) for name, part in obs.state.items()},
        "info": writer.value(obs.info),
    }


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _parts(header: dict[str, Any], blobs: list[Buffer]) -> list[Buffer]:
    return _assemble(_head(header, blobs).encode(), blobs)


def _head(header: dict[str, Any], blobs: list[Buffer]) -> str:
    header["blobs"] = [len(blob) for blob in blobs]
    return _dump(header)


def _timing(timing: dict[str, float]) -> str:
    """As JSON, times to 0.1 us; a third of what an encoder takes for their last digits."""
    return "{" + ",".join([f'"{k}":{v:.4f}' if type(v) is float else f'"{k}":{v}' for k, v in timing.items()]) + "}"


def _assemble(head: bytes, blobs: list[Buffer]) -> list[Buffer]:
    parts: list[Buffer] = [_PREFIX.pack(b"VLA", PROTOCOL_VERSION, len(head)), head]
    at = _PREFIX.size + len(head)
    for blob in blobs:
        gap = -at % _ALIGN
        parts += (b"\0" * gap, blob)
        at += gap + len(blob)
    return parts


def _split(data: Buffer, limits: Limits) -> tuple[dict[str, Any], list[Buffer]]:
    if len(data) > limits.body_bytes:
        raise MessageTooLarge(f"frame: got {len(data)} bytes, the limit is {limits.body_bytes}")
    if len(data) < _PREFIX.size:
        raise MalformedMessage(f"frame: got {len(data)} bytes, want at least {_PREFIX.size}")
    magic, version, length = _PREFIX.unpack_from(data)
    if magic != b"VLA":
        raise MalformedMessage(f"frame: got {magic!r} at its start, want b'VLA'; is this a vlagents_ray frame?")
    if version != PROTOCOL_VERSION:
        raise MalformedMessage(f"frame: got version {version}, this side speaks {PROTOCOL_VERSION}; upgrade the older")
    view = memoryview(data)
    at = _PREFIX.size + length
    if at > len(view):
        raise MalformedMessage(f"frame: ends inside its header ({len(view)} of {at} bytes); it was truncated")
    try:
        header = json.loads(bytes(view[_PREFIX.size : at]))
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"frame: the header is not JSON ({error})") from error
    lengths = header.get("blobs") if isinstance(header, dict) else None
    if not isinstance(lengths, list) or not all(type(n) is int and n >= 0 for n in lengths):
        raise MalformedMessage("frame: the header has no list 'blobs' of lengths")
    blobs: list[Buffer] = []
    for n in lengths:
        at += -at % _ALIGN
        if at + n > len(view):
            raise MalformedMessage(f"frame: ends inside a blob ({len(view)} of {at + n} bytes); it was truncated")
        blobs.append(view[at : at + n])
        at += n
    if at != len(view):
        raise MalformedMessage(f"frame: {len(view) - at} bytes follow its last blob")
    return header, blobs
