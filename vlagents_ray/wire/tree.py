"""Nested values (None, bool, numbers, text, bytes, arrays, lists, dicts) <-> JSON plus binary blobs.

What JSON cannot say becomes `{"$": [kind, blob index, ...]}`:
`["nd", i, dtype, shape]` an array, `["img", i]` a JPEG or PNG file, `["bin", i]` bytes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge
from vlagents_ray.wire.arrays import Buffer, is_plain, read_array
from vlagents_ray.wire.codecs import decode_files
from vlagents_ray.wire.messages import Limits

_GROWTH = 16  # times the longest message: what its images and bytes may take; JPEG of a camera grows tenfold


class Writer:
    """Turns values into JSON, collecting the blobs they refer to."""

    def __init__(self) -> None:
        self.blobs: list[Buffer] = []

    def array(self, value: np.ndarray) -> dict[str, Any]:
        """The reference to an array, whose bytes become a blob without a copy where possible."""
        dtype = value.dtype.newbyteorder("<").str
        if not is_plain(dtype):
            raise InvalidInput(f"array: got dtype {value.dtype}, want bool, integers or floats; convert it")
        data = np.ascontiguousarray(value, dtype=dtype)
        self.blobs.append(data.data.cast("B") if data.size else b"")
        return {"$": ["nd", len(self.blobs) - 1, dtype, value.shape]}

    def image(self, file: bytes) -> dict[str, Any]:
        """The reference to an encoded image."""
        self.blobs.append(file)
        return {"$": ["img", len(self.blobs) - 1]}

    def value(self, value: Any) -> Any:
        """Any supported value; `InvalidInput` names the type of one that is not."""
        if value is None or isinstance(value, (bool, str, int)):
            return value
        if isinstance(value, float):
            return value
        if isinstance(value, np.ndarray):
            return self.array(value)
        if isinstance(value, np.generic):
            return value.item() if value.dtype.kind in "biuf" else self.array(np.asarray(value))
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


class Budget:
    """What images and bytes of one message may take: a small file that many places name is decoded for each."""

    def __init__(self, limits: Limits) -> None:
        self._left = max(_GROWTH * limits.body_bytes, 3 * limits.pixels * limits.cameras)

    def take(self, size: int) -> None:
        """Count so many bytes; `MessageTooLarge` once there are too many."""
        self._left -= size
        if self._left < 0:
            raise MessageTooLarge("message: its images and bytes are too much memory; send fewer at once")


class Reader:
    """Turns the JSON back into values, which view the blobs instead of copying them."""

    def __init__(self, blobs: Sequence[Buffer], limits: Limits, budget: Budget | None = None) -> None:
        """`budget` is the whole message's, if this reads a part of it."""
        self._blobs = blobs
        self._budget = budget or Budget(limits)
        self._limits = limits
        self._items = 0
        self._images: dict[int, np.ndarray] = {}  # by blob, decoded ahead

    def decode_images(self, nodes: Iterable[Any]) -> None:
        """Decode the images that `nodes` refer to at once; `blob` has them ready then."""
        references = [_reference(node) for node in nodes]
        found = [reference[1] for reference in references if reference[:1] == ["img"] and len(reference) == 2]
        distinct = list(dict.fromkeys(index for index in found if type(index) is int))
        if not distinct:
            return
        files = [self._get(index) for index in distinct]
        self._images = dict(zip(distinct, self._decode(files), strict=True))

    def value(self, node: Any, depth: int = 0) -> Any:
        """The value of a JSON node; `MalformedMessage` or `MessageTooLarge` if it is not one."""
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
        """The array, image or bytes that `{"$": [...]}` refers to."""
        reference = _reference(node)
        if not reference or len(node) != 1:
            raise MalformedMessage(f"reference: got {str(node)[:80]}, want {{'$': [kind, blob, ...]}}")
        kind, *rest = reference
        if kind == "nd" and len(rest) == 3:
            return read_array(self._get(rest[0]), rest[1], rest[2])
        if kind == "img" and len(rest) == 1:
            return self._image(rest[0])
        if kind == "bin" and len(rest) == 1:
            data = self._get(rest[0])
            self._budget.take(len(data))
            return bytes(data)
        raise MalformedMessage(f"reference: got {str(reference)[:80]}, want 'nd', 'img' or 'bin'")

    def _image(self, index: Any) -> np.ndarray:
        data = self._get(index)
        image = self._images.get(index)
        return self._decode([data])[0] if image is None else image

    def _decode(self, files: Sequence[Buffer]) -> list[np.ndarray]:
        self._budget.take(sum(map(len, files)))  # when it is used up, nothing more is decoded
        found = decode_files(files, self._limits.pixels)
        self._budget.take(sum(image.nbytes for image in found))
        return found

    def _nest(self, depth: int) -> None:
        if depth >= self._limits.depth:
            raise MessageTooLarge(f"info: nested deeper than {self._limits.depth}; flatten it")

    def _get(self, index: Any) -> Buffer:
        if type(index) is not int or not 0 <= index < len(self._blobs):
            raise MalformedMessage(f"reference: got blob {str(index)[:20]}, want one of {len(self._blobs)}")
        return self._blobs[index]


def _reference(node: Any) -> list[Any]:
    """The list in `{"$": [kind, blob, ...]}`; empty for anything else."""
    reference = node.get("$") if isinstance(node, dict) else None
    return reference if isinstance(reference, list) else []


def require_plain(value: Any, depth: int) -> None:
    """Raise unless `value`, out of a message of others, is what the wire carries, its keys text, `depth` at most."""
    if isinstance(value, (dict, list)):
        if depth <= 0:
            raise MessageTooLarge("message: nested too deep; flatten it")
        for key in value if isinstance(value, dict) else ():
            if not isinstance(key, str):
                raise MalformedMessage(f"message: got key {str(key)[:40]!r}, want text")
        for item in value.values() if isinstance(value, dict) else value:
            require_plain(item, depth - 1)
    elif value is not None and not isinstance(value, (bool, int, float, str, bytes, np.ndarray, np.generic)):
        raise MalformedMessage(f"message: got a {type(value).__name__}, want plain values and arrays")
