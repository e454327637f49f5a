"""Serves a deployment within a context, on a new Ray of this process or on a running cluster.

A server on its own Ray has HAProxy in front of its replicas if the binary is installed, with files
and ports that no other server on the machine uses. Only HAProxy may listen on the network.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import ray
from ray import serve
from ray.serve.exceptions import RayServeException

from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.ray_tools import head_monitor, private, session
from vlagents_ray.ray_tools.reaper import MARK
from vlagents_ray.registry import pip_install
from vlagents_ray.serve.access.api_keys import require_access, warn_of_plain_http
from vlagents_ray.serve.config.deployment import AccessArgs, ServerArgs
from vlagents_ray.serve.engine.health import NOT_LOADED
from vlagents_ray.serve.launch import haproxy
from vlagents_ray.serve.launch.deployment_file import (
    IMPORT_PATH,
    Application,
    Deployment,
    our_apps,
    with_gateways_at,
    with_replicas_on,
)
from vlagents_ray.serve.ports import EVERYWHERE, HOST, LOOPBACK, free_port, is_free, keep

log = logging.getLogger(__name__)

_SHUTDOWN_S = 30.0
# Time within which Serve's proxies must listen, s. On a busy node, Serve replaces several proxies
# before one of them listens.
_PROXIES_S = 180.0
# Time in which Ray's head, which systemd stops together with this process, refuses connections, s.
_HEAD_S = 0.3
_HAPROXY_S = 0.5  # time in which HAProxy is updated after the end of an application, s
# Interval of the checks whether Serve's proxies listen, and whether Serve has ended, s.
_LOOK_S = 0.2
_START_S = 600.0  # time for a policy to become ready on this machine
_GROW_S = 3600.0  # time for a policy to become ready on a cluster that may add a machine first
_REMIND_S = 30.0


def wait_for_proxies(proxies: list[Any], look_again: Callable[[], list[Any]]) -> None:
    """Wait until all proxies listen; raise the error of a proxy that cannot listen.

    Serve kills a proxy that does not start within some seconds, for example on a busy node, and
    starts another proxy.

    Args:
        proxies: The refs of the proxies.
        look_again: Returns the refs of the current proxies.
    """
    deadline = time.monotonic() + _PROXIES_S
    while True:
        try:
            ray.get(proxies, timeout=max(deadline - time.monotonic(), 0.0))
        except (ray.exceptions.GetTimeoutError, ray.exceptions.RayActorError) as error:
            if time.monotonic() >= deadline:
                raise PolicyUnavailable(
                    f"Serve's proxies do not listen within {_PROXIES_S:g} s"
                ) from error
            time.sleep(_LOOK_S)
            proxies = look_again()
        else:
            return


def end_applications(client: Any, names: Sequence[str]) -> None:
    """End these applications, and wait until their replicas have ended.

    When Serve shuts down, it stops HAProxy immediately. This would end the connections of the
    clients before the replicas have sent their answers and closed the WebSockets. If only the
    applications are removed, HAProxy keeps these connections; see also `haproxy.close_port`.

    If Ray's head ends as well, nothing is requested of Serve, since Ray would print that the
    requests failed.
    """
    if head_monitor.head_ends_within(_HEAD_S):
        return

    ending = private.begin_to_end(client, names)
    try:
        _wait_for_the_end_of_applications(client)
    finally:
        # Ray prints the error of a call whose result nobody has read.
        with contextlib.suppress(ray.exceptions.RayError):
            ray.get(ending, timeout=0)


def _wait_for_the_end_of_applications(client: Any) -> None:
    deadline = time.monotonic() + _SHUTDOWN_S
    while time.monotonic() < deadline and not head_monitor.head_is_gone():
        listing = private.list_applications(client)
        if not ray.wait([listing], timeout=_LOOK_S)[0]:
            continue
        try:
            left = ray.get(listing)
        except ray.exceptions.RayError:  # the controller has ended
            return
        if not left:
            # If HAProxy ended during its last update, Serve would log an error.
            time.sleep(_HAPROXY_S)
            return
        time.sleep(_LOOK_S)


def shut_down(client: Any) -> None:
    """Shut Serve down as `serve.shutdown` does, so that replicas drain and HAProxy stops, but
    without an error message of Ray.

    The controller ends itself during this call, which Ray would report as a failed task that will
    be retried. A signal to the whole process group or service, such as systemd's SIGTERM, also ends
    Ray's head. Serve can then neither answer nor continue, and the reaper ends its processes.
    """
    # Ray would report a call that is in progress at the end as a failed task.
    for poll in private.long_polls(client):
        poll.stop()
    client.shutdown_cached_handles()

    private.silence_lost_polls()
    if not head_monitor.head_is_gone():
        _end_serve(client)
    private.forget_serve(client)


def _end_serve(client: Any) -> None:
    ending = private.end_controller(client)
    deadline = time.monotonic() + _SHUTDOWN_S
    while not ray.wait([ending], timeout=_LOOK_S)[0] and not head_monitor.head_is_gone():
        if time.monotonic() > deadline:
            log.warning("Serve has not ended within %g s and keeps running", _SHUTDOWN_S)
            return


@dataclass(frozen=True, slots=True)
class Server:
    """The addresses of a running server, and its deployment."""

    url: str  # http(s)://host:port
    deployed: Deployment  # the deployment, with the access settings of this process
    apps: Mapping[str, str] = field(default_factory=dict)  # URL of each application
    metrics: tuple[str, ...] = ()  # URL of the metrics of each node of Ray, for Prometheus


@contextlib.contextmanager
def running_server(
    config: Deployment,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    address: str | None = None,
    num_cpus: int | None = None,
    timeout_s: float | None = None,
    keys_file: Path | None = None,
    insecure: bool = False,
    plain_http: bool = False,
    tls: haproxy.Tls | None = None,
    ingress: bool = True,
) -> Iterator[Server]:
    """Return a context manager that serves `config` and, on exit, stops everything that it started.

    Args:
        config: The deployment.
        host: The address to listen on, IPv4. Addresses other than loopback require `keys_file`,
            keys in the deployment, or `insecure`.
        port: The port; 0 selects a free one.
        address: A running Ray cluster, or "auto"; by default this process's cluster, or a new local
            one.
        num_cpus: Number of CPUs of a new local cluster.
        timeout_s: Time limit for the start; by default 600 s, with an `address` 3600 s.
        keys_file: Replaces `access.keys_file` of the applications.
        insecure: Whether other machines may connect without keys; replaces `access.insecure`.
        plain_http: Replaces `access.plain_http`.
        tls: The server's certificate and key.
        ingress: Whether to serve HTTP. Without HTTP, a new local cluster serves only its own
            processes, at `serve://APP`, and starts and ends faster.

    Raises:
        ConfigError: The deployment is invalid or fails.
        PolicyUnavailable: The start exceeds its time limit.
    """
    if ":" in host:
        raise ConfigError(
            f"host: expected an IPv4 address, got {host}; use an IPv4 address, or 0.0.0.0 for all "
            "addresses of this machine"
        )
    private.check_ray()
    config = with_gateways_at(config, host)
    config = _with_access(config, keys_file, insecure, plain_http)
    if address is None:  # otherwise each replica checks the access, and warns, on its own machine
        _check_access(config, host, insecure, tls)
    if tls is not None:
        tls.check()

    for app in our_apps(config):
        for gateway in ServerArgs(**app.args).dialects.gateways().values():
            keep(gateway.port)
    is_own_ray = address is None and not ray.is_initialized()
    if is_own_ray:
        _require_gpus(config, private.gpus_here())

    with contextlib.ExitStack() as stack:
        ingress = ingress or not is_own_ray or len(our_apps(config)) < len(config.applications)
        public_port = port or free_port(host)
        begins_empty = not all(map(_begins_with_replicas, config.applications))
        http = stack.enter_context(
            _ray(address, host, public_port, tls, num_cpus, ingress, begins_empty)
        )
        client, proxies = private.start_serve(http, _proxy_location(ingress, address))
        running = sorted(serve.status().applications)
        if running:
            raise ConfigError(
                f"Serve runs {running} on this cluster already; use their URL "
                f"(serve://{running[0]} inside the cluster), or `serve deploy` one file with these "
                "applications and yours"
            )
        stack.push(session.unless_lost(lambda: shut_down(client)))

        _require_gpus(config)
        deploy(client, config, is_own_ray=is_own_ray, ingress=ingress)

        if timeout_s is None:
            timeout_s = _START_S if address is None else _GROW_S
        deadline = time.monotonic() + timeout_s
        paths = {app.name: (app.route_prefix or "").rstrip("/") for app in config.applications}
        inside_scheme = "https" if http.get("ssl_certfile") else "http"
        inside = _url(inside_scheme, http["host"], http["port"])
        inside_urls = {name: inside + path if ingress else None for name, path in paths.items()}
        ours = {app.name for app in our_apps(config)}
        wait_for_proxies(proxies, lambda: private.proxies_now(client))
        missing = functools.partial(_missing_gpus, config)
        wait_until_ready(serve, inside_urls, ours, deadline, missing)
        stats_port = os.environ.get("RAY_SERVE_HAPROXY_STATS_PORT")
        if ingress and address is None and stats_port:
            haproxy.wait_for_haproxy(serve, paths, int(stats_port), deadline)

        if ingress:
            names = [app.name for app in config.applications]
            stack.push(session.unless_lost(lambda: end_applications(client, names)))
        if is_own_ray:
            stack.callback(haproxy.close_port)
        url = _url("http" if tls is None else "https", host, public_port)
        if is_own_ray and ingress:
            session.announce(url, paths, ray.get_runtime_context().gcs_address)
        urls = {name: url + path for name, path in paths.items()}
        yield Server(url, config, urls, session.metrics_urls())


def _proxy_location(ingress: bool, address: str | None) -> str:
    """Return on which nodes Serve has proxies."""
    if not ingress:
        return "Disabled"
    return "HeadOnly" if address is None else "EveryNode"


def _url(scheme: str, host: str, port: int) -> str:
    """Return a URL at which this machine reaches a server that listens at `host`."""
    return f"{scheme}://{LOOPBACK if host == EVERYWHERE else host}:{port}"


def _with_access(
    config: Deployment, keys_file: Path | None, insecure: bool, plain_http: bool
) -> Deployment:
    """Return the deployment with the access settings of the command line, if there are any."""
    if keys_file is not None and insecure:
        raise ConfigError("expected keys or insecure, got both; keep one")
    changed = config.model_copy(deep=True)
    for app in our_apps(changed):
        access = dict(app.args.get("access") or {})
        if keys_file is not None or insecure:  # either option replaces both settings in the file
            access |= {
                "insecure": insecure,
                "keys_file": None if keys_file is None else str(keys_file.absolute()),
            }
        if plain_http:
            access["plain_http"] = True
        if access:
            app.args["access"] = access
    return changed


def deploy(client: Any, config: Deployment, *, is_own_ray: bool, ingress: bool) -> None:
    """Deploy the applications, without waiting for them.

    For a deployment file, Serve starts a process that imports the server again. On a Ray of this
    process, applications of this package are built in this process instead, unless their file has
    settings that Serve must apply. If such a file were deployed again, Serve would replace all
    replicas of an application that Serve did not build.

    Args:
        client: Serve's client.
        config: The deployment.
        is_own_ray: Whether this process started the Ray.
        ingress: Whether the server has an HTTP port. Otherwise replicas end without waiting for
            requests, since their clients have already ended.
    """
    from vlagents_ray.serve.app import application

    if not config.plain or not is_own_ray:
        client.deploy_apps(config.for_serve())
        return

    targets = []
    for app in config.applications:
        built = application(ServerArgs(**app.args), drains=ingress)
        targets.append(serve.RunTarget(built, app.name, app.route_prefix))
    serve.run_many(
        targets, wait_for_ingress_deployment_creation=False, wait_for_applications_running=False
    )


def _require_gpus(config: Deployment, local_gpus: float | None = None) -> None:
    """Raise `ConfigError` if the replicas need more GPUs than the Ray of this process has, since
    they would wait forever.

    `local_gpus` is the number of GPUs that a new local Ray would have. An existing cluster may
    grow. Missing GPUs of such a cluster therefore only cause a warning, which is repeated while the
    replicas wait.
    """
    if local_gpus is None and not session.started_here():
        return
    missing = _missing_gpus(config, local_gpus)
    if missing is not None:
        raise ConfigError(f"{missing}; if the machine has more GPUs, run `vlagents-ray doctor`")


def _missing_gpus(config: Deployment, local_gpus: float | None = None) -> str | None:
    """Return a sentence about the missing GPUs of this machine or the running cluster; None if
    there are enough.
    """
    needed = {app.name: _gpus(ServerArgs(**app.args)) for app in our_apps(config)}
    total = sum(needed.values())
    available = ray.cluster_resources().get("GPU", 0.0) if local_gpus is None else local_gpus
    if total <= available:
        return None
    is_local = local_gpus is not None or session.started_here()
    where = "this machine" if is_local else "this cluster"
    return (
        f"resources.num_gpus: expected at most {available:g} GPUs, which {where} has, got "
        f"{total:g} for the replicas of {needed}; reduce the setting (0 runs on the CPU), or add a "
        "machine with GPUs"
    )


def _begins_with_replicas(app: Application) -> bool:
    """Return whether an application gets a replica before its first request; False for an
    application of another package that may start without one.
    """
    return app.import_path == IMPORT_PATH and ServerArgs(**app.args).initial_replicas > 0


def _gpus(args: ServerArgs) -> float:
    """Return the total number of GPUs that the initial replicas need."""
    return args.initial_replicas * args.resources.num_gpus


def _check_access(config: Deployment, host: str, insecure: bool, tls: haproxy.Tls | None) -> None:
    """Check the access to each application, and warn if keys would cross the network unencrypted.

    Raises:
        ConfigError: An application accepts other machines without keys, or its keys cannot be read.
    """
    ours = our_apps(config)
    has_plain_keys = False
    for app in config.applications:
        if app in ours:
            access = AccessArgs(**app.args.get("access", {}))
            keys = access.keys()
        else:  # applications of other packages require no keys
            access = AccessArgs(insecure=insecure)
            keys = None
        require_access(host, keys, access.insecure)
        if keys is not None and not access.plain_http:
            has_plain_keys = True

    if has_plain_keys and tls is None:
        warn_of_plain_http(host)


@contextlib.contextmanager
def _ray(
    address: str | None,
    host: str,
    port: int,
    tls: haproxy.Tls | None,
    num_cpus: int | None,
    ingress: bool,
    begins_empty: bool,
) -> Iterator[dict[str, Any]]:
    """Connect to a Ray cluster or start one; yield Serve's options for host, port and
    certificate.
    """
    if not ray.is_initialized() and address is None:
        with own_ray(
            host, port, tls=tls, num_cpus=num_cpus, ingress=ingress, begins_empty=begins_empty
        ) as listener:
            if listener is not None:
                yield {"host": LOOPBACK, "port": listener.inside}
            elif tls is None:
                yield {"host": host, "port": port}
            else:
                yield {
                    "host": host,
                    "port": port,
                    "ssl_certfile": str(tls.certificate),
                    "ssl_keyfile": str(tls.key),
                }
        return

    if tls is not None:
        raise ConfigError(
            "TLS on a running cluster: expected no TLS options, got some; terminate TLS in front "
            "of Serve, in the cluster's load balancer, or set ssl_certfile and ssl_keyfile under "
            "http_options in the deployment file"
        )
    has_haproxy = os.environ.get("RAY_SERVE_ENABLE_HA_PROXY") == "1"
    if has_haproxy and address is None and host not in (LOOPBACK, "localhost", EVERYWHERE):
        raise ConfigError(
            f"host {host}: with HAProxy, Serve would find no replica at a single address; "
            f"use {EVERYWHERE} (or {LOOPBACK}), or leave ray.init() to this function"
        )
    with session.joined(address):
        yield {"host": host, "port": port}


def spread_over_gpus(
    deployments: Mapping[str, Deployment], *, reserved: float = 0.0
) -> dict[str, Deployment]:
    """Return deployments that share the GPUs of the connected cluster equally; `reserved` GPUs stay
    free.
    """
    gpus = max(0.0, ray.cluster_resources().get("GPU", 0.0) - reserved)
    share = gpus / len(deployments)
    return {name: with_replicas_on(deployment, share) for name, deployment in deployments.items()}


@contextlib.contextmanager
def own_ray(
    host: str,
    port: int,
    *,
    tls: haproxy.Tls | None = None,
    num_cpus: int | None = None,
    ingress: bool = True,
    begins_empty: bool = False,
) -> Iterator[haproxy.PublicListener | None]:
    """Return a context manager that runs a private Ray, which no other machine and no other user
    can reach.

    The arguments are described at `running_server`. The server will listen at `host` and `port` as
    soon as it has a replica. If an application `begins_empty`, the server listens immediately,
    since the first request then starts the replica.

    Yields:
        HAProxy's listener for clients; None if Serve listens itself.

    Raises:
        ConfigError: The port is in use, HAProxy, which certificates of clients require, is not
            installed, or the environment excludes Ray's token or HAProxy's settings.
    """
    if os.environ.get(session.MODE, "token").lower() != "token":
        raise ConfigError(
            f"{session.MODE}={os.environ[session.MODE]}: without Ray's token, other machines "
            "could run any code through a port of each replica; unset it"
        )
    if not is_free(host, port):
        raise ConfigError(
            f"cannot listen on {host}:{port}: the port is in use; choose another --port or --host"
        )
    keep(port)

    with session.ray_folder() as folder, contextlib.ExitStack() as stack:
        # By default Ray starts workers with a low priority, so that a policy would wait for all
        # other processes. Proxies start while policies load. On a slow machine, Serve would replace
        # the proxies after three times its default of 5 s.
        environment = {"RAY_worker_niceness": "0", "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "60"}
        # These variables replace the user's values. Replicas listen for WebSockets at the address
        # `HOST`, which is loopback if only TLS may cross the network.
        fixed = {MARK: str(folder), session.ALONE: "0", HOST: host if tls is None else LOOPBACK}

        listener = None
        binary = haproxy.haproxy_binary() if ingress else None
        if binary is None and tls is not None and tls.client_ca is not None:
            raise ConfigError(
                f"TLS with certificates of clients needs HAProxy: {pip_install('serve')}"
            )
        if not ingress:
            fixed["RAY_SERVE_ENABLE_HA_PROXY"] = "0"
        elif binary is not None:
            if tls is not None or host not in (LOOPBACK, "localhost"):
                listener = _public_listener(host, port, tls, folder)
            settings = haproxy.ingress_environment(folder, binary, listener)
            if begins_empty:
                haproxy.open_port(folder)
            # HAProxy's files and admin socket are in the folder, regardless of the user's settings
            # for clusters.
            for name, value in settings.items():
                if value.startswith(str(folder)):
                    fixed[name] = value
            environment |= settings

        # If the process of another server started this process, it has inherited the files and
        # ports of that server, which are replaced. Otherwise the user's values are kept, unless
        # they are in `fixed`.
        is_inherited = MARK in os.environ
        unset = {
            name: value
            for name, value in environment.items()
            if is_inherited or name not in os.environ
        }
        stack.enter_context(session.variables(unset | fixed | session.token_variables(folder)))

        # Ray has read the variable `ALONE` when Ray was imported, so Ray's copy of the setting is
        # also changed.
        stack.callback(private.use_loopback, private.use_loopback(True))
        if listener is not None:
            listener.require()
        session.start_ray(folder, num_cpus=num_cpus, logging_level="WARNING")
        stack.push(session.unless_lost(session.leave_ray))
        yield listener


def _public_listener(
    host: str, port: int, tls: haproxy.Tls | None, folder: Path
) -> haproxy.PublicListener:
    """Return HAProxy's listener for clients, with the certificate in a private `folder`."""
    bundle = None if tls is None else tls.bundle(folder)
    client_ca = None
    if tls is not None and tls.client_ca is not None:
        client_ca = tls.client_ca.absolute()
    return haproxy.PublicListener(host, port, free_port(), bundle, client_ca)


def wait_until_ready(
    serve: Any,
    apps: Mapping[str, str | None],
    ours: Collection[str],
    deadline: float,
    missing: Callable[[], str | None] = lambda: None,
) -> None:
    """Wait until each application runs and responds.

    Args:
        serve: The module `ray.serve`.
        apps: The URL of each application; an application without a URL is called through a Serve
            handle.
        ours: The applications of this package, which report why their policy is not ready yet.
        deadline: End of the waiting, s, of `time.monotonic()`.
        missing: Describes the resources that the cluster lacks, which is logged immediately, and
            again every 30 s.

    Raises:
        ConfigError: An application failed to deploy, or a policy failed to load.
        PolicyUnavailable: The deadline has passed.
    """
    remind_at = 0.0
    while True:
        status = serve.status().applications
        for name in apps:
            app = status.get(name)
            if app is None:
                continue
            failure = load_failure(app)
            if failure is None and app.status == "UNHEALTHY":
                failure = last_message(app)
            if failure is not None:
                raise ConfigError(f"application {name!r} failed to deploy: {failure}")
        if all(name in status and status[name].status == "RUNNING" for name in apps):
            break

        if time.monotonic() > deadline:
            states = {name: str(status[name].status) for name in apps if name in status}
            causes = [f"not running within the time limit: {states}", missing()]
            raise PolicyUnavailable("; ".join(filter(None, causes)))
        if time.monotonic() >= remind_at:
            remind_at = time.monotonic() + _REMIND_S
            obstacle = missing()
            if obstacle is not None:
                log.warning("waiting: %s", obstacle)
        time.sleep(0.1)

    for name, url in apps.items():
        while (refusal := _unready_reason(serve, name, url, ours)) is not None:
            if NOT_LOADED in refusal:
                raise ConfigError(f"application {name!r}: {refusal}")
            if time.monotonic() > deadline:
                raise PolicyUnavailable(f"application {name!r} is not ready: {refusal}")
            time.sleep(0.05)


def load_failure(app: Any, earlier: str = "") -> str | None:
    """Return the reason why an application failed to deploy, or why its policy did not load; None
    if neither has happened.

    Serve starts a replica again after a failure, as the replica may have been killed. A policy that
    did not load once will fail again, so its failure is returned without waiting for the next one.

    Args:
        app: Serve's status of the application.
        earlier: The last message before the deployment, which Serve may still report.
    """
    message = last_message(app)
    has_failed = NOT_LOADED in message and message != earlier
    return message if has_failed or app.status == "DEPLOY_FAILED" else None


def last_message(app: Any) -> str:
    """Return the last line of Serve's messages about an application, which is the error below its
    traceback.
    """
    lines: list[str] = []
    for text in (app.message, *(deployment.message for deployment in app.deployments.values())):
        lines += [line.strip() for line in (text or "").splitlines() if line.strip()]
    return lines[-1] if lines else "Serve reports no reason"


def _unready_reason(serve: Any, app: str, url: str | None, ours: Collection[str]) -> str | None:
    """Return the reason why the application is not ready; None if it is ready.

    The reason is requested from a replica, since over HTTP only clients with a key can read it.
    """
    refusal = None if url is None else _http_reason(url)
    if app not in ours or (url is not None and refusal is None):
        return refusal
    try:
        reason: str | None = serve.get_app_handle(app).refusal.remote().result(timeout_s=5)
    except (ray.exceptions.RayError, RayServeException, TimeoutError) as error:
        reason = str(error) or type(error).__name__
    return reason or refusal


def _http_reason(url: str) -> str | None:
    """Return the reason why `/healthz` does not reply with 200; None if it does."""
    unverified = ssl._create_unverified_context() if url.startswith("https") else None  # noqa: S323 - our own server
    try:
        with urllib.request.urlopen(f"{url}/healthz", timeout=5, context=unverified):  # noqa: S310 - our own URL
            return None
    except urllib.error.HTTPError as error:
        error.close()
        return f"HTTP {error.code}"
    except OSError as error:
        return str(error)
