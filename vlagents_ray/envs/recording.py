"""Views for the record, `info[HIGH_RES]`: the cameras in a size of their own, which the policy never sees."""

from __future__ import annotations

from collections.abc import Sequence

from vlagents_ray.errors import ConfigError

Size = tuple[int, int]  # height, width in pixels


def record_size_of(size: Sequence[int] | None, env: str) -> Size | None:
    """The option `record_size` of `env`, (height, width); `ConfigError` if there can be no such image.

    Settings files give it as a list.
    """
    if size is None:
        return None
    if len(size) != 2 or min(size) < 1:
        raise ConfigError(f"{env}: record_size is {size}, want (height, width), each at least 1")
    return size[0], size[1]
