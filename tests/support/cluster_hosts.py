"""Can tests have several hosts here?"""

from __future__ import annotations

import functools

from vlagents_ray.errors import ConfigError


@functools.cache
def no_hosts() -> str | None:
    """Why not; None if they can."""
    from benchmarks.hosts import require

    try:
        require()
    except ConfigError as error:
        return str(error)
    return None
