"""The modes of a chunk player, and the settings that go with them."""

from __future__ import annotations

from typing import Literal, get_args

from vlagents_ray.chunking.buffer import Merge
from vlagents_ray.errors import ConfigError

Mode = Literal["open_loop", "ensemble", "async"]


def require_settings(
    mode: str,
    execute: int | None,
    horizon: int | None,
    max_age_s: float | None,
    merge: str | Merge,
    real_time_chunking: bool,
) -> None:
    """Raise `ConfigError` if settings of a `ChunkPlayer` are out of range, or do not go together."""
    if mode not in get_args(Mode):
        raise ConfigError(f"mode: got {mode!r}, want one of {list(get_args(Mode))}")
    for name, value in (("execute", execute), ("horizon", horizon)):
        if value is not None and value < 1:
            raise ConfigError(f"{name}: got {value}, want at least 1, or None")
    if max_age_s is not None and not max_age_s > 0:
        raise ConfigError(f"max_age_s: got {max_age_s}, want above 0, or None")
    if mode != "async" and (merge != "newest" or real_time_chunking):
        raise ConfigError(f"merge and real_time_chunking: got them with mode {mode!r}, want mode='async'")
