"""Start Ray and Serve here, or use a running cluster, and serve a deployment as long as it is wanted.

A server of our own gets HAProxy in front of its replicas where its binary is installed, with files
and ports that no other server on the machine uses. It alone faces the network, if anything does.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ray.serve.schema import ServeDeploySchema

from vlagents_ray.errors import ConfigError
from vlagents_ray.joining import joined, unless_lost
from vlagents_ray.serve.auth import require_access
from vlagents_ray.serve.config import AccessArgs, ServerArgs
from vlagents_ray.serve.files import IMPORT_PATH, with_gateways_at, with_replicas_on
from vlagents_ray.serve.haproxy import Front, wait_for_haproxy
from vlagents_ray.serve.own_ray import own_ray
from vlagents_ray.serve.ports import EVERYWHERE, LOOPBACK, free_port, keep
from vlagents_ray.serve.readiness import wait_until_ready
from vlagents_ray.serve.tls import Tls

__all__ = ["Server", "free_port", "running_server", "spread_over_gpus"]

log = logging.getLogger(__name__)

_START_S, _GROW_S = 600.0, 3600.0  # until a policy is ready: here; on a cluster that may first want another machine
_SHUTDOWN_S = 30.0


@dataclass(frozen=True, slots=True)
class Server:
    """A running server."""

    url: str  # http(s)://host:port
    apps: Mapping[str, str] = field(default_factory=dict)  # application -> its URL


@contextlib.contextmanager
def running_server(
    config: ServeDeploySchema,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    address: str | None = None,
    num_cpus: int | None = None,
    show_logs: bool = False,
    timeout_s: float | None = None,
    keys_file: Path | None = None,
    insecure: bool = False,
    tls: Tls | None = None,
) -> Iterator[Server]:
    """Serve `config` for the length of the context, and take down on exit what was started here.

    `port` 0 takes a free one. `address` names a running Ray cluster (or "auto"); otherwise a local
    one is started, unless this process is connected already. `timeout_s` is 600, with an `address` 3600.
    `keys_file` and `insecure` stand for `access` in the applications' args; unless `host` is a loopback
    address, one of the two must be given somewhere.
    Raises `ConfigError` when the deployment fails, `PolicyUnavailable` when it takes too long.
    """
    config = with_gateways_at(config, host)
    config = _access(config, keys_file, insecure)
    if address is None:  # else each replica says so, where it runs
        _require_access(config, host, insecure)
    if tls is not None:
        tls.check()
    for app in _our_apps(config):
        keep(*(door.port for door in ServerArgs(**app.args).dialects.gateways().values()))
    port = port or free_port(host)
    with contextlib.ExitStack() as stack:
        http = stack.enter_context(_ray(address, host, port, tls, num_cpus, show_logs))
        from ray import serve
        from ray.serve._private.api import serve_start

        client = serve_start(
            http_options=http,
            proxy_location="HeadOnly" if address is None else "EveryNode",
        )
        if running := sorted(serve.status().applications):
            raise ConfigError(
                f"Serve runs {running} on this cluster already; use their URL (serve://{running[0]} inside the "
                f"cluster), or `serve deploy` one file that holds those and yours"
            )
        stack.push(unless_lost(lambda: _shutdown(client)))
        client.deploy_apps(config)
        url = f"{'http' if tls is None else 'https'}://{LOOPBACK if host == EVERYWHERE else host}:{port}"
        paths = {app.name: (app.route_prefix or "").rstrip("/") for app in config.applications}
        if timeout_s is None:
            timeout_s = _START_S if address is None else _GROW_S
        deadline = time.monotonic() + timeout_s
        inside = _inside(http)
        ours = {app.name for app in _our_apps(config)}
        wait_until_ready(serve, {name: inside + path for name, path in paths.items()}, ours, deadline)
        if address is None and (stats_port := os.environ.get("RAY_SERVE_HAPROXY_STATS_PORT")):
            wait_for_haproxy(serve, paths, int(stats_port), deadline)
        yield Server(url, {name: url + path for name, path in paths.items()})


def _access(config: ServeDeploySchema, keys_file: Path | None, insecure: bool) -> ServeDeploySchema:
    """The deployment with what the command line says of access, if anything."""
    if keys_file is not None and insecure:
        raise ConfigError("keys and insecure exclude each other; keep one")
    if keys_file is None and not insecure:
        return config
    access = {"insecure": True} if keys_file is None else {"keys_file": str(keys_file.absolute())}
    changed = config.model_copy(deep=True)
    for app in _our_apps(changed):
        app.args["access"] = access
    return changed


def _our_apps(config: ServeDeploySchema) -> list[Any]:
    return [app for app in config.applications if app.import_path == IMPORT_PATH]


def _require_access(config: ServeDeploySchema, host: str, insecure: bool) -> None:
    """`ConfigError` if an application lets others in without keys, or its keys cannot be read."""
    ours = _our_apps(config)
    for app in config.applications:  # another one asks for no keys
        access = AccessArgs(**app.args.get("access", {})) if app in ours else AccessArgs(insecure=insecure)
        require_access(host, access.keys() if app in ours else None, access.insecure)


@contextlib.contextmanager
def _ray(
    address: str | None, host: str, port: int, tls: Tls | None, num_cpus: int | None, show_logs: bool
) -> Iterator[dict[str, Any]]:
    """A Ray; yields Serve's options for where it is to listen."""
    import ray

    if not ray.is_initialized() and address is None:
        with own_ray(host, port, tls=tls, num_cpus=num_cpus, show_logs=show_logs) as front:
            yield _behind(front, host, port, tls)
        return
    if tls is not None:
        raise ConfigError(
            "TLS on a cluster that runs already: end it before Serve, in the cluster's load balancer, or name "
            "ssl_certfile and ssl_keyfile under http_options in the deployment file"
        )
    bare = host in (LOOPBACK, "localhost", EVERYWHERE)
    if os.environ.get("RAY_SERVE_ENABLE_HA_PROXY") == "1" and address is None and not bare:
        raise ConfigError(
            f"host {host}: with HAProxy Serve would find no replica at a single address; "
            f"use {EVERYWHERE} (or {LOOPBACK}), or leave ray.init() to this function"
        )
    with joined(address, log_to_driver=show_logs):
        yield {"host": host, "port": port}


def spread_over_gpus(parts: Mapping[str, ServeDeploySchema], *, kept: float = 0.0) -> dict[str, ServeDeploySchema]:
    """Deployments that share the GPUs of the cluster that this process is connected to, less those that are `kept`."""
    import ray

    share = max(0.0, ray.cluster_resources().get("GPU", 0.0) - kept) / len(parts)
    return {name: with_replicas_on(part, share) for name, part in parts.items()}


def _behind(front: Front | None, host: str, port: int, tls: Tls | None) -> dict[str, Any]:
    """Where Serve listens itself, and with which certificate."""
    if front is not None:
        return {"host": LOOPBACK, "port": front.inside}
    if tls is None:
        return {"host": host, "port": port}
    if tls.client_ca is not None:
        raise ConfigError("TLS with certificates of clients needs HAProxy: pip install 'vlagents-ray[serve]'")
    return {"host": host, "port": port, "ssl_certfile": str(tls.certificate), "ssl_keyfile": str(tls.key)}


def _inside(http: Mapping[str, Any]) -> str:
    """Serve's own URL, for a process on its node."""
    scheme = "https" if http.get("ssl_certfile") else "http"
    return f"{scheme}://{LOOPBACK if http['host'] == EVERYWHERE else http['host']}:{http['port']}"


def _stop_listening(client: Any) -> None:
    """Ask the controller for no more news: Ray would report a call that is under way when it ends as a failed task."""
    from ray.serve._private.router import SharedRouterLongPollClient

    for handle in client.handle_cache.values():
        router = getattr(handle._router, "_asyncio_router", None)
        if router is not None:
            router.long_poll_client.stop()
            SharedRouterLongPollClient.get_or_create(client._controller, router._event_loop).long_poll_client.stop()


def _shutdown(client: Any) -> None:
    """End Serve: replicas drain, HAProxy stops. What `serve.shutdown` does, less its alarm.

    The controller ends itself in the middle of this call, which Ray would report as a failed task
    that is going to be retried.
    """
    import ray
    from ray.serve.context import _set_global_client

    _stop_listening(client)
    client.shutdown_cached_handles()
    last = client._controller.graceful_shutdown.options(max_task_retries=0).remote()
    try:
        ray.get(last, timeout=_SHUTDOWN_S)
    except ray.exceptions.RayActorError:
        pass
    except ray.exceptions.GetTimeoutError:
        log.warning("Serve has not ended within %g s; nobody waits for it any longer", _SHUTDOWN_S)
    client._shutdown = True
    _set_global_client(None)
