"""Models of transformers, whole."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError

_LISTED = 8


def from_pretrained(cls: Any, path: Path, **options: Any) -> Any:
    """`cls.from_pretrained(path, **options)`, or `ConfigError` unless each of its parameters is in the checkpoint.

    From version 5 on transformers renames parameters as it reads them, so that `require_loaded`, which compares
    names, does not do for its models; it does say itself which ones it found no values for.
    """
    try:
        model, said = cls.from_pretrained(path, output_loading_info=True, **options)
    except (OSError, RuntimeError, ValueError) as error:  # what it raises for files that are not its own, or not whole
        raise ConfigError(f"checkpoint {path}: {cls.__name__} does not load: {str(error).strip()[:500]}") from error
    lacks = {key: sorted(map(str, said[key]))[:_LISTED] for key in ("missing_keys", "mismatched_keys") if said[key]}
    if lacks:
        raise ConfigError(
            f"checkpoint {path}: it does not fill {cls.__name__}: {lacks}; is it a checkpoint of this model?"
        )
    return model
