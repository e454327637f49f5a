"""The values that a mapping finds in another system's observation, as ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation, MessageTooLarge, MissingState
from vlagents_ray.protocol.messages import Limits
from vlagents_ray.protocol.observations import as_camera, as_state, is_number
from vlagents_ray.wire.mapping.fields import StateKey
from vlagents_ray.wire.mapping.key_paths import pick


def read_image(key: str, value: Any, layout: str, limits: Limits) -> np.ndarray:
    """Return an image as (H, W, 3) uint8 RGB; raise `InvalidObservation` or `MessageTooLarge`."""
    if isinstance(value, np.ndarray):
        value = _newest(key, value, 3)
        if value.dtype.kind == "f":
            value = _eight_bits(key, value)
        if layout == "rgba" and value.ndim == 3 and value.shape[2] == 4:
            value = np.ascontiguousarray(value[:, :, :3])
        elif layout in ("chw", "any") and value.ndim == 3 and value.shape[0] == 3:
            value = np.ascontiguousarray(value.transpose(1, 2, 0))
        elif layout == "chw":
            raise InvalidObservation(f"camera {key!r}: got {value.shape} {value.dtype}, want (3, H, W) uint8 RGB")
    return as_camera(key, value, limits)


def _eight_bits(key: str, image: np.ndarray) -> np.ndarray:
    """Convert floats in [0, 1] to uint8, rounded down as openpi's own server does (`_parse_image` in its policies)."""
    if image.size and not (image.min() >= 0 and image.max() <= 1):  # true for NaN, too
        raise InvalidObservation(
            f"camera {key!r}: got {image.dtype} from {image.min():g} to {image.max():g}, want uint8, or floats "
            f"in [0, 1]; scale it"
        )
    return (255 * image).astype(np.uint8)


def may_be_camera(value: Any) -> bool:
    """Return whether a value may be an image."""
    return isinstance(value, np.ndarray) and value.ndim >= 3


def may_be_state(value: Any) -> bool:
    """Return whether a value is a vector of numbers; images and camera matrices are not."""
    if isinstance(value, list):
        return bool(value) and all(map(is_number, value))
    return isinstance(value, np.ndarray) and value.dtype.kind in "fiu" and value.squeeze().ndim == 1


def read_state(
    flat: Mapping[str, Any], name: str, sources: tuple[StateKey, ...], limits: Limits
) -> dict[str, np.ndarray]:
    """Return the state `name`, whose parts are joined, (D,) float32; several states if the name ends with `*`."""
    joined: dict[str, list[np.ndarray]] = {}
    for part in sources:
        found = pick(flat, name, part.key, part.optional, MissingState)
        for ours, key, value in found:
            vector = read_vector(key, value, limits)
            if part.stop is not None and part.stop > vector.size:
                raise InvalidObservation(f"state {key!r}: got {vector.size} numbers, want {part.stop} at least")
            joined.setdefault(ours, []).append(vector[part.start : part.stop])
    return {ours: vectors[0] if len(vectors) == 1 else np.concatenate(vectors) for ours, vectors in joined.items()}


def read_vector(key: str, value: Any, limits: Limits) -> np.ndarray:
    """Return a value as (D,) float32."""
    if isinstance(value, np.ndarray):
        value = np.atleast_1d(_newest(key, value, 1))
    elif isinstance(value, np.number):
        value = [value.item()]
    elif is_number(value):
        value = [value]
    return as_state(key, value, limits)


def _newest(key: str, value: np.ndarray, ndim: int) -> np.ndarray:
    """Remove the batch axis, of length 1, and the time axis that some clients add in front; keep the last time."""
    if value.ndim > ndim and value.shape[0] != 1:
        raise InvalidObservation(
            f"{key!r}: got {value.shape}, a batch of {value.shape[0]}, want one; send each by itself"
        )
    if value.ndim == ndim + 2 and value.shape[1] > 0:
        value = value[:, -1]
    return value if value.ndim != ndim + 1 else value.reshape(value.shape[1:])


def read_text(key: str, value: Any, texts: Mapping[str, str], limits: Limits, *, needed: bool) -> str | None:
    """Return an instruction.

    Args:
        key: The client's key, for errors.
        value: A text, a list or array of one text, or an array of one integer.
        texts: The text that each integer stands for.
        limits: The limits of a request.
        needed: Whether an integer without a text is an error; if not, there is no instruction.

    Raises:
        InvalidObservation: `value` is none of these, or an integer without a text that is needed.
        MessageTooLarge: The text is too long.
    """
    while isinstance(value, (list, tuple)) and len(value) == 1:  # some clients send a batch of one
        value = value[0]
    if isinstance(value, np.ndarray) and value.dtype.kind in "Uiu" and value.size == 1:
        value = value.item()
        if isinstance(value, int):
            if needed and str(value) not in texts:
                raise InvalidObservation(
                    f"{key!r}: got {value}, want one of {sorted(texts)}; add its text to mapping.instructions"
                )
            value = texts.get(str(value))
    if value is not None and not isinstance(value, str):
        raise InvalidObservation(f"{key!r}: got {type(value).__name__}, want text")
    if value is not None and len(value) > limits.text:
        raise MessageTooLarge(f"{key!r}: got {len(value)} characters, the limit is {limits.text}")
    return value
