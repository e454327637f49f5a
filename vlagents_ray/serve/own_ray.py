"""A Ray of our own on this machine, which no other machine and no other user can reach."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from vlagents_ray.errors import ConfigError
from vlagents_ray.joining import start_ray
from vlagents_ray.serve.haproxy import Front, haproxy_binary, ingress_environment
from vlagents_ray.serve.ports import HOST, LOOPBACK, free_port, is_free, keep
from vlagents_ray.serve.reaper import MARK, reaped
from vlagents_ray.serve.tls import Tls

_MODE = "RAY_AUTH_MODE"
# Ray asks it whether this machine is one of a cluster, and takes the loopback address for a node's own if not: then
# all that it listens at is there. (An argument that says so, `_node_ip_address`, is turned into another address.)
_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
# Where Ray's monitor shows its metrics: any page of them is answered with 200. Every Ray wants the same one.
_METRICS = "AUTOSCALER_METRIC_PORT"


@contextlib.contextmanager
def own_ray(
    host: str, port: int, *, tls: Tls | None = None, num_cpus: int | None = None, show_logs: bool = False
) -> Iterator[Front | None]:
    """For the length of the context, for a server at `host:port`.

    Yields what lets its clients in, if that is not Serve itself. `ConfigError` if the port is taken.
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
    with tempfile.TemporaryDirectory(prefix="vlagents-ray-") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        # Ray starts its workers with a low priority, which would make a policy wait for whatever else runs here.
        environment = {"RAY_worker_niceness": "0"}
        # Where replicas listen for WebSockets. Not for the network where that is to see nothing but TLS.
        ours = {MARK: name, _ALONE: "0", HOST: host if tls is None else LOOPBACK}
        ours[_METRICS] = str(free_port())
        front = None
        if (binary := haproxy_binary()) is not None:
            front = _front(folder, host, port, tls)
            ingress = ingress_environment(folder, binary, front)
            ours |= {key: ingress.pop(key) for key in ("RAY_SERVE_HAPROXY_BINARY_PATH",)}
            environment |= ingress
        stack.enter_context(reaped(folder))
        stack.enter_context(_environment(environment, ours))
        stack.enter_context(_alone())
        if front is not None:
            front.require()
        start_ray(num_cpus=num_cpus, include_dashboard=False, log_to_driver=show_logs, logging_level="WARNING")
        stack.callback(ray.shutdown)
        # Whoever reaches the object store's socket reads and writes all observations. (The folder would not stay
        # closed: each of Ray's processes opens it to everybody when it starts.)
        node = ray._private.worker.global_worker.node
        for path in (node.plasma_store_socket_name, node.raylet_socket_name):
            Path(path).chmod(0o600)
        yield front


def _front(folder: Path, host: str, port: int, tls: Tls | None) -> Front | None:
    if tls is None and host in (LOOPBACK, "localhost"):
        return None
    return Front(
        host,
        port,
        free_port(),
        None if tls is None else tls.bundle(folder),
        None if tls is None or tls.client_ca is None else tls.client_ca.absolute(),
    )


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """In this process too, which has read the variable when it imported Ray."""
    from ray._private import ray_constants

    before = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = before


@contextlib.contextmanager
def _environment(values: Mapping[str, str], ours: Mapping[str, str]) -> Iterator[None]:
    """Set variables for processes started inside the context; what the user has set stays, unless it is in `ours`.

    A process that another server's process started has inherited that server's files and ports: those
    are replaced.
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
