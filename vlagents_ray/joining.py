"""Being in a Ray cluster for a while."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ClusterLost, ConfigError
from vlagents_ray.signals import own_sigterm

log = logging.getLogger(__name__)

_ATTEMPTS = 3
_FAILED = "Check failed: "  # in a daemon's last words


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
    options = {"log_to_driver": False, "logging_level": "WARNING"} | options
    try:
        if address == "local":
            start_ray(**options)
        else:
            with own_sigterm():
                ray.init(address=address, **options)
    except (ConnectionError, ray.exceptions.AuthenticationError) as error:
        where = address or os.environ.get("RAY_ADDRESS")
        raise ConfigError(
            f"no way into a Ray cluster at {where!r}: {error}. Start Ray on this machine, or have it join one "
            f"(`ray start`); the page docs/cluster/ray.md shows how"
        ) from error
    with contextlib.ExitStack() as stack:
        stack.push(unless_lost(ray.shutdown))
        yield


def start_ray(**options: Any) -> None:
    """`ray.init("local")`, tried again where it takes too long: a Ray that this process starts.

    Ray's daemon gives each of its helpers 15 s, and no more (ray issue 65983), to be started by a machine that may be
    busy or read Python's modules from a slow disk. What it has read by then makes the next attempt a faster one.
    `ConfigError` if none succeeds.
    """
    import ray

    for attempt in range(1, _ATTEMPTS + 1):
        try:
            with own_sigterm(), _helper_at_any_port():  # "local": also where RAY_ADDRESS names another
                ray.init("local", **options)
        except Exception as error:  # Ray raises a bare one
            node = _node_of(error)
            if node is None or not node.all_processes:  # nothing was started: no matter of time
                raise
            node.kill_all_processes(check_alive=False, wait=True)  # Ray leaves them
            if isinstance(error, ValueError):  # of the options
                raise
            said = f"{error} {_last_words(node)}".rstrip()
            if attempt == _ATTEMPTS:
                raise ConfigError(
                    f"Ray did not start on this machine in {_ATTEMPTS} attempts: {said}. Where the machine is busy, "
                    f"leave it more room; where Python's modules lie on a slow disk, copy the environment to a local "
                    f"one. Logs: {node.get_logs_dir_path()}"
                ) from error
            log.warning("Ray did not start, trying again (attempt %d of %d): %s", attempt + 1, _ATTEMPTS, said)
        else:
            return


@contextlib.contextmanager
def _helper_at_any_port() -> Iterator[None]:
    """Every Ray on a machine wants 52365 for one of its helpers: the second one's would look at it for 3.4 s."""
    from ray._private import parameter

    before = parameter.RayParams
    parameter.RayParams = functools.partial(before, dashboard_agent_listen_port=0)
    try:
        yield
    finally:
        parameter.RayParams = before


def _node_of(error: BaseException) -> Any:
    """The node that was being started when `error` was raised, if one was."""
    from ray._private.node import Node

    found = (frame.f_locals.get("self") for frame, _ in traceback.walk_tb(error.__traceback__))
    return next((one for one in found if isinstance(one, Node)), None)


def _last_words(node: Any) -> str:
    """Why its daemon ended, if it says so."""
    try:
        said = (Path(node.get_logs_dir_path()) / "raylet.err").read_text(errors="replace")
    except OSError:
        return ""
    reasons = [line.partition(_FAILED)[2] for line in said.splitlines() if _FAILED in line]
    return f"(Ray's daemon: {reasons[-1]})" if reasons else ""


def unless_lost(leave: Callable[[], None]) -> Callable[..., None]:
    """For an `ExitStack`: a cluster whose head is lost would keep one waiting who takes leave."""

    def end(kind: type[BaseException] | None, *_: object) -> None:
        if kind is not ClusterLost:
            leave()

    return end
