"""A check of Octo's `ModuleSpec`s, the code that loading a checkpoint imports and calls."""

from __future__ import annotations

import importlib
import inspect
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.policies.base.model_code import CURE

_PARTS = "octo.model.components."  # tokenizers, encoders, action heads
_TEXT = "octo.data.utils.text_processing"


def require_own_classes(file: Path) -> None:
    """Raise `ConfigError` unless a config.json names only classes of Octo's components and text processors.

    Others are not imported, as Octo accepts any callable of any module, `os.system` as well.
    """
    try:
        config = json.loads(file.read_text(encoding="utf-8"))
        loaded = {name: config[name] for name in ("model", "text_processor")}
    except (ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{file}: not a configuration of Octo's ({type(error).__name__}: {error})") from error
    named = [(spec["module"], spec["name"]) for spec in _specs(loaded)]
    for is_own in (_is_own_name, _is_own_class):  # check all names before anything is imported
        for module, name in named:
            if not is_own(module, name):
                raise ConfigError(
                    f"{file}: names {name!r} of {module!r}, want a class of {_PARTS}* or {_TEXT}: loading the "
                    f"checkpoint would run that, whatever it is; {CURE}"
                )


def _specs(value: object) -> Iterator[Mapping[str, Any]]:
    if isinstance(value, Mapping):
        if "module" in value and "name" in value:
            yield value
        for one in value.values():
            yield from _specs(one)
    elif isinstance(value, list):
        for one in value:
            yield from _specs(one)


def _is_own_name(module: object, name: object) -> bool:
    if not isinstance(module, str) or not isinstance(name, str) or not name.isidentifier():
        return False
    return module == _TEXT or module.startswith(_PARTS)


def _is_own_class(module: str, name: str) -> bool:
    """Whether a class is defined by Octo, and not imported into its module."""
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        raise ConfigError(
            f"{module}: this Octo does not have it ({error}); is the checkpoint of this version?"
        ) from error
    return inspect.isclass(found) and found.__module__.startswith("octo.")
