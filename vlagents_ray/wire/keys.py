"""The entries of a key mapping: where one value lies in another system's observation or action.

Their JSON form is closed; a text stands for an entry with that key and nothing else.
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
    """Where an image lies: (H, W, 3) or (3, H, W) uint8 RGB; (1, T, H, W, 3) gives the newest, the last of T."""

    key: str
    layout: Literal["hwc", "chw"] = "hwc"
    optional: bool = False


@dataclass(frozen=True, slots=True)
class StateKey:
    """Where numbers lie: (D,), of which `start` to `stop` count; (1, T, D) gives the newest, the last of T."""

    key: str
    start: int | None = None
    stop: int | None = None
    optional: bool = False


@dataclass(frozen=True, slots=True)
class GripperKey:
    """Where the gripper's opening lies, and what it reads at the ends of its way; between them it is linear."""

    key: str
    index: int = 0
    open: float = 1.0
    closed: float = 0.0
    optional: bool = False


@dataclass(frozen=True, slots=True)
class ActionRange:
    """Columns of our action, (H, D), that their client looks for under one name."""

    start: int | None = None
    stop: int | None = None


@dataclass(frozen=True, slots=True)
class ActionGripper:
    """A gripper's column in an action, and what opens and closes it on their side."""

    index: int = -1
    open: float = 1.0
    closed: float = 0.0


def closed(cls: type, data: object, where: str) -> dict[str, Any]:
    """The fields that `data` states; `ConfigError` for one that `cls` lacks."""
    if not isinstance(data, Mapping):
        raise ConfigError(f"{where}: got {type(data).__name__}, want an object")
    known = [one.name for one in fields(cls)]
    unknown = sorted(str(key) for key in data if key not in known)
    if unknown:
        raise ConfigError(f"{where}: unknown keys {unknown}, want some of {known}")
    return dict(data)


def each(top: Mapping[str, Any], name: str, read: Callable[[Any, str], T]) -> dict[str, T]:
    """The entries under `name`, each read with the place where it stands."""
    entries = top.get(name) or {}
    if not isinstance(entries, Mapping):
        raise ConfigError(f"mapping.{name}: got {type(entries).__name__}, want an object")
    return {str(key): read(value, f"mapping.{name}.{key}") for key, value in entries.items()}


def entry(cls: type[T], value: Any, where: str) -> T:
    """An entry of a mapping; a text is its key."""
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
    "Literal['hwc', 'chw']": lambda value: value in ("hwc", "chw"),
    'Literal["hwc", "chw"]': lambda value: value in ("hwc", "chw"),
}


def parts(value: Any, where: str) -> tuple[StateKey, ...]:
    """One state's keys, whose values are joined."""
    values = value if isinstance(value, list) else [value]
    if not values:
        raise ConfigError(f"{where}: got an empty list, want one key at least")
    return tuple(entry(StateKey, one, where) for one in values)


def stated(value: Any) -> Any:
    """`value` as plain JSON values, without what is None."""
    if isinstance(value, dict):
        return {name: stated(item) for name, item in value.items() if item is not None}
    if isinstance(value, (list, tuple)):
        return [stated(item) for item in value]
    return value
