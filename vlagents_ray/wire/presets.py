"""The mappings of known clients by name, and the reader of mappings that may name one of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.naming import did_you_mean
from vlagents_ray.wire.gr00t import PRESETS as GR00T
from vlagents_ray.wire.lerobot import PRESETS as LEROBOT
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray.wire.openpi import PRESETS as OPENPI
from vlagents_ray.wire.openpi import ROBOARENA
from vlagents_ray.wire.openvla import PRESETS as OPENVLA
from vlagents_ray.wire.vla_eval import PRESETS as VLA_EVAL

PRESETS: dict[str, Mapping[str, Any]] = {**OPENPI, **ROBOARENA, **OPENVLA, **VLA_EVAL, **GR00T, **LEROBOT}


def read_mapping(
    value: str | Mapping[str, Any], preset: Callable[[str], Mapping[str, Any] | None] = PRESETS.get
) -> KeyMapping:
    """Read a mapping.

    Args:
        value: A preset's name, or an object. The fields of an object with `preset` override those of that preset.
        preset: Returns the preset of a name; None if there is none.

    Raises:
        ConfigError: The preset is unknown, or the object is invalid.
    """
    if not isinstance(value, (str, Mapping)):
        raise ConfigError(f"mapping: got {type(value).__name__}, want a preset's name or an object")
    own = {"preset": value} if isinstance(value, str) else dict(value)
    base = _found(own.pop("preset"), preset) if "preset" in own else {}
    return KeyMapping.from_json({**base, **own})


def _found(name: object, preset: Callable[[str], Mapping[str, Any] | None]) -> Mapping[str, Any]:
    if isinstance(name, str) and (found := preset(name)) is not None:
        return found
    raise unknown_preset(name, PRESETS)


def unknown_preset(name: object, known: Mapping[str, Any]) -> ConfigError:
    """Return the error for the name of a preset that does not exist."""
    meant = did_you_mean(str(name), known)
    return ConfigError(f"mapping: got {name!r}, want one of the presets {sorted(known)}, or an object{meant}")
