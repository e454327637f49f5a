"""Conversion between nested values (None, bool, numbers, text, bytes, arrays, lists, dicts) and
JSON with blobs.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import (
    InvalidInput,
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    shown,
)
from vlagents_ray.images.codecs import ImageCodec, decode_files, encode_files
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.frame_layout import Buffer, is_plain, parse_json, read_array
from vlagents_ray.protocol.messages import NAME_CHARACTERS, Budget, MessageLimits
from vlagents_ray.validation import described

_UINT8, _FLOAT32 = np.dtype(np.uint8), np.dtype(np.float32)
_OBS_KEYS = {"cameras", "gripper", "state", "info"}


class ValueWriter:
    """Converts values to JSON and collects the blobs that they refer to."""

    def __init__(self) -> None:
        self.blobs: list[Buffer] = []

    def array(self, value: np.ndarray) -> dict[str, Any]:
        """Return a reference to an array, whose bytes become a blob, without a copy where
        possible.
        """
        dtype = value.dtype.newbyteorder("<")
        if not is_plain(dtype.str):
            raise InvalidInput(
                f"array: expected a dtype of bool, integers or floats, got {value.dtype}; convert "
                "it"
            )
        data = np.ascontiguousarray(value, dtype)
        self.blobs.append(data.data.cast("B") if data.size else b"")
        return {"$": ["nd", len(self.blobs) - 1, dtype.str, value.shape]}

    def image(self, file: bytes) -> dict[str, Any]:
        """Return a reference to an encoded image, which becomes a blob."""
        self.blobs.append(file)
        return {"$": ["img", len(self.blobs) - 1]}

    def value(self, value: Any) -> Any:
        """Return the JSON form of a value.

        Raises:
            InvalidInput: The type of the value is not supported; the message names it.
        """
        if value is None or isinstance(value, (bool, str, int)):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"$": ["float", str(float(value))]}
        if isinstance(value, np.ndarray):
            return self.array(value)
        if isinstance(value, np.generic):
            if value.dtype.kind in "biuf":
                return self.value(value.item())
            return self.array(np.asarray(value))
        if isinstance(value, (bytes, bytearray, memoryview)):
            self.blobs.append(bytes(value))
            return {"$": ["bin", len(self.blobs) - 1]}
        # `dict` comes first, since the check of an abstract class takes ten times as long.
        if isinstance(value, (dict, Mapping)):
            for key in value:
                if not isinstance(key, str) or key == "$":
                    raise InvalidInput(
                        f"info: expected keys that are text other than '$', got {key!r}"
                    )
            return {key: self.value(item) for key, item in value.items()}
        if isinstance(value, (list, Sequence)):
            return [self.value(item) for item in value]
        raise InvalidInput(
            "info: expected None, bool, int, float, str, bytes, array, list or dict, got "
            f"{type(value).__name__}"
        )


class ValueReader:
    """Converts JSON back to values, which are views of the blobs where possible."""

    def __init__(self, blobs: Sequence[Buffer], budget: Budget) -> None:
        self._blobs, self._budget = blobs, budget
        self.limits = budget.limits
        self._items = 0
        # The decoded images by blob. Each is decoded once, even if it is used several times.
        self._images: dict[int, np.ndarray] = {}
        self._copies: dict[int, bytes] = {}  # the bytes by blob; each is copied once
        # The blobs that were decoded in advance and have not been referenced yet.
        self._fresh: set[int] = set()

    def begin(self) -> None:
        """Begin another request and reset its limits."""
        self._items = 0

    def decode_images(self, nodes: Mapping[str, Any]) -> None:
        """Decode the images of several cameras together, so that `blob` returns them without
        further decoding.
        """
        new: dict[int, str] = {}
        for name, node in nodes.items():
            reference = _reference(node)
            index = reference[1] if reference[:1] == ["img"] and len(reference) == 2 else None
            if type(index) is int and index not in self._images:
                new.setdefault(index, name)
        if new:
            decoded = decode_files(
                [self._get(index) for index in new], self._budget, list(new.values())
            )
            self._images |= zip(new, decoded, strict=True)
            self._fresh.update(new)

    def value(self, node: Any, depth: int = 0) -> Any:
        """Return the value of a JSON node; raise `MalformedMessage` or `MessageTooLarge` if it
        is invalid.
        """
        self._items += 1
        if self._items > self.limits.items:
            raise MessageTooLarge(
                f"info: expected at most {self.limits.items} values, got more; send arrays "
                "instead of lists"
            )
        if not isinstance(node, (dict, list)):
            return node
        if isinstance(node, dict) and "$" in node:
            return self.blob(node)
        if depth >= self.limits.depth:
            raise MessageTooLarge(f"info: nested deeper than {self.limits.depth}; flatten it")
        if isinstance(node, dict):
            return {key: self.value(item, depth + 1) for key, item in node.items()}
        return [self.value(item, depth + 1) for item in node]

    def blob(self, node: Any) -> Any:
        """Return the array, image, bytes or number that `{"$": [...]}` refers to."""
        reference = _reference(node)
        if not reference or len(node) != 1:
            raise MalformedMessage(
                f"reference: expected {{'$': [kind, blob, ...]}}, got {shown(node)}"
            )
        kind, *rest = reference
        if kind == "nd" and len(rest) == 3:
            data = self._get(rest[0])
            self._budget.count(len(data))
            return read_array(data, rest[1], rest[2])
        if kind == "img" and len(rest) == 1:
            return self._image(rest[0])
        if kind == "bin" and len(rest) == 1:
            return self._bytes_of(rest[0])
        if kind == "float" and rest in (["nan"], ["inf"], ["-inf"]):
            return float(rest[0])
        raise MalformedMessage(
            f"reference: expected 'nd', 'img', 'bin' or 'float', got {shown(reference)}"
        )

    def _image(self, index: Any) -> np.ndarray:
        data = self._get(index)
        image = self._images.get(index)
        if image is None:
            [image] = decode_files([data], self._budget)
            self._images[index] = image
        elif index in self._fresh:  # the budget was charged when the image was decoded
            self._fresh.discard(index)
        else:  # the recipient of the request may copy each reference
            self._budget.count(image.nbytes)
            image.flags.writeable = False  # several observations share the image
        return image

    def _bytes_of(self, index: Any) -> bytes:
        data = self._get(index)
        content = self._copies.get(index)
        if content is None:
            self._budget.hold(len(data))
            content = self._copies[index] = bytes(data)
        else:
            self._budget.count(len(data))
        return content

    def _get(self, index: Any) -> Buffer:
        if type(index) is not int or not 0 <= index < len(self._blobs):
            raise MalformedMessage(
                f"reference: expected a blob below {len(self._blobs)}, got {shown(index, 20)}"
            )
        return self._blobs[index]


def _reference(node: Any) -> list[Any]:
    """Return the list in `{"$": [kind, blob, ...]}`; an empty list for anything else."""
    reference = node.get("$") if isinstance(node, dict) else None
    return reference if isinstance(reference, list) else []


def read_obs(node: Any, reader: ValueReader) -> Obs:
    """Read an observation from its JSON form, in which cameras and state parts may be references
    or lists.
    """
    limits = reader.limits
    if not isinstance(node, dict):
        raise MalformedMessage(f"obs: expected an object, got {type(node).__name__}")
    unknown = node.keys() - _OBS_KEYS
    if unknown:
        raise MalformedMessage(
            f"obs: expected keys of {sorted(_OBS_KEYS)}, got {shown(sorted(unknown))}"
        )

    cameras = node.get("cameras") or {}
    state = node.get("state") or {}
    info = node.get("info") or {}
    gripper = node.get("gripper")
    for name, value in (("cameras", cameras), ("state", state), ("info", info)):
        if not isinstance(value, dict):
            raise MalformedMessage(f"obs.{name}: expected an object, got {type(value).__name__}")
    if max(len(cameras), len(state)) > limits.cameras:
        raise MessageTooLarge(
            f"obs: expected at most {limits.cameras} cameras and states, got {len(cameras)} "
            f"cameras and {len(state)} states"
        )

    for name in (*cameras, *state):
        require_array_name(name)
    if gripper is not None and not is_number(gripper):
        raise InvalidObservation(
            f"gripper: expected a number in [0, 1] where 1 = open, got {shown(gripper)}"
        )

    reader.decode_images(cameras)
    read_info = reader.value(info)
    # A JSON object may be a reference to an array, bytes or a number.
    if not isinstance(read_info, dict):
        raise MalformedMessage(f"obs.info: expected an object, got {described(read_info)}")
    return Obs(
        cameras={
            name: as_camera(name, reader.blob(image), limits) for name, image in cameras.items()
        },
        gripper=None if gripper is None else float(gripper),
        state={
            name: as_state(name, reader.blob(item) if isinstance(item, dict) else item, limits)
            for name, item in state.items()
        },
        info=read_info,
    )


def require_array_name(name: str) -> None:
    """Raise `InvalidObservation` unless a text can be the name of a camera or of a part of the
    state.
    """
    if not 0 < len(name) <= NAME_CHARACTERS or not name.isprintable():
        raise InvalidObservation(
            f"obs: expected names of 1 to {NAME_CHARACTERS} printable characters, got a camera or "
            f"state named {name[:40]!r}"
        )


def as_camera(name: str, image: Any, limits: MessageLimits) -> np.ndarray:
    """Return `image` unchanged if it is (H, W, 3) uint8 RGB within the limits. Errors mention
    `name`.
    """
    if (
        not isinstance(image, np.ndarray)
        or image.ndim != 3
        or image.shape[2] != 3
        or image.dtype != _UINT8
    ):
        raise InvalidObservation(
            f"camera {name!r}: expected (H, W, 3) uint8 RGB, got {described(image)}"
        )
    if image.shape[0] * image.shape[1] > limits.pixels:
        raise MessageTooLarge(
            f"camera {name!r}: expected at most {limits.pixels} pixels, got {image.shape[:2]}; "
            "send a smaller image, or raise `limits.pixels`"
        )
    return image


def as_state(name: str, values: Any, limits: MessageLimits) -> np.ndarray:
    """Convert a list of numbers or an array to (D,) float32 within the limits. Errors mention
    `name`.
    """
    is_list = isinstance(values, list)
    if not is_list and (
        not isinstance(values, np.ndarray) or values.ndim != 1 or values.dtype.kind not in "fiu"
    ):
        raise InvalidObservation(f"state {name!r}: expected (D,) float32, got {described(values)}")
    if len(values) > limits.state_values:
        raise MessageTooLarge(
            f"state {name!r}: expected at most {limits.state_values} values, got {len(values)}"
        )
    if is_list and not all(is_number(number) for number in values):
        raise InvalidObservation(f"state {name!r}: expected a list of numbers")

    array: np.ndarray = np.array(values, dtype=np.float64) if is_list else values
    # Entering numpy's `errstate` takes longer than all other work on a state.
    if array.dtype == _FLOAT32:
        return array
    try:
        with np.errstate(over="raise"):
            return array.astype(np.float32)
    except FloatingPointError as error:
        raise InvalidObservation(
            f"state {name!r}: expected numbers within float32, got a larger number"
        ) from error


def require_obs(obs: Any) -> None:
    """Raise `InvalidObservation` if `obs`, a value from a user's program, cannot be sent as an
    observation.
    """
    if not isinstance(obs, Obs):
        raise InvalidObservation(
            f"observation: expected an Obs, got {described(obs)}; make one, as in "
            f"Obs(cameras={{…}}, state={{…}})"
        )
    for name, value in (("cameras", obs.cameras), ("state", obs.state), ("info", obs.info)):
        if not isinstance(value, Mapping):
            raise InvalidObservation(
                f"{name}: expected a dict of values by name, got {described(value)}"
            )

    for name, image in obs.cameras.items():
        if not hasattr(image, "dtype"):
            raise InvalidObservation(
                f"camera {name!r}: expected (H, W, 3) uint8 RGB, got {described(image)}; leave out "
                "a camera that has no picture, and convert other types with np.asarray(image, "
                "np.uint8)"
            )
    for name, values in obs.state.items():
        if not hasattr(values, "dtype") or values.dtype.kind not in "fiub":
            _as_float32(name, values)

    if obs.gripper is not None:
        try:
            float(obs.gripper)
        except (TypeError, ValueError) as error:
            raise InvalidObservation(
                f"gripper: expected None or a number, got {described(obs.gripper)}"
            ) from error


def _as_float32(name: str, values: Any) -> np.ndarray:
    """Convert a part of the state; raise `InvalidObservation` if its values are not numbers."""
    try:
        array = np.asarray(values)
        # Without this check, text and complex numbers would also be converted.
        if values is None or array.dtype.kind not in "fiubO":
            raise TypeError
        return array.astype(np.float32)
    except (TypeError, ValueError) as error:
        raise InvalidObservation(
            f"state {name!r}: expected (D,) float32, got {described(values)}"
        ) from error


def write_obs(obs: Obs, writer: ValueWriter, codec: ImageCodec) -> dict[str, Any]:
    """Convert an observation, which is not changed, to its JSON form. Raw images and arrays are
    views, not copies.
    """
    if codec.name == "raw":
        cameras = {name: writer.array(image) for name, image in obs.cameras.items()}
    else:
        files = encode_files(list(obs.cameras.values()), codec)
        cameras = {name: writer.image(file) for name, file in zip(obs.cameras, files, strict=True)}
    return {
        "cameras": cameras,
        "gripper": None if obs.gripper is None else float(obs.gripper),
        "state": {
            name: writer.array(np.asarray(values, np.float32)) for name, values in obs.state.items()
        },
        "info": writer.value(obs.info),
    }


def is_number(value: object) -> bool:
    """Return whether a value is a number that a float can represent. As in JSON, a bool is not a
    number.
    """
    if isinstance(value, int):
        return not isinstance(value, bool) and value.bit_length() < 1024
    return isinstance(value, float)


def require_plain(value: Any, depth: int) -> None:
    """Raise an error if a value decoded from another protocol has a type that frames cannot
    contain, a key that is not text, or more than `depth` levels.
    """
    if isinstance(value, (dict, list)):
        if depth <= 0:
            raise MessageTooLarge("message: nested too deep; flatten it")
        for key in value if isinstance(value, dict) else ():
            if not isinstance(key, str):
                raise MalformedMessage(f"message: expected keys that are text, got {shown(key)}")
        for item in value.values() if isinstance(value, dict) else value:
            require_plain(item, depth - 1)
    elif value is not None and not isinstance(
        value, (bool, int, float, str, bytes, np.ndarray, np.generic)
    ):
        raise MalformedMessage(
            f"message: expected plain values and arrays, got a {type(value).__name__}"
        )


def to_text(value: Any) -> str:
    """Convert a value to JSON with arrays and bytes in base64.

    Raises:
        InvalidInput: The type of the value is not supported, see `ValueWriter`.
    """
    writer = ValueWriter()
    plain = writer.value(value)
    blobs = [base64.b64encode(blob).decode() for blob in writer.blobs]
    return json.dumps(
        {"value": plain, "blobs": blobs} if blobs else {"value": plain}, separators=(",", ":")
    )


def from_text(text: str, budget: Budget) -> Any:
    """Return the value from text that `to_text` has written.

    Raises:
        MalformedMessage: The text does not have that format.
    """
    document = parse_json(text, "value:", long=True)
    try:
        blobs = [base64.b64decode(blob, validate=True) for blob in document.get("blobs", ())]
        return ValueReader(blobs, budget).value(document["value"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise MalformedMessage(f"value: {type(error).__name__}: {error}") from error
