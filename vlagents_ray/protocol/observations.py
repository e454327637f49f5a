"""An observation as a node of a frame's header; its cameras and arrays become blobs."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation, MalformedMessage, MessageTooLarge, shown
from vlagents_ray.images.codecs import ImageCodec, encode_files
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import NAME_CHARACTERS, Limits
from vlagents_ray.protocol.values import ValueReader, ValueWriter

_OBS_KEYS = {"cameras", "gripper", "state", "info"}


def read_obs(node: Any, reader: ValueReader, limits: Limits) -> Obs:
    """Return an observation from its JSON form, in which cameras and state parts may be references or lists."""
    if not isinstance(node, dict):
        raise MalformedMessage(f"obs: got {type(node).__name__}, want an object")
    unknown = node.keys() - _OBS_KEYS
    if unknown:
        raise MalformedMessage(f"obs: unknown keys {shown(sorted(unknown))}, want some of {sorted(_OBS_KEYS)}")
    cameras, state = node.get("cameras") or {}, node.get("state") or {}
    info, gripper = node.get("info") or {}, node.get("gripper")
    for name, value in (("cameras", cameras), ("state", state), ("info", info)):
        if not isinstance(value, dict):
            raise MalformedMessage(f"obs.{name}: got {type(value).__name__}, want an object")
    if max(len(cameras), len(state)) > limits.cameras:
        raise MessageTooLarge(f"obs: got {len(cameras)} cameras and {len(state)} states, the limit is {limits.cameras}")
    for name in (*cameras, *state):
        if not 0 < len(name) <= NAME_CHARACTERS or not name.isprintable():
            raise InvalidObservation(
                f"obs: got a camera or state named {name[:40]!r}, want 1 to {NAME_CHARACTERS} printable characters"
            )
    if gripper is not None and not is_number(gripper):
        raise InvalidObservation(f"gripper: got {shown(gripper)}, want a number in [0, 1] where 1 = open")
    reader.decode_images(cameras)
    return Obs(
        cameras={name: as_camera(name, reader.blob(image), limits) for name, image in cameras.items()},
        gripper=None if gripper is None else float(gripper),
        state={
            name: as_state(name, reader.blob(part) if isinstance(part, dict) else part, limits)
            for name, part in state.items()
        },
        info=reader.value(info),
    )


def as_camera(name: str, image: Any, limits: Limits) -> np.ndarray:
    """Return `image` unchanged if it is (H, W, 3) uint8 RGB within the limits; `name` is for the error."""
    if not isinstance(image, np.ndarray) or image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        got = f"{image.shape} {image.dtype}" if isinstance(image, np.ndarray) else type(image).__name__
        raise InvalidObservation(f"camera {name!r}: got {got}, want (H, W, 3) uint8 RGB")
    if image.shape[0] * image.shape[1] > limits.pixels:
        raise MessageTooLarge(
            f"camera {name!r}: got {image.shape[:2]} pixels, the limit is {limits.pixels}; send it smaller, or raise "
            f"`limits.pixels`"
        )
    return image


def as_state(name: str, part: Any, limits: Limits) -> np.ndarray:
    """Return `part`, a list of numbers or an array, as (D,) float32 within the limits; `name` is for the error."""
    if isinstance(part, list):
        if len(part) > limits.state_values:
            raise MessageTooLarge(f"state {name!r}: got {len(part)} values, the limit is {limits.state_values}")
        if not all(is_number(x) for x in part):
            raise InvalidObservation(f"state {name!r}: want a list of numbers")
        return _single(name, np.array(part, dtype=np.float64))
    if not isinstance(part, np.ndarray) or part.ndim != 1 or part.dtype.kind not in "fiu":
        got = f"{part.shape} {part.dtype}" if isinstance(part, np.ndarray) else type(part).__name__
        raise InvalidObservation(f"state {name!r}: got {got}, want (D,) float32")
    if part.size > limits.state_values:
        raise MessageTooLarge(f"state {name!r}: got {part.size} values, the limit is {limits.state_values}")
    return _single(name, part)


def _single(name: str, part: np.ndarray) -> np.ndarray:
    try:
        with np.errstate(over="raise"):
            return part.astype(np.float32, copy=False)
    except FloatingPointError as error:
        raise InvalidObservation(f"state {name!r}: got a number beyond those of float32, want it within") from error


def write_obs(obs: Obs, writer: ValueWriter, codec: ImageCodec) -> dict[str, Any]:
    """Return the node of an observation, which is not changed; raw images and arrays are views, not copies."""
    if codec.name == "raw":
        cameras = {name: writer.array(image) for name, image in obs.cameras.items()}
    else:
        files = encode_files(list(obs.cameras.values()), codec)
        cameras = {name: writer.image(file) for name, file in zip(obs.cameras, files, strict=True)}
    return {
        "cameras": cameras,
        "gripper": None if obs.gripper is None else float(obs.gripper),
        "state": {name: writer.array(np.asarray(part, np.float32)) for name, part in obs.state.items()},
        "info": writer.value(obs.info),
    }


def is_number(value: object) -> bool:
    """Whether a value is a number that a float can hold.

    A bool is not, since JSON tells it apart and Python does not.
    """
    if isinstance(value, int):
        return not isinstance(value, bool) and value.bit_length() < 1024
    return isinstance(value, float)
