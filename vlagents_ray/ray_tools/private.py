"""The adapter to Ray and Ray Serve: all of their private names that this package uses.

`USES` lists the names, and the consequence if a version of Ray lacks them. `check_ray` reports
missing names when a server starts. `make rays` tests the versions of `TRIED`; test a new version
before you add it. Ray is imported inside the functions, since clients without Ray import this
module. Only `vlagents_ray.serve.scaling.router` uses a private method of Serve directly, since
Serve sends that module by value to processes that may lack this package.
"""

from __future__ import annotations

import importlib
import inspect
import logging
import os
import pickle
import re
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from vlagents_ray.errors import ConfigError

log = logging.getLogger(__name__)

# The loggers of Ray and Serve in the process that started them.
LOGGERS = (
    "ray.serve",
    "ray._private.worker",
    "ray._private.authentication.authentication_token_setup",
)
START_LOGGER = "ray._private.services"  # logs the start of Ray's processes

# The oldest and the newest minor version of Ray that were tested.
TRIED = ((2, 60), (2, 60))


@dataclass(frozen=True, slots=True)
class Use:
    """Private names of Ray that one ability needs."""

    consequence: str  # effect if one of the names is missing
    names: tuple[str, ...]  # dotted names; methods are called through handles of the actors
    is_required: bool = True  # if False, a server starts without the ability


_REPLICA = "ray.serve._private.replica.ReplicaActor"
_CONTROLLER = "ray.serve._private.controller.ServeController"
_ROUTER = "ray.serve.experimental.consistent_hash_router.ConsistentHashRouter"
_CHANNEL = "ray._raylet.CoreWorker.experimental_channel"
USES = (
    Use(
        "Ray cannot be started on this machine",
        ("ray._private.node.Node", "ray._private.parameter.RayParams"),
    ),
    Use(
        "a server's Ray would listen on all addresses of this machine",
        ("ray._private.ray_constants.ENABLE_RAY_CLUSTER",),
    ),
    Use(
        "a server's Ray cannot require a token",
        ("ray._raylet.AuthenticationTokenLoader.instance", "ray._raylet.Config.initialize"),
    ),
    Use("the connection to Ray cannot be read", ("ray._private.worker.global_worker",)),
    Use(
        "GPUs cannot be counted",
        ("ray._private.accelerators.get_accelerator_manager_for_resource",),
    ),
    Use(
        "Serve cannot be started and ended",
        (
            "ray.serve.context._get_global_client",
            "ray.serve.context._set_global_client",
            f"{_CONTROLLER}.delete_apps",
            f"{_CONTROLLER}.get_proxies",
            f"{_CONTROLLER}.graceful_shutdown",
            f"{_CONTROLLER}.list_serve_statuses",
        ),
    ),
    Use(
        "clients at serve://APP, and replicas that exchange sessions, reach no replica",
        (
            "ray.serve._private.common.RequestMetadata",
            f"{_REPLICA}.get_num_ongoing_requests",
            f"{_REPLICA}.handle_request",
            f"{_REPLICA}.was_initialized",
        ),
    ),
    Use(
        "processes on the node of a replica use the slower Serve handle in place of plasma",
        (
            "ray._raylet.Pickle5SerializedObject",
            "ray._raylet.Pickle5Writer",
            "ray._raylet.unpack_pickle5_buffers",
            f"{_CHANNEL}_put_serialized",
            f"{_CHANNEL}_register_reader",
            f"{_CHANNEL}_register_writer",
        ),
        is_required=False,
    ),
    Use(
        "an evaluation without a server or a cluster may wait ten minutes for `ray start`",
        ("ray._private.utils.read_ray_address",),
        is_required=False,
    ),
    Use(
        "a server starts a few seconds later, as its proxies start before its policies",
        ("ray.serve._private.api._create_controller_and_proxy_refs",),
        is_required=False,
    ),
    Use(
        "Ray prints calls that were lost when a server ended",
        (
            "ray._private.ray_logging.stdout_deduplicator.skip_re",
            "ray.serve._private.router.SharedRouterLongPollClient.get_or_create",
        ),
        is_required=False,
    ),
    Use(
        "without HAProxy, a request waits for as long as an application has no replica",
        (f"{_ROUTER}._choose_replica_for_request",),
        is_required=False,
    ),
)


def requirement() -> str:
    """Return the version requirement for the tested versions, as in `pyproject.toml`."""
    (major, oldest), (_, newest) = TRIED
    return f"ray[serve]>={major}.{oldest},<{major}.{newest + 1}"


def check_ray() -> None:
    """Check that the installed Ray has the private names that are used, and log the effects of
    missing names.

    This function is called when a server starts. For a tested version, the log message has the
    level INFO.

    Raises:
        ConfigError: Ray lacks a name that a server requires.
    """
    import ray

    is_tried = was_tried(ray.__version__)
    cure = f"install a version that was tried: pip install '{requirement()}'"
    problems: list[str] = []
    is_usable = True
    for use in USES:
        lacking = [name for name in use.names if first_missing(name) is not None]
        if lacking:
            problems.append(f"without {', '.join(lacking)}: {use.consequence}")
            is_usable = is_usable and not use.is_required
    if not is_usable:
        raise ConfigError(
            f"Ray {ray.__version__} lacks private names that this package uses: "
            f"{'; '.join(problems)}; {cure}"
        )
    if problems:
        log.log(
            logging.INFO if is_tried else logging.WARNING,
            "Ray %s lacks private names that this package uses: %s; %s",
            ray.__version__,
            "; ".join(problems),
            "this version was tried" if is_tried else cure,
        )
    elif not is_tried:
        log.warning(
            "Ray %s has all private names that this package uses, but was not tried, so that they "
            "may do something else; if something fails, %s",
            ray.__version__,
            cure,
        )


def was_tried(version: str) -> bool:
    """Return whether this version of Ray, such as "2.60.0", is one of the tested versions."""
    numbers = re.match(r"(\d+)\.(\d+)", version)
    if numbers is None:
        return False
    oldest, newest = TRIED
    return oldest <= (int(numbers[1]), int(numbers[2])) <= newest


def first_missing(name: str) -> str | None:
    """Return the first part of a dotted name that the installed Ray lacks; None if it has all.

    Attributes of objects that only exist while Ray runs are not checked.
    """
    parts = name.split(".")
    value: Any = importlib.import_module(parts[0])
    for end, part in enumerate(parts[1:], start=2):
        try:
            value = getattr(value, part)
        except AttributeError:
            try:
                value = importlib.import_module(".".join(parts[:end]))
            except ImportError:
                is_complete = isinstance(value, type | ModuleType)
                return ".".join(parts[:end]) if is_complete else None
    return None


def has_channels() -> bool:
    """Return whether this Ray has the channels of the plasma transport."""
    [names] = [use.names for use in USES if f"{_CHANNEL}_put_serialized" in use.names]
    return all(first_missing(name) is None for name in names)


# The connection of this process.


def node_of_this_process() -> Any:
    """Return Ray's record of the local daemons; None if this process is not connected, or has not
    imported Ray.

    The record contains data that no public function returns: the daemons' sockets, their log
    folder, and whether this process started them. The record exists before the connection does. In
    between, a call of Ray from another thread would start a second cluster.
    """
    worker: Any = sys.modules.get("ray._private.worker")
    if worker is None or not worker.global_worker.connected:
        return None
    return worker.global_worker.node


def use_loopback(on: bool) -> bool:
    """Set whether Ray assumes a single-node cluster, and uses loopback addresses unchanged.

    Ray reads this setting from `RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER` when it is imported.

    Returns:
        The previous setting.
    """
    from ray._private import ray_constants

    before = not ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = not on
    return before


def reread_authentication() -> None:
    """Make Ray read `RAY_AUTH_MODE` and the token again.

    Ray reads the mode when it is imported, and the token when it is first needed.
    """
    import ray

    ray._raylet.Config.initialize("")
    ray._raylet.AuthenticationTokenLoader.instance().reset_cache()


def address_of_ray_start() -> str | None:
    """Return the address of the cluster that `ray start` started last on this machine; None if
    there is none.

    `ray.init("auto")` would report a missing cluster only after ten minutes.
    """
    try:
        from ray._private.utils import read_ray_address
    except ImportError:
        return None
    address: str | None = read_ray_address()
    return address


# The start of a cluster.


def start_head(temp_dir: str, dashboard_port: int, **params: Any) -> Any:
    """Start the daemons of a one-machine cluster that requires the token of `RAY_AUTH_TOKEN_PATH`.

    `ray.init("local")` does the same, but always with an autoscaler and a log monitor, which one
    machine does not need (90 MB, 1 s), and with an agent at a fixed port, whose start takes 3 s
    longer while another Ray uses that port.

    Args:
        dashboard_port: The port of the dashboard, which is not served.
        params: Resources and further parameters of Ray's nodes: `num_cpus`, `num_gpus`,
            `resources`, ...

    Returns:
        Ray's record of the daemons.
    """
    from ray._private.node import Node
    from ray._private.parameter import RayParams

    os.environ.setdefault("RAY_AUTH_MODE", "token")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    reread_authentication()
    ray_params = RayParams(
        temp_dir=temp_dir,
        include_dashboard=False,
        dashboard_host="127.0.0.1",
        dashboard_port=dashboard_port,
        dashboard_agent_listen_port=0,  # any free port
        include_log_monitor=False,
        no_monitor=True,
        **params,
    )
    # `ray_init_cluster` means that a driver, not `ray start`, starts the cluster, so that no other
    # process joins it by default.
    return Node(
        ray_params, head=True, shutdown_at_exit=False, spawn_reaper=True, ray_init_cluster=True
    )


def node_that_failed(error: BaseException) -> Any:
    """Return the node that was being started when `error` was raised; None if there was none.

    The node's processes continue to run, and the error does not name them.
    """
    from ray._private.node import Node

    for frame, _ in traceback.walk_tb(error.__traceback__):
        node = frame.f_locals.get("self")
        if isinstance(node, Node):
            return node
    return None


def gpus_here() -> float:
    """Count the GPUs that Ray would offer on this machine, without starting Ray and without
    torch.
    """
    from ray._private.accelerators import get_accelerator_manager_for_resource

    manager = get_accelerator_manager_for_resource("GPU")
    if manager is None:
        return 0.0
    number = manager.get_current_node_num_accelerators()
    # CUDA_VISIBLE_DEVICES and similar variables contain the visible GPUs.
    visible = manager.get_current_process_visible_accelerator_ids()
    return float(number if visible is None else min(number, len(visible)))


# Channels: mutable objects in plasma, on which Ray's `Channel` is built.


def _worker() -> Any:
    import ray

    return ray._private.worker.global_worker


def plasma_folder() -> Path:
    """Return the folder of the socket of this node's object store."""
    return Path(_worker().node.plasma_store_socket_name).parent


def create_channel(size: int) -> Any:
    """Create a channel of `size` bytes that this process reads, and return its ref."""
    worker = _worker()
    ref = worker.put_object(bytes(size), _is_experimental_channel=True)
    worker.core_worker.experimental_channel_register_reader(ref)
    return ref


def register_writer(channel: Any) -> None:
    """Register this process as the writer of a channel.

    Ray's `Channel` can do this only in combination with pickling.
    """
    _worker().core_worker.experimental_channel_register_writer(channel, {})


def write_channel(channel: Any, content: Any, wait_ms: int) -> str | None:
    """Write the content to a channel; return the reason if writing is impossible, otherwise None.

    An exception raised here would keep the channel's memory as long as its traceback is referenced.
    """
    import ray

    try:
        _worker().core_worker.experimental_channel_put_serialized(content, channel, 1, wait_ms)
    except ray.exceptions.RayChannelError as error:
        return str(error)
    return None


def read_channel(channel: Any) -> Any:
    """Return the newest content, with `metadata` and `data`, without a copy.

    It is valid while it is referenced.

    Raises:
        ray.exceptions.RayChannelTimeoutError: Nothing was written since the last call.
    """
    return _worker().core_worker.get_objects([channel], 0)[0]


def channel_content(tag: bytes, pieces: Iterable[memoryview]) -> Any:
    """Return pieces of memory in a form that Ray copies directly into a channel, one after the
    other.

    This uses Ray's writer of out-of-band buffers, without in-band pickled data.
    """
    import ray

    writer = ray._raylet.Pickle5Writer()
    for piece in pieces:
        writer.buffer_callback(pickle.PickleBuffer(piece))
    return ray._raylet.Pickle5SerializedObject(tag, b"", writer, [])


def channel_pieces(data: Any) -> Any:
    """Return the pieces in the data of a channel, without a copy and without unpickling.

    Ray's parser does not validate the data.
    """
    import ray

    _, pieces = ray._raylet.unpack_pickle5_buffers(data)
    return pieces


# Ray Serve.


def start_serve(http: dict[str, Any], location: str) -> tuple[Any, list[Any]]:
    """Return Serve's client and the refs of its proxies, like `serve.start`, but without waiting
    for the proxies.

    The proxies then start while a policy is built and loaded. Ray 2.56 waits for them.
    """
    from ray import serve
    from ray.serve._private import api
    from ray.serve.config import ControllerOptions
    from ray.serve.context import _get_global_client

    is_running = _get_global_client(raise_if_no_controller_running=False) is not None
    if is_running or not hasattr(api, "_create_controller_and_proxy_refs"):
        serve.start(http_options=http, proxy_location=location)
        return _get_global_client(), []

    create = api._create_controller_and_proxy_refs
    arguments = {
        "http_options": http,
        "controller_options": ControllerOptions(),
        "proxy_location": location,
    }
    for name, parameter in inspect.signature(create).parameters.items():
        if parameter.kind is parameter.POSITIONAL_OR_KEYWORD:  # some exist since Ray 2.59
            arguments.setdefault(name, None)
    _, proxies = create(**arguments)
    return _get_global_client(), proxies


def serve_client() -> Any:
    """Return the client of the Serve that this process has started or joined."""
    from ray.serve.context import _get_global_client

    return _get_global_client()


def proxies_now(client: Any) -> list[Any]:
    """Return the refs of Serve's current proxies, which may have replaced the proxies from
    `start_serve`.

    `serve.status` reports that a proxy failed, but not the reason.
    """
    import ray

    handles = ray.get(client._controller.get_proxies.remote())
    return [handle.ready.remote() for handle in handles.values()]


def long_polls(client: Any) -> Iterator[Any]:
    """Yield the long polls that the handles of Serve's client have open at the controller.

    Each has a method `stop`.

    `serve.shutdown` leaves them open, and Ray would report them as failed tasks.
    """
    try:
        from ray.serve._private.router import SharedRouterLongPollClient
    except ImportError:
        return
    for handle in client.handle_cache.values():
        router = getattr(handle._router, "_asyncio_router", None)
        if router is not None:
            yield router.long_poll_client
            shared = SharedRouterLongPollClient.get_or_create(
                client._controller, router._event_loop
            )
            yield shared.long_poll_client


def begin_to_end(client: Any, names: Sequence[str]) -> Any:
    """Begin to end applications, without waiting; return the ref of the call.

    `serve.delete` would wait for each application, for at most a minute.
    """
    return client._controller.delete_apps.remote(list(names))


def list_applications(client: Any) -> Any:
    """Return the ref of the list of all applications.

    `serve.status` would wait for the list without a time limit.
    """
    return client._controller.list_serve_statuses.remote()


def silence_lost_polls() -> None:
    """Make Ray drop its message that a long poll was lost together with Serve's controller.

    On a busy machine, a proxy may end a moment after the controller. Ray then prints in this
    process that the proxy's poll failed and will be retried.
    """
    try:
        from ray._private.ray_logging import stdout_deduplicator
    except ImportError:
        return
    message = r"Task ServeController\.listen_for_change failed"
    skipped = stdout_deduplicator.skip_re
    if skipped is None:
        stdout_deduplicator.skip_re = re.compile(message)
    elif message not in skipped.pattern:  # the pattern that RAY_DEDUP_LOGS_SKIP_REGEX sets
        stdout_deduplicator.skip_re = re.compile(f"{skipped.pattern}|{message}")


def end_controller(client: Any) -> Any:
    """Begin to shut Serve down, and return the ref of the call.

    The call fails because it ends the controller.
    """
    return client._controller.graceful_shutdown.options(max_task_retries=0).remote()


def forget_serve(client: Any) -> None:
    """Clear this process's reference to Serve, after `end_controller`."""
    from ray.serve.context import _set_global_client

    client._shutdown = True
    _set_global_client(None)


def http_options() -> Any:
    """Return Serve's HTTP options: `host`, `port`, `ssl_certfile`, ... `serve.status` does not
    contain them.
    """
    from ray.serve.context import _get_global_client

    return _get_global_client().http_config


def replica_is_ending() -> bool:
    """Return whether Serve has begun to stop the replica in this process; Serve has no public
    hook for that.
    """
    worker = _worker()
    return bool(worker.actors.get(worker.actor_id)._replica_impl._shutting_down)


def check_replica() -> None:
    """Check that `replica_is_ending` works in this process, which is the process of a replica.

    Raises:
        ConfigError: Serve's replica lacks an attribute that is read.
    """
    import ray

    try:
        replica_is_ending()
    except AttributeError as error:
        raise ConfigError(
            f"Ray {ray.__version__} lacks private names that this package uses: {error}: a replica "
            "that is stopped would drop its sessions; install a version that was tried: pip "
            f"install '{requirement()}'"
        ) from error


def replica_is_initialized(replica: Any) -> Any:
    """Ask a replica's actor whether it has created its callable, and return the ref of the
    answer.
    """
    return replica.was_initialized.remote()


def ping_replica(replica: Any) -> Any:
    """Call a method of a replica's actor that is answered even while the policy is busy, as Serve's
    own router does.

    Return the ref of the answer.
    """
    return replica.get_num_ongoing_requests.remote()


def replica_request(request_id: str, method: str) -> bytes:
    """Return the header with which Serve's own router calls a method of a replica's actor."""
    from ray.serve._private.common import RequestMetadata

    return pickle.dumps(
        RequestMetadata(request_id=request_id, internal_request_id=request_id, call_method=method)
    )
