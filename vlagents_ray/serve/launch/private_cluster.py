"""A private Ray cluster on this machine, which no other machine and no other user can reach."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools.private import use_loopback
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.ray_tools.session import (
    FILES,
    ray_folder,
    start_ray,
    unless_lost,
)
from vlagents_ray.serve.access.tls import Tls
from vlagents_ray.serve.launch.haproxy import (
    NO_INGRESS,
    PublicListener,
    haproxy_binary,
    ingress_environment,
)
from vlagents_ray.serve.ports import HOST, LOOPBACK, free_port, is_free, keep

_MODE = "RAY_AUTH_MODE"
# If this variable is "0", Ray does not take this machine for a part of a cluster and uses the loopback address as the
# node's own, so that all its ports are there. (Ray replaces the address given as `_node_ip_address` by another one.)
_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"


@contextlib.contextmanager
def own_ray(
    host: str,
    port: int,
    *,
    tls: Tls | None = None,
    num_cpus: int | None = None,
    show_logs: bool = False,
    ingress: bool = True,
) -> Iterator[PublicListener | None]:
    """Run a private Ray for the length of the context.

    Args:
        host: The address at which the server listens.
        port: The port at which the server listens.
        tls: The certificate of the server; None for unencrypted HTTP.
        num_cpus: CPUs that Ray may use; None for all.
        show_logs: Whether the logs of Ray's workers are shown.
        ingress: Whether the server listens for HTTP at all.

    Yields:
        HAProxy's listener for clients; None if Serve listens itself.

    Raises:
        ConfigError: The port is taken, or the environment excludes Ray's token or HAProxy's settings.
    """
    import ray

    if os.environ.get(_MODE, "token").lower() != "token":
        raise ConfigError(
            f"{_MODE}={os.environ[_MODE]}: a port of each replica, which runs whatever it is sent, would be open to "
            f"other machines without Ray's token; unset it"
        )
    if not is_free(host, port):
        raise ConfigError(f"cannot listen on {host}:{port}: it is taken; choose another --port or --host")
    keep(port)
    with ray_folder() as folder, contextlib.ExitStack() as stack:
        # Ray starts its workers with a low priority, so that a policy would wait for all other processes.
        # Proxies start while policies load: on a slow machine Serve would replace them after three times its 5 s.
        environment = {"RAY_worker_niceness": "0", "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60"}
        # The address at which replicas listen for WebSockets: loopback if the network may see nothing but TLS.
        ours = {MARK: str(folder), _ALONE: "0", HOST: host if tls is None else LOOPBACK}
        listener = None
        if not ingress:
            ours |= NO_INGRESS
        elif (binary := haproxy_binary()) is not None:
            listener = _public_listener(folder, host, port, tls)
            settings = ingress_environment(folder, binary, listener)
            # HAProxy's files and admin socket are in the folder, whatever the user has set for clusters.
            ours |= {key: value for key, value in settings.items() if value.startswith(str(folder))}
            environment |= settings
        stack.enter_context(_environment(environment, ours))
        stack.enter_context(_alone())
        if listener is not None:
            listener.require()
        start_ray(
            num_cpus=num_cpus,
            include_dashboard=False,
            log_to_driver=show_logs,
            logging_level="WARNING",
            _temp_dir=str(folder / FILES),
        )
        stack.push(unless_lost(ray.shutdown))
        yield listener


def _public_listener(folder: Path, host: str, port: int, tls: Tls | None) -> PublicListener | None:
    if tls is None and host in (LOOPBACK, "localhost"):
        return None
    return PublicListener(
        host,
        port,
        free_port(),
        None if tls is None else tls.bundle(folder),
        None if tls is None or tls.client_ca is None else tls.client_ca.absolute(),
    )


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Apply `_ALONE` in this process, too, which read the variable when it imported Ray."""
    before = use_loopback(True)
    try:
        yield
    finally:
        use_loopback(before)


@contextlib.contextmanager
def _environment(values: Mapping[str, str], ours: Mapping[str, str]) -> Iterator[None]:
    """Set variables for processes started inside the context; the user's values stay, unless they are in `ours`.

    A process that was started by another server's process has inherited that server's files and ports: those are
    replaced.
    """
    inherited = MARK in os.environ
    new = {key: value for key, value in values.items() if inherited or key not in os.environ} | dict(ours)
    before = {key: os.environ.get(key) for key in new}
    os.environ.update(new)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value
