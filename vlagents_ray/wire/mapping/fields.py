"""The entries of a key mapping, each of which locates one value in another system's observation or action.

In JSON, unknown fields are errors; a text stands for an entry with that key and no other field.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal, TypeVar

import numpy as np

from vlagents_ray.errors import ConfigError

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class CameraKey:
    """The location of an image, (H, W, 3) or (3, H, W) RGB; of (1, T, H, W, 3) the newest image is used, the last of T.

    Pixels are uint8, or floats in [0, 1]. The layout `any` means channels first if the length of the first axis is 3;
    of `rgba`, (H, W, 4), the alpha is left out.
    """

    key: str
    layout: Literal["hwc", "chw", "any", "rgba"] = "hwc"
    optional: bool = False


@dataclass(frozen=True, slots=True)
class StateKey:
    """The location of a vector (D,), from `start` to `stop`; of (1, T, D) the newest vector is used, the last of T."""

    key: str
    start: int | None = None
    stop: int | None = None
    optional: bool = False


@dataclass(frozen=True, slots=True)
class GripperKey:
    """The location of the gripper's opening, and its readings when open and closed; it is linear between them."""

    key: str
    index: int = 0
    open: float = 1.0
    closed: float = 0.0
    optional: bool = False


@dataclass(frozen=True, slots=True)
class ActionRange:
    """The columns of our action, (H, D), that the client reads under one name."""

    start: int | None = None
    stop: int | None = None


@dataclass(frozen=True, slots=True)
class ActionGripper:
    """A gripper's column in an action, and the client's commands to open and close it."""

    index: int = -1
    open: float = 1.0
    closed: float = 0.0


def closed(cls: type, data: object, where: str) -> dict[str, Any]:
    """Return the fields in `data`; raise `ConfigError` for a field that `cls` lacks."""
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: got {type(data).__name__}, want an object")
    known = [one.name for one in fields(cls)]
    unknown = sorted(str(key) for key in data if key not in known)
    if unknown:
        raise ConfigError(f"{where}: unknown keys {unknown}, want some of {known}")
    return dict(data)


def each(top: Mapping[str, Any], name: str, read: Callable[[Any, str], T]) -> dict[str, T]:
    """Return the entries of `top[name]`, each the result of `read(value, where)`; `where` is its path, for errors."""
    entries = top.get(name) or {}
    if not isinstance(entries, Mapping):
        raise ConfigError(f"mapping.{name}: got {type(entries).__name__}, want an object")
    return {str(key): read(value, f"mapping.{name}.{key}") for key, value in entries.items()}


def entry(cls: type[T], value: Any, where: str) -> T:
    """Return an entry of a mapping, the dataclass `cls`; a text is its key."""
    values = closed(cls, {"key": value} if isinstance(value, str) else value, where)
    known = {one.name: str(one.type) for one in fields(cls)}  # type: ignore[arg-type]
    for name, got in values.items():
        if not _FITS[known[name]](got):
            raise ConfigError(f"{where}.{name}: got {got!r}, want {known[name]}")
    if "key" in known and not values.get("key"):
        raise ConfigError(f"{where}: no key; say where it lies in their observation")
    if "*" in (key := values.get("key", "")) and key.index("*") != len(key) - 1:
        raise ConfigError(f"{where}: got key {key!r}, want '*' at its end alone")
    if "open" in known and values.get("open", 1.0) == values.get("closed", 0.0):
        raise ConfigError(f"{where}: open and closed are the same, {values.get('open', 1.0)}")
    return cls(**values)


_FITS: dict[str, Callable[[Any], bool]] = {
    "str": lambda value: isinstance(value, str),
    "int": lambda value: type(value) is int,
    "int | None": lambda value: value is None or type(value) is int,
    "float": lambda value: type(value) in (int, float) and np.isfinite(value),
    "bool": lambda value: isinstance(value, bool),
    "Literal['hwc', 'chw', 'any', 'rgba']": lambda value: value in ("hwc", "chw", "any", "rgba"),
    'Literal["hwc", "chw", "any", "rgba"]': lambda value: value in ("hwc", "chw", "any", "rgba"),
}


def parts(value: Any, where: str) -> tuple[StateKey, ...]:
    """Return the keys of one state, whose values are joined."""
    values = value if isinstance(value, list) else [value]
    if not values:
        raise ConfigError(f"{where}: got an empty list, want one key at least")
    return tuple(entry(StateKey, one, where) for one in values)


def text(value: Any, where: str) -> str:
    """Return a value that must be text."""
    if not isinstance(value, str):
        raise ConfigError(f"{where}: got {type(value).__name__}, want text")
    return value


def stated(value: Any) -> Any:
    """Return `value` as plain JSON values, without fields that are None."""
    if isinstance(value, dict):
        return {name: stated(item) for name, item in value.items() if item is not None}
    if isinstance(value, (list, tuple)):
        return [stated(item) for item in value]
    return value
