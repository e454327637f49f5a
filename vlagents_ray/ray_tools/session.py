"""The connection of this process to a Ray cluster, which is already running or is started by this
module.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import secrets
import shutil
import socket
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from vlagents_ray.errors import ClusterLost, ConfigError
from vlagents_ray.ray_tools import private
from vlagents_ray.ray_tools.reaper import MARK, reaped
from vlagents_ray.signals import own_sigterm

log = logging.getLogger(__name__)

HEAD_NODE = "node:__internal_head__"  # a resource that Ray assigns to the head node of any cluster
_ATTEMPTS = 3
# With the default, a driver whose head has ended waits 5 s to send its last events, which this
# package does not use.
_CONFIG = {"task_events_shutdown_flush_timeout_ms": 300}
# Options of the cluster, not of the driver.
_RESOURCES = ("num_cpus", "num_gpus", "resources", "object_store_memory")
_FAILED = "Check failed: "  # prefix in the log of a daemon that aborted
FILES = "ray"  # name of the folder of Ray's files in a `ray_folder`
_SHORT = "/tmp"  # noqa: S108 - used if the names of Ray's sockets would be too long elsewhere
# The longest socket names in such a folder: a socket of Ray, and a socket of HAProxy, whose folder
# is named after the node.
_SOCKETS = (
    f"{FILES}/session_2026-01-31_12-00-00_123456_1234567/sockets/.vla12345678",
    f"{'0' * 56}/admin.1234567.tmp",
)
_LONGEST = 107 - len("/vlr-12345678/") - max(map(len, _SOCKETS))
# Number of attempts, 0.05 s apart, since a process that is ending may still write to the folder.
_REMOVALS = 100
_FILE = "server.json"  # written into the private folder of a server's Ray when the server is ready

_TOKEN_FILE = "token"  # noqa: S105 - name of the file with the cluster's token, in its `ray_folder`

MODE, _TOKEN, _TOKEN_PATH = "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"
# If this variable is "0", Ray assumes a single-node cluster and uses the loopback address as the
# node's address, so that all ports are bound to it. (Ray replaces an address given as
# `_node_ip_address`.)
ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
_started: list[Any] = []  # Ray's record of the daemons that this process has started, at most one


@contextlib.contextmanager
def joined(address: str | None = None, **options: Any) -> Iterator[None]:
    """Connect this process to a Ray cluster within the context, or use its existing connection.

    Args:
        address: The address of the cluster. None selects the cluster of RAY_ADDRESS, or of this
            machine. The URL of a server on this machine selects that server's cluster. "auto"
            selects the cluster of `ray start` or, if there is none, the cluster of a server.
            "local" starts a cluster that ends with the context.
        options: Further options of `ray.init`.

    Raises:
        ConfigError: The cluster does not exist, or it requires another token.
    """
    import ray

    if ray.is_initialized():
        yield
        return

    options = {"log_to_driver": False, "logging_level": "WARNING"} | options
    where = address or os.environ.get("RAY_ADDRESS")
    url = where if where is not None and urlsplit(where).scheme in ("http", "https") else None
    with contextlib.ExitStack() as stack:
        try:
            if address == "local":
                folder = stack.enter_context(ray_folder())
                stack.enter_context(variables(token_variables(folder)))
                with variables({MARK: str(folder)}):
                    start_ray(folder, **options)
            # If there is no cluster of `ray start`, Ray would try the cluster of a server on this
            # machine, and wait for ten minutes.
            elif url or (
                where == "auto" and private.address_of_ray_start() is None and local_servers()
            ):
                with own_sigterm():
                    join(url, **options)
            else:
                with own_sigterm():
                    ray.init(address=address, **options)
        except (ConnectionError, ray.exceptions.AuthenticationError) as error:
            raise ConfigError(
                f"cannot connect to a Ray cluster at {where!r}: {error}. Start Ray on this "
                "machine, or join it to a cluster (`ray start`); the page docs/cluster/index.md "
                "shows how"
            ) from error
        stack.push(unless_lost(leave_ray))
        yield


@contextlib.contextmanager
def ray_folder() -> Iterator[Path]:
    """Create a folder that is private to this user, with a subfolder `FILES` for the Ray that this
    process starts.

    Ray makes the folders of its sockets and logs accessible to every user. At the end of the
    context, or when this process is killed, the folder is removed and the processes that use it are
    ended.
    """
    base = os.environ.get("RAY_TMPDIR") or tempfile.gettempdir()
    if len(os.fsencode(base)) > _LONGEST:
        log.info(
            "Ray's files are in %s: the names of its sockets would be too long in %s", _SHORT, base
        )
        base = _SHORT
    Path(base).mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix="vlr-", dir=base))
    try:
        with reaped(folder, lost=ClusterLost):
            yield folder
    finally:
        for _ in range(_REMOVALS):
            shutil.rmtree(folder, ignore_errors=True)
            if not folder.exists():
                break
            time.sleep(0.05)


def token_variables(folder: Path) -> dict[str, str | None]:
    """Create the token of the cluster that is about to start, and return the variables that select
    it.

    A process with the token can run any code as this user. Ray itself would write one token for all
    clusters of the user to ~/.ray/auth_token, with the permissions of the umask, so that usually
    every account of the machine can read it. A token that the user or another cluster has set is
    replaced: only processes that call `join` can reach this cluster, and `join` finds the cluster's
    token.

    Args:
        folder: The `ray_folder` of the cluster, which no other user can enter.
    """
    path = folder / _TOKEN_FILE
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        file.write(secrets.token_hex(32))
    return {_TOKEN_PATH: str(path), _TOKEN: None}


@contextlib.contextmanager
def variables(values: Mapping[str, str | None]) -> Iterator[None]:
    """Set environment variables for processes that are started within the context.

    The value None unsets a variable.
    """
    before = {name: os.environ.get(name) for name in values}
    _set_variables(values)
    try:
        yield
    finally:
        _set_variables(before)


def _set_variables(values: Mapping[str, str | None]) -> None:
    for name, value in values.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def start_ray(folder: Path, **options: Any) -> None:
    """Start a Ray cluster on this machine and join it. The start is tried again if it times out.

    Ray's daemon waits at most 15 s for each of its helpers (ray issue 65983), which can be too
    short on a busy machine or if Python's modules are on a slow disk. The next attempt is faster,
    since the modules are then cached. `leave_ray` ends the cluster.

    Args:
        folder: A `ray_folder`, for the files of Ray. It also contains log files with the output of
            Ray's processes.
        options: Further options of `ray.init`: resources, `logging_level`, `namespace`, ...

    Raises:
        ConfigError: No attempt succeeded.
    """
    import ray

    resources = {name: options.pop(name) for name in _RESOURCES if name in options}
    if "logging_level" in options:
        logging.getLogger("ray").setLevel(options["logging_level"])
    for attempt in range(1, _ATTEMPTS + 1):
        node = None
        try:
            with own_sigterm(), _taken_port() as port:
                node = private.start_head(
                    str(folder / FILES), port, _system_config=_CONFIG, **resources
                )
                ray.init(node.gcs_address, **({"log_to_driver": False} | options))
        except Exception as error:  # Ray raises a plain Exception
            node = node or private.node_that_failed(error)
            # If no process was started, a timeout is not the cause.
            if node is None or not node.all_processes:
                raise
            # Ray does not end these processes itself.
            node.kill_all_processes(check_alive=False, wait=True)
            if isinstance(error, ValueError):  # an invalid option
                raise
            reason = f"{error} {_daemon_error(node)}".rstrip()
            if attempt == _ATTEMPTS:
                raise ConfigError(
                    f"Ray did not start on this machine in {_ATTEMPTS} attempts: {reason}. If the "
                    "machine is busy, run less on it; if Python's modules are on a slow disk, copy "
                    f"the environment to a local one. Logs: {_copy_logs(node)}"
                ) from error
            log.warning(
                "Ray did not start, trying again (attempt %d of %d): %s",
                attempt + 1,
                _ATTEMPTS,
                reason,
            )
        else:
            _started.append(node)
            return


def leave_ray() -> None:
    """Leave the cluster, and end it if this process has started it with `start_ray`."""
    import ray

    ray.shutdown()
    while _started:
        _started.pop().kill_all_processes(check_alive=False, wait=True)
    private.reread_authentication()  # The next cluster has another token.


def started_here() -> bool:
    """Return whether this process is in a cluster that it started itself."""
    node = private.node_of_this_process()
    return node is not None and any(started.gcs_address == node.gcs_address for started in _started)


@contextlib.contextmanager
def _taken_port() -> Iterator[int]:
    """Yield a port that is already in use, as the port of the unused dashboard.

    Ray starts the dashboard's server even without a dashboard, for usage statistics, and waits 2 s
    for it unless the port is in use. If the port is in use, Ray logs an error, which is dropped
    here.
    """
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port: int = taken.getsockname()[1]

        def is_shown(record: logging.LogRecord) -> bool:
            return f":{port} " not in record.getMessage()

        logger = logging.getLogger(private.START_LOGGER)
        logger.addFilter(is_shown)
        try:
            with warnings.catch_warnings():
                # Ray does not close the socket of its failed attempt.
                warnings.simplefilter("ignore", ResourceWarning)
                yield port
        finally:
            logger.removeFilter(is_shown)


def _copy_logs(node: Any) -> Path:
    """Copy a node's logs to a folder of this user, since the cluster's folder is about to be
    removed.

    Return the new folder.
    """
    folder = Path(tempfile.mkdtemp(prefix="vlr-logs-"))
    # After `shutil.Error`, which is an OSError, the other files have been copied.
    with contextlib.suppress(OSError):
        shutil.copytree(node.get_logs_dir_path(), folder, dirs_exist_ok=True)
    return folder


def _daemon_error(node: Any) -> str:
    """Return the reason why a node's daemon ended, from the daemon's log; "" if the log contains
    no reason.
    """
    try:
        text = (Path(node.get_logs_dir_path()) / "raylet.err").read_text(errors="replace")
    except OSError:
        return ""
    reasons = [line.partition(_FAILED)[2] for line in text.splitlines() if _FAILED in line]
    return f"(Ray's daemon: {reasons[-1]})" if reasons else ""


def unless_lost(leave: Callable[[], None]) -> Callable[..., None]:
    """Return an exit callback for an `ExitStack` that calls `leave`, except if the head is lost,
    since `leave` would block.
    """

    def end(kind: type[BaseException] | None, *_: object) -> None:
        if kind is not ClusterLost:
            leave()

    return end


@dataclass(frozen=True, slots=True)
class LocalServer:
    """A running server on this machine, started by `vlagents-ray serve`."""

    url: str  # http(s)://host:port
    apps: tuple[str, ...]  # names of its applications, reached at serve://APP inside the cluster
    ray_address: str  # host:port of its Ray cluster
    # The path of that cluster's token, for `RAY_AUTH_TOKEN_PATH`. A process with the token can run
    # any code as this user.
    token_file: str


def join(server: str | None = None, **options: Any) -> LocalServer:
    """Connect this process to the Ray cluster of a server on this machine, instead of `ray.init`.

    The server's Ray listens on the loopback address, uses a private folder, and requires a token.
    `ray.init("auto")` finds the cluster, but connects to another address of this machine, and times
    out after minutes.

    Actors and tasks of this process then run in that cluster, with the server's Python and with the
    modules of this process's script and working directory. `RemoteAgent("serve://APP")` reaches the
    policy from this process and from each actor and task. The actors and tasks end with the server.
    `ray.shutdown()` leaves the cluster; the server continues.

    Args:
        server: The URL of the server, or the name of one of its applications; required if several
            servers run.
        options: Further options of `ray.init`, such as `log_to_driver`.

    Returns:
        The URL of the server, its applications, and the address and the token file of its Ray
        cluster.

    Raises:
        ConfigError: No server of this user is ready on this machine, or several are ready and
            `server` is None, or this process is in another Ray cluster.
    """
    import ray

    chosen = _choose(server)
    if ray.is_initialized():
        if ray.get_runtime_context().gcs_address == chosen.ray_address:
            return chosen
        raise ConfigError(
            f"expected a process in the Ray cluster of {chosen.url}, got one in another, "
            f"{ray.get_runtime_context().gcs_address}; call ray.shutdown() before, or join() in "
            "place of ray.init()"
        )
    if os.environ.get(MODE, "token").lower() != "token":
        raise ConfigError(
            f"{MODE}={os.environ[MODE]}: the Ray of {chosen.url} needs its token; unset {MODE}"
        )
    _set_variables({MODE: "token", ALONE: "0", _TOKEN: None, _TOKEN_PATH: chosen.token_file})
    private.use_loopback(True)  # Ray already read the variables when it was imported.
    private.reread_authentication()
    ray.init(chosen.ray_address, **{"log_to_driver": True, "logging_level": "WARNING"} | options)
    return chosen


def announce(url: str, apps: Mapping[str, str], ray_address: str) -> None:
    """Announce that the server of this process's Ray is ready, in a file that other programs of
    this user can find.

    `apps` contains the names of its applications, and `ray_address` is host:port of its Ray
    cluster.
    """
    folder = Path(os.environ[MARK])
    server = LocalServer(url, tuple(apps), ray_address, str(folder / _TOKEN_FILE))
    new = folder / f"{_FILE}.new"
    new.write_text(json.dumps(asdict(server)))
    new.replace(new.with_name(_FILE))


def local_servers() -> list[LocalServer]:
    """List the ready servers of this user on this machine, sorted by URL."""
    return sorted(_running_servers(), key=lambda server: server.url)


def metrics_urls() -> tuple[str, ...]:
    """Return the URLs at which the nodes of this process's cluster export their metrics."""
    import ray

    return tuple(
        f"http://{node['NodeManagerAddress']}:{node['MetricsExportPort']}/metrics"
        for node in ray.nodes()
        if node["Alive"]
    )


def cluster_id() -> str:
    """Return the id of this process's cluster: the id of its head node, which changes when the
    cluster is started again.
    """
    import ray

    heads = [node["NodeID"] for node in ray.nodes() if HEAD_NODE in node["Resources"]]
    return str(heads[0])


def _choose(url_or_app: str | None) -> LocalServer:
    """Return the server with this URL or application. With None, return the only server."""
    servers = local_servers()
    fitting = servers
    if url_or_app is not None:
        url = url_or_app.rstrip("/").replace("://localhost:", "://127.0.0.1:")
        fitting = [server for server in servers if url == server.url or url_or_app in server.apps]
    if len(fitting) == 1:
        return fitting[0]

    running = ", ".join(f"{server.url} ({', '.join(server.apps)})" for server in servers)
    if fitting:
        raise ConfigError(
            f"expected one server on this machine, got {len(fitting)}, {running}; choose one: "
            f"join('{servers[0].url}')"
        )
    if servers:
        raise ConfigError(
            f"expected the URL or an application of a server on this machine, {running}, got "
            f"{url_or_app!r}"
        )
    raise ConfigError(
        "no server of this user is ready on this machine; start one with `vlagents-ray serve "
        "POLICY`. Connect to servers of other users, or on other machines, by URL: "
        "RemoteAgent('http://HOST:8000')"
    )


def _running_servers() -> Iterator[LocalServer]:
    """Yield the servers of this user on this machine, which are found through their Ray daemons."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes().split(b"\0")
            if Path(os.fsdecode(words[0])).name != "raylet" or process.stat().st_uid != os.getuid():
                continue
            environment = {}
            for variable in (process / "environ").read_bytes().split(b"\0"):
                name, _, value = variable.partition(b"=")
                environment[os.fsdecode(name)] = os.fsdecode(value)
            content = json.loads((Path(environment[MARK]) / _FILE).read_text())
            server = LocalServer(**{**content, "apps": tuple(content["apps"])})
            address = f"--gcs-address={server.ray_address}"
        except (OSError, KeyError, ValueError, TypeError):
            # The process has ended or belongs to another user, or its server is not announced yet.
            continue
        # A killed cluster may have left its folder behind, and another cluster may use the folder
        # now.
        if any(address in os.fsdecode(word) for word in words):
            yield server
