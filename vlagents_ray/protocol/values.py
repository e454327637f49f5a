"""Nested values (None, bool, numbers, text, bytes, arrays, lists, dicts) <-> JSON plus binary blobs.

Values that JSON cannot express become `{"$": [kind, blob index, ...]}`: `["nd", i, dtype, shape]` an array, `["img",
i]` a JPEG or PNG file, `["bin", i]` bytes; `["float", "nan"]`, "inf" and "-inf" need no blob.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge, shown
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.protocol.arrays import Buffer, is_plain, read_array
from vlagents_ray.protocol.frame_layout import parse_json
from vlagents_ray.protocol.messages import Budget


class ValueWriter:
    """Converts values to JSON and collects the blobs that they refer to."""

    def __init__(self) -> None:
        self.blobs: list[Buffer] = []

    def array(self, value: np.ndarray) -> dict[str, Any]:
        """Return the reference to an array, whose bytes become a blob, without a copy where possible."""
        dtype = value.dtype.newbyteorder("<").str
        if not is_plain(dtype):
            raise InvalidInput(f"array: got dtype {value.dtype}, want bool, integers or floats; convert it")
        data = np.ascontiguousarray(value, dtype=dtype)
        self.blobs.append(data.data.cast("B") if data.size else b"")
        return {"$": ["nd", len(self.blobs) - 1, dtype, value.shape]}

    def image(self, file: bytes) -> dict[str, Any]:
        """Return the reference to an encoded image."""
        self.blobs.append(file)
        return {"$": ["img", len(self.blobs) - 1]}

    def value(self, value: Any) -> Any:
        """Return the JSON of a supported value; raises `InvalidInput` with the type of an unsupported one."""
        if value is None or isinstance(value, (bool, str, int)):
            return value
        if isinstance(value, float):
            return value if math.isfinite(value) else {"$": ["float", str(float(value))]}
        if isinstance(value, np.ndarray):
            return self.array(value)
        if isinstance(value, np.generic):
            return self.value(value.item()) if value.dtype.kind in "biuf" else self.array(np.asarray(value))
        if isinstance(value, (bytes, bytearray, memoryview)):
            self.blobs.append(bytes(value))
            return {"$": ["bin", len(self.blobs) - 1]}
        if isinstance(value, Mapping):
            for key in value:
                if not isinstance(key, str) or key == "$":
                    raise InvalidInput(f"info: got key {key!r}, want text other than '$'")
            return {key: self.value(item) for key, item in value.items()}
        if isinstance(value, Sequence):
            return [self.value(item) for item in value]
        raise InvalidInput(
            f"info: got {type(value).__name__}, want None, bool, int, float, str, bytes, array, list or dict"
        )


class ValueReader:
    """Converts the JSON back to values, which are views of the blobs, not copies."""

    def __init__(self, blobs: Sequence[Buffer], budget: Budget) -> None:
        self._blobs = blobs
        self._budget = budget
        self._limits = budget.limits
        self._items = 0
        self._images: dict[int, np.ndarray] = {}  # by blob; each is decoded once, however often it is referred to
        self._copies: dict[int, bytes] = {}  # by blob; each is copied once
        self._fresh: set[int] = set()  # blobs that were decoded in advance and not referred to yet

    def begin(self) -> None:
        """Begin another request, with limits of its own."""
        self._items = 0

    def decode_images(self, nodes: Mapping[str, Any]) -> None:
        """Decode the images that `nodes` refer to, by camera, all at once; `blob` then returns them at once."""
        new: dict[int, str] = {}
        for name, node in nodes.items():
            reference = _reference(node)
            index = reference[1] if reference[:1] == ["img"] and len(reference) == 2 else None
            if type(index) is int and index not in self._images:
                new.setdefault(index, name)
        if new:
            decoded = decode_files([self._get(index) for index in new], self._budget, list(new.values()))
            self._images |= zip(new, decoded, strict=True)
            self._fresh.update(new)

    def value(self, node: Any, depth: int = 0) -> Any:
        """Return the value of a JSON node; raises `MalformedMessage` or `MessageTooLarge` if it is invalid."""
        self._items += 1
        if self._items > self._limits.items:
            raise MessageTooLarge(f"info: more than {self._limits.items} values; send arrays instead of lists")
        if isinstance(node, dict):
            if "$" in node:
                return self.blob(node)
            self._nest(depth)
            return {key: self.value(item, depth + 1) for key, item in node.items()}
        if isinstance(node, list):
            self._nest(depth)
            return [self.value(item, depth + 1) for item in node]
        return node

    def blob(self, node: Any) -> Any:
        """Return the array, image, bytes or number that `{"$": [...]}` refers to."""
        reference = _reference(node)
        if not reference or len(node) != 1:
            raise MalformedMessage(f"reference: got {shown(node)}, want {{'$': [kind, blob, ...]}}")
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
        raise MalformedMessage(f"reference: got {shown(reference)}, want 'nd', 'img', 'bin' or 'float'")

    def _image(self, index: Any) -> np.ndarray:
        data = self._get(index)
        image = self._images.get(index)
        if image is None:
            [image] = decode_files([data], self._budget)
            self._images[index] = image
        elif index in self._fresh:  # it was counted when it was decoded
            self._fresh.discard(index)
        else:  # a further reference costs its readers as much again
            self._budget.count(image.nbytes)
            image.flags.writeable = False  # several observations share it
        return image

    def _bytes_of(self, index: Any) -> bytes:
        data = self._get(index)
        known = self._copies.get(index)
        if known is None:
            self._budget.hold(len(data))
            known = self._copies[index] = bytes(data)
        else:
            self._budget.count(len(data))
        return known

    def _nest(self, depth: int) -> None:
        if depth >= self._limits.depth:
            raise MessageTooLarge(f"info: nested deeper than {self._limits.depth}; flatten it")

    def _get(self, index: Any) -> Buffer:
        if type(index) is not int or not 0 <= index < len(self._blobs):
            raise MalformedMessage(f"reference: got blob {shown(index, 20)}, want a number below {len(self._blobs)}")
        return self._blobs[index]


def _reference(node: Any) -> list[Any]:
    """Return the list in `{"$": [kind, blob, ...]}`; an empty one for anything else."""
    reference = node.get("$") if isinstance(node, dict) else None
    return reference if isinstance(reference, list) else []


def require_plain(value: Any, depth: int) -> None:
    """Raise unless `value`, from another protocol's message, has only types of the wire, text keys, and `depth`
    levels.
    """
    if isinstance(value, (dict, list)):
        if depth <= 0:
            raise MessageTooLarge("message: nested too deep; flatten it")
        for key in value if isinstance(value, dict) else ():
            if not isinstance(key, str):
                raise MalformedMessage(f"message: got key {shown(key)}, want text")
        for item in value.values() if isinstance(value, dict) else value:
            require_plain(item, depth - 1)
    elif value is not None and not isinstance(value, (bool, int, float, str, bytes, np.ndarray, np.generic)):
        raise MalformedMessage(f"message: got a {type(value).__name__}, want plain values and arrays")


def to_text(value: Any) -> str:
    """Return a supported value as JSON, with its arrays and bytes in base64; raises `InvalidInput` as `ValueWriter`."""
    writer = ValueWriter()
    plain = writer.value(value)
    blobs = [base64.b64encode(blob).decode() for blob in writer.blobs]
    return json.dumps({"value": plain, "blobs": blobs} if blobs else {"value": plain}, separators=(",", ":"))


def from_text(text: str, budget: Budget) -> Any:
    """Return the value of which `to_text` made the text; raises `MalformedMessage` if there is none."""
    document = parse_json(text, "value:", long=True)
    try:
        blobs = [base64.b64decode(blob, validate=True) for blob in document.get("blobs", ())]
        return ValueReader(blobs, budget).value(document["value"])
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise MalformedMessage(f"value: {type(error).__name__}: {error}") from error
