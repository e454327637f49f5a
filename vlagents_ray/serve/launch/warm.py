"""Servers in the warm cluster of `vlagents-ray up`, and the start of that cluster."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import ray
from ray.serve.schema import ServeDeploySchema

from vlagents_ray.errors import ConfigError
from vlagents_ray.ray_tools.private import proxies_now, start_serve
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.ray_tools.session import unless_lost
from vlagents_ray.ray_tools.warm_cluster import WarmCluster, abandoned_apps, announce_warm, kept
from vlagents_ray.serve.launch.private_cluster import own_ray
from vlagents_ray.serve.launch.serve_client import remove_apps, shut_down, wait_for_proxies
from vlagents_ray.serve.ports import LOOPBACK

_CPUS = 64  # at least; Ray's CPUs are only an account, and the workers of any evaluation must fit


@contextlib.contextmanager
def warm_ray(port: int, imports: Sequence[str], idle: int) -> Iterator[Any]:
    """Run a private Ray with Serve and its ingress for the length of the context, and announce it.

    Args:
        port: The port of its servers, on the loopback address.
        imports: Modules that each worker process imports when it starts.
        idle: The number of idle processes that Ray keeps.

    Yields:
        Serve's client.
    """
    variables = {
        "RAY_preload_python_modules": ",".join(imports),
        "RAY_num_workers_soft_limit": str(idle),
        "RAY_prestart_worker_first_driver": "0",
        # For so long Serve gives the port of a replica that has ended to no other one, and there are 200.
        "RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S": "3600",
    }
    cpus = max(os.cpu_count() or 1, _CPUS)
    with contextlib.ExitStack() as stack:
        stack.enter_context(own_ray(LOOPBACK, port, num_cpus=cpus, variables=variables))
        stack.enter_context(kept())
        client, proxies = start_serve({"host": LOOPBACK, "port": port}, "HeadOnly")
        stack.push(unless_lost(lambda: shut_down(client)))
        wait_for_proxies(proxies, lambda: proxies_now(client))
        announce_warm(f"http://{LOOPBACK}:{port}", ray.get_runtime_context().gcs_address)
        yield client


def remove_abandoned(client: Any) -> None:
    """Remove the applications of commands that were killed, from the warm cluster that this process keeps."""
    with abandoned_apps(Path(os.environ[MARK])) as names:
        if names:
            remove_apps(client, names, wait=True)


def listener_of(cluster: WarmCluster, host: str, port: int) -> dict[str, Any]:
    """Return Serve's options for host and port in a warm cluster.

    Args:
        cluster: The cluster.
        host: Where the server is to listen.
        port: Its port; 0 for any.

    Raises:
        ConfigError: The warm cluster listens elsewhere.
    """
    there = urlsplit(cluster.url).port
    if host not in (LOOPBACK, "localhost"):
        raise ConfigError(f"host {host}: the warm cluster listens on {LOOPBACK} only; leave out --address")
    if port not in (0, there):
        raise ConfigError(
            f"port {port}: the warm cluster listens at {there}; use --port {there}, leave out --address, or "
            f"`vlagents-ray down`, then `vlagents-ray up --port {port}`"
        )
    return {"host": LOOPBACK, "port": there}


def require_routes(client: Any, config: ServeDeploySchema, *, ingress: bool) -> None:
    """Raise `ConfigError` if another server of the warm cluster has the path of an application."""
    taken = {one["route_prefix"]: name for name, one in client.get_serve_details()["applications"].items()}
    wanted = {app.route_prefix: app.name for app in config.applications} if ingress else {}
    for path in wanted.keys() & taken.keys() - {None}:
        raise ConfigError(
            f"the warm cluster serves {taken[path]!r} at the path {path!r} already, got {wanted[path]!r} for it: stop "
            f"that server, or leave out --address and choose another --port"
        )
