"""Serves the live page from a process that is no replica, such as the driver of an evaluation."""

from __future__ import annotations

import asyncio
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from starlette.applications import Starlette

from vlagents_ray.client.credentials import is_loopback
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.endpoints.access_middleware import LIVE_PAGE, AccessMiddleware
from vlagents_ray.serve.live.endpoint import VideoFiles, live_routes
from vlagents_ray.serve.live.fleet import Fleet

_LAST_S = 0.5  # time for viewers to be sent how it ended
_END_S = 1  # time limit for their connections to close, s
_LEAVE_S = 5.0  # time limit for all of it


def require_watch_keys(host: str, keys: Keys | None) -> None:
    """Raise `ConfigError` if other machines would reach a page on `host` without a key."""
    if keys is None and not is_loopback(host):
        raise ConfigError(
            f"live page on {host}: whoever reaches it would see all cameras. Make a key (`vlagents-ray keys new NAME "
            f"--scope watch --file keys.json`) and set VLAGENTS_RAY_KEYS_FILE=keys.json; or stay on loopback, and look "
            f"at it through `ssh -L`"
        )


@contextmanager
def page_server(
    fleet: Fleet, address: tuple[str, int], keys: Keys | None, *, name: str, videos: VideoFiles | None = None
) -> Iterator[str]:
    """Serve the live page on a thread for the length of the context.

    Args:
        fleet: Gathers what the page shows.
        address: (host, port) to listen on; port 0 is any that is free.
        keys: Who may watch; None lets anybody, which only loopback allows.
        name: What the keys call this server, where they are for some applications alone.
        videos: As for `live_routes`.

    Yields:
        The address of the page.

    Raises:
        ConfigError: Other machines would reach the page without a key, or the address is not free.
    """
    host, port = address
    require_watch_keys(host, keys)
    try:
        listening = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    except OSError as error:
        raise ConfigError(
            f"live page: cannot listen on {host}:{port} ({error.strerror}); choose another port"
        ) from error
    routes = live_routes(fleet, open_to_network=False, videos=videos)
    app = AccessMiddleware(Starlette(routes=routes), keys, name)
    config = uvicorn.Config(
        app, log_config=None, lifespan="off", ws="websockets-sansio", timeout_graceful_shutdown=_END_S
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=lambda: asyncio.run(server.serve([listening])), name="live-page", daemon=True)
    thread.start()
    try:
        yield f"http://{f'[{host}]' if ':' in host else host}:{listening.getsockname()[1]}{LIVE_PAGE}"
    finally:
        if fleet.watched:
            time.sleep(_LAST_S)
        server.should_exit = True
        thread.join(_LEAVE_S)  # it may wait for a Ray that is lost
