"""Paths into nested observations, such as `images/wrist`: that very key, or `wrist` within `images`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vlagents_ray.errors import InvalidObservation

_SHOWN = 40  # keys that an error lists


def lookup(nested: Mapping[Any, Any], path: str) -> Any:
    """The value at `path`; None if there is none."""
    if path in nested:
        return nested[path]
    end = path.find("/")
    while end >= 0:
        inside = nested.get(path[:end])
        if isinstance(inside, Mapping):
            value = lookup(inside, path[end + 1 :])
            if value is not None:
                return value
        end = path.find("/", end + 1)
    return None


def keys(nested: Mapping[Any, Any], prefix: str = "") -> list[str]:
    """The paths of all values that are no mappings, in order and some at most: for an error to list."""
    found: list[str] = []
    for key, value in nested.items():
        if len(found) >= _SHOWN:
            break
        path = f"{prefix}{str(key)[:_SHOWN]}"
        if isinstance(value, Mapping):
            found += keys(value, f"{path}/")
        else:
            found.append(path)
    return found[:_SHOWN]


def matches(name: str, pattern: str) -> bool:
    """Is `name` what `pattern`, perhaps with a `*` at its end, stands for?"""
    return name.startswith(pattern[:-1]) if pattern.endswith("*") else name == pattern


def pick(
    flat: Mapping[str, Any], name: str, key: str, optional: bool, missing: Callable[..., InvalidObservation]
) -> list[tuple[str, str, Any]]:
    """Our name, their key and the value of what `key` stands for; `missing` if that is nothing."""
    if "*" not in key:
        value = lookup(flat, key)
        there = [] if value is None else [(name, key, value)]
    else:
        folder, _, last = key.rpartition("/")
        inside = lookup(flat, folder) if folder else flat
        prefix = last.removesuffix("*")
        there = [
            (name.replace("*", theirs.removeprefix(prefix)), f"{folder}/{theirs}".removeprefix("/"), value)
            for theirs, value in (inside.items() if isinstance(inside, Mapping) else ())
            if isinstance(theirs, str) and theirs.startswith(prefix)
        ]
        optional = True
    if not there and not optional:
        raise missing(key, have=keys(flat))
    return there
