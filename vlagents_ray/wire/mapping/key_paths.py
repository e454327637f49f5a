"""Paths into nested observations, such as `images/wrist`: either that key itself, or `wrist` within `images`.

`states|state` stands for the first of the two that exists.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vlagents_ray.errors import InvalidObservation, shown

_SHOWN = 40  # maximum number of keys that an error lists, and of characters of a key
_LONGEST = 200  # characters of a client's key that are compared


def lookup(nested: Mapping[Any, Any], path: str) -> Any:
    """Return the value at `path`; None if there is none."""
    if path in nested:
        return nested[path]
    if "|" in path:
        return next((value for one in path.split("|") if (value := lookup(nested, one)) is not None), None)
    end = path.find("/")
    while end >= 0:
        inside = nested.get(path[:end])
        if isinstance(inside, Mapping):
            value = lookup(inside, path[end + 1 :])
            if value is not None:
                return value
        end = path.find("/", end + 1)
    return None


def keys(nested: Mapping[Any, Any]) -> list[str]:
    """Return the paths of all values that are not mappings, in order, at most 40, to be listed in an error."""
    return [short_path(path) for path, _ in leaves(nested)]


def short_path(path: str) -> str:
    """Return a path as an error may list it, each key cut to 40 characters."""
    return "/".join(key[:_SHOWN] for key in path.split("/"))


def leaves(nested: Mapping[Any, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return the paths and values of all values that are not mappings, in order, at most 40; see `short_path`."""
    found: list[tuple[str, Any]] = []
    for key, value in nested.items():
        if len(found) >= _SHOWN:
            break
        path = f"{prefix}{(key if isinstance(key, str) else shown(key))[:_LONGEST]}"
        if isinstance(value, Mapping):
            found += leaves(value, f"{path}/")
        else:
            found.append((path, value))
    return found[:_SHOWN]


def reads(key: str, path: str) -> bool:
    """Whether the key of a mapping stands for the value at `path`."""
    return any(matches(path, one) for one in key.split("|"))


def matches(name: str, pattern: str) -> bool:
    """Whether `pattern`, which may end with `*`, stands for `name`."""
    return name.startswith(pattern[:-1]) if pattern.endswith("*") else name == pattern


def pick(
    flat: Mapping[str, Any], name: str, key: str, optional: bool, missing: Callable[..., InvalidObservation]
) -> list[tuple[str, str, Any]]:
    """Return the values that a key of a mapping stands for.

    Args:
        flat: The client's observation.
        name: Our name of the value; its `*` stands for the same text as that of `key`.
        key: The client's key.
        optional: Whether the value may be missing.
        missing: Creates the error that is raised if the value is missing.

    Returns:
        Our name, the client's key and the value, of each.
    """
    if "*" not in key:
        value = lookup(flat, key)
        there = [] if value is None or isinstance(value, Mapping) else [(name, key, value)]
    else:
        folder, _, last = key.rpartition("/")
        inside = lookup(flat, folder) if folder else flat
        prefix = last.removesuffix("*")
        there = [
            (name.replace("*", theirs.removeprefix(prefix)), f"{folder}/{theirs}".removeprefix("/"), value)
            for theirs, value in (inside.items() if isinstance(inside, Mapping) else ())
            if isinstance(theirs, str) and theirs.startswith(prefix) and len(theirs) > len(prefix)
        ]
        optional = True
    if not there and not optional:
        raise missing(key, have=keys(flat))
    return there
