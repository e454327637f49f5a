"""Being in a Ray cluster for a while."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from typing import Any

from vlagents_ray.errors import ClusterLost, ConfigError
from vlagents_ray.signals import own_sigterm


@contextlib.contextmanager
def joined(address: str | None = None, **options: Any) -> Iterator[None]:
    """Be connected to the Ray cluster at `address`, or to the one that this process is connected to already.

    Without an address it is the one that RAY_ADDRESS names or that this machine is in; "local" is one of this
    process's own, which ends with the context. `options` are further ones of `ray.init`. `ConfigError` if there is no
    such cluster, or it wants another token.
    """
    import ray

    if ray.is_initialized():
        yield
        return
    try:
        with own_sigterm():
            ray.init(address=address, **{"log_to_driver": False, "logging_level": "WARNING"} | options)
    except (ConnectionError, ray.exceptions.AuthenticationError) as error:
        where = address or os.environ.get("RAY_ADDRESS")
        raise ConfigError(
            f"no way into a Ray cluster at {where!r}: {error}. Start Ray on this machine, or have it join one "
            f"(`ray start`); the page docs/cluster/ray.md shows how"
        ) from error
    with contextlib.ExitStack() as stack:
        stack.push(unless_lost(ray.shutdown))
        yield


def unless_lost(leave: Callable[[], None]) -> Callable[..., None]:
    """For an `ExitStack`: a cluster whose head is lost would keep one waiting who takes leave."""

    def end(kind: type[BaseException] | None, *_: object) -> None:
        if kind is not ClusterLost:
            leave()

    return end
