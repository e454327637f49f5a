"""Views for recordings, `info[HIGH_RES]`: the same cameras in another size, never sent to the policy."""

from __future__ import annotations

from collections.abc import Sequence

from vlagents_ray.errors import ConfigError

Size = tuple[int, int]  # height, width in pixels


def record_size_of(size: Sequence[int] | None, env: str) -> Size | None:
    """Check the option `record_size` of an env, which is a list in settings files.

    Args:
        size: (height, width) in pixels; None if there are no such views.
        env: The env's name, for the message.

    Returns:
        The size; None if there are no such views.

    Raises:
        ConfigError: There can be no image of this size.
    """
    if size is None:
        return None
    if len(size) != 2 or min(size) < 1:
        raise ConfigError(f"{env}: record_size is {size}, want (height, width), each at least 1")
    return size[0], size[1]
