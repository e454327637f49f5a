"""Serve as the process sees it that started it: its proxies, and its end."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.ray_tools.private import end_controller, forget_serve, long_polls, proxy_timeout_s

log = logging.getLogger(__name__)

_SHUTDOWN_S = 30.0
_LOOK_S = 0.2  # between two looks at the proxies that Serve has


def wait_for_proxies(proxies: list[Any], look_again: Callable[[], list[Any]]) -> None:
    """Wait until each of the proxies listens; raise the error of one that cannot.

    Serve kills a proxy that does not start within some seconds, as on a busy node, and starts another one.
    """
    import ray

    timeout_s = proxy_timeout_s()
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            ray.get(proxies, timeout=max(deadline - time.monotonic(), 0.0))
        except (ray.exceptions.GetTimeoutError, ray.exceptions.RayActorError) as error:
            if time.monotonic() >= deadline:
                raise PolicyUnavailable(f"Serve's proxies do not listen within {timeout_s:g} s") from error
            time.sleep(_LOOK_S)
            proxies = look_again()
        else:
            return


def _stop_long_polls(client: Any) -> None:
    """Stop long polling of the controller: Ray would report a call in progress at its end as a failed task."""
    for poll in long_polls(client):
        poll.stop()


def shut_down(client: Any) -> None:
    """End Serve, so that replicas drain and HAProxy stops, like `serve.shutdown`, but without its error message.

    The controller ends itself during this call, which Ray would report as a failed task that will be
    retried. A signal to the whole process group or service, as systemd's SIGTERM, also ends Ray's head: then Serve can
    neither answer nor go on, and the reaper ends its processes.
    """
    import ray

    from vlagents_ray.ray_tools.head_monitor import head_is_gone

    _stop_long_polls(client)
    client.shutdown_cached_handles()
    last = end_controller(client)
    deadline = time.monotonic() + _SHUTDOWN_S
    while not ray.wait([last], timeout=_LOOK_S)[0] and not head_is_gone():
        if time.monotonic() > deadline:
            log.warning("Serve has not ended within %g s and is left behind", _SHUTDOWN_S)
            break
    forget_serve(client)
