"""Start Ray and Serve here, or use a running cluster, and serve a deployment as long as it is wanted.

A server of our own gets HAProxy in front of its replicas where its binary is installed, with files
and ports that no other server on the machine uses.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ray.serve.schema import ServeDeploySchema

from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.serve.haproxy import (
    behind_haproxy,
    haproxy_available,
    ingress_environment,
    is_foreign,
    wait_for_haproxy,
)
from vlagents_ray.serve.ports import EVERYWHERE, HOST, LOOPBACK, free_port, is_free
from vlagents_ray.serve.reaper import MARK, reaped

__all__ = ["Server", "free_port", "running_server"]

_SHUTDOWN_S = 30.0


@dataclass(frozen=True, slots=True)
class Server:
    """A running server."""

    url: str  # http://host:port
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
    timeout_s: float = 600.0,
) -> Iterator[Server]:
    """Serve `config` for the length of the context, and take down on exit what was started here.

    `port` 0 takes a free one. `address` names a running Ray cluster (or "auto"); otherwise a local
    one is started, unless this process is connected already.
    Raises `ConfigError` when the deployment fails, `PolicyUnavailable` when it takes too long.
    """
    port = port or free_port(EVERYWHERE if is_foreign(host) else host)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_ray(address, host, port, num_cpus, show_logs))
        from ray import serve
        from ray.serve._private.api import serve_start

        client = serve_start(
            http_options={"host": behind_haproxy(host, port) if address is None else host, "port": port},
            proxy_location="HeadOnly" if address is None else "EveryNode",
        )
        if running := sorted(serve.status().applications):
            raise ConfigError(
                f"Serve runs {running} on this cluster already; use their URL (serve://{running[0]} inside the "
                f"cluster), or deploy beside them with `serve deploy`"
            )
        stack.callback(_shutdown, client)
        client.deploy_apps(config)
        url = f"http://{LOOPBACK if host == EVERYWHERE else host}:{port}"
        apps = {app.name: url + (app.route_prefix or "").rstrip("/") for app in config.applications}
        deadline = time.monotonic() + timeout_s
        _wait(serve, apps, deadline)
        if address is None and (stats_port := os.environ.get("RAY_SERVE_HAPROXY_STATS_PORT")):
            wait_for_haproxy(serve, apps, int(stats_port), deadline)
        yield Server(url, apps)


@contextlib.contextmanager
def _ray(address: str | None, host: str, port: int, num_cpus: int | None, show_logs: bool) -> Iterator[None]:
    import ray

    if ray.is_initialized():
        yield
        return
    if address is not None:
        ray.init(address=address, log_to_driver=show_logs, logging_level="WARNING")
        try:
            yield
        finally:
            ray.shutdown()
        return
    if not is_free(host, port) or (is_foreign(host) and not is_free(LOOPBACK, port)):
        raise ConfigError(f"cannot listen on {host}:{port}: it is taken; choose another --port or --host")
    with tempfile.TemporaryDirectory(prefix="vlagents-ray-") as folder, contextlib.ExitStack() as stack:
        # Ray starts its workers with a low priority, which would make a policy wait for whatever else runs here.
        environment = {"RAY_worker_niceness": "0", MARK: folder, HOST: host}
        if haproxy_available():
            environment |= ingress_environment(Path(folder), host, port)
        stack.enter_context(reaped(Path(folder)))
        stack.enter_context(_environment(environment))
        ray.init(num_cpus=num_cpus, include_dashboard=False, log_to_driver=show_logs, logging_level="WARNING")
        stack.callback(ray.shutdown)
        yield


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set variables for processes started inside the context; what the user has set stays.

    A process that another server's process started has inherited that server's files and ports: those
    are replaced.
    """
    inherited = MARK in os.environ
    before = {key: os.environ.get(key) for key in values if inherited or key not in os.environ}
    os.environ.update({key: values[key] for key in before})
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                os.environ.pop(key, None)
            else:
                os.environ[key] = value


def _wait(serve: Any, apps: Mapping[str, str], deadline: float) -> None:
    """Until each application runs and its door answers; raises what keeps it from doing so."""
    while True:
        status = serve.status().applications
        for name in apps:
            app = status.get(name)
            if app is not None and app.status in ("DEPLOY_FAILED", "UNHEALTHY"):
                raise ConfigError(f"application {name!r} failed to deploy: {_reason(app)}")
        if all(name in status and status[name].status == "RUNNING" for name in apps):
            break
        if time.monotonic() > deadline:
            raise PolicyUnavailable(f"not running in time: { {n: str(status[n].status) for n in apps if n in status} }")
        time.sleep(0.1)
    for name, url in apps.items():
        while (refusal := _refusal(url)) is not None:
            if "did not load" in refusal:
                raise ConfigError(f"application {name!r}: {refusal}")
            if time.monotonic() > deadline:
                raise PolicyUnavailable(f"application {name!r} is not ready: {refusal}")
            time.sleep(0.05)


def _refusal(url: str) -> str | None:
    """Why `/healthz` is not 200 yet; None when it is."""
    try:
        with urllib.request.urlopen(f"{url}/healthz", timeout=5):  # noqa: S310 - our own http URL
            return None
    except urllib.error.HTTPError as error:
        body = error.read()
        if "problem+json" in error.headers.get("content-type", ""):
            return str(json.loads(body)["detail"])
        return f"HTTP {error.code}"
    except OSError as error:
        return str(error)


def _reason(app: Any) -> str:
    """The last line of what Serve says of a failure: the error, below its traceback."""
    texts = [app.message, *(d.message for d in app.deployments.values())]
    lines = [line.strip() for text in texts for line in (text or "").splitlines() if line.strip()]
    return lines[-1] if lines else "Serve gives no reason"


def _shutdown(client: Any) -> None:
    """End Serve: replicas drain, HAProxy stops. What `serve.shutdown` does, less its alarm.

    The controller ends itself in the middle of this call, which Ray would report as a failed task
    that is going to be retried.
    """
    import ray
    from ray.serve.context import _set_global_client

    client.shutdown_cached_handles()
    last = client._controller.graceful_shutdown.options(max_task_retries=0).remote()
    with contextlib.suppress(ray.exceptions.RayActorError):
        ray.get(last, timeout=_SHUTDOWN_S)
    client._shutdown = True
    _set_global_client(None)
