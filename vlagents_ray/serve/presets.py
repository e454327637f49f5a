"""Reading of a key mapping in a deployment file: the name of a preset, or an object.

The presets are the mappings of known clients, which each dialect defines. Units and orders are those of each system's
own examples.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

from vlagents_ray.registry import DIALECTS, dialect_class, names
from vlagents_ray.wire import presets as wire_presets
from vlagents_ray.wire.mapping import KeyMapping


def read_mapping(value: str | Mapping[str, Any]) -> KeyMapping:
    """Read a mapping.

    Args:
        value: A preset's name, or an object. The fields of an object with `preset` replace those of that preset.

    Raises:
        ConfigError: The preset is unknown, or the object is invalid.
    """
    return wire_presets.read_mapping(value, _preset)


@cache
def presets() -> dict[str, KeyMapping]:
    """Return the presets of all registered dialects, by name."""
    return {name: KeyMapping.from_json(one) for stated in _stated() for name, one in stated.items()}


def _preset(name: str) -> Mapping[str, Any]:
    for stated in _stated():
        if name in stated:
            return stated[name]
    raise wire_presets.unknown_preset(name, presets())


def _stated() -> Iterator[Mapping[str, Mapping[str, Any]]]:
    """Yield the presets of each dialect, those of this package first, so that no plugin is imported to find them."""
    yield from (dialect_class(name).presets for name in DIALECTS)
    yield from (dialect_class(name).presets for name in names("dialects") if name not in DIALECTS)
