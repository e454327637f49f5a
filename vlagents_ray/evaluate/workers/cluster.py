"""The Ray cluster of an evaluation: resources, placement and logs of the workers."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from math import ceil
from pathlib import Path
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

import ray
from ray.exceptions import GetTimeoutError, RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from vlagents_ray.client.credentials import withheld
from vlagents_ray.client.transports.serve_handle import ReplicaNodes
from vlagents_ray.envs.graphics import GPUS, SHARE
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.episode.records import WorkerInfo
from vlagents_ray.evaluate.plan.cases import EvalCase, most_cpus
from vlagents_ray.evaluate.plan.config import WorkerConfig
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.workers.rollout import THREAD_VARIABLES
from vlagents_ray.ray_tools.session import joined

log = logging.getLogger(__name__)
MOST_BYTES = 64_000  # maximum total size of a kept log, bytes
TIMEOUT_S = 5.0  # s, time limit for reading a log on another node


@contextmanager
def ray_cluster(plan: ResolvedPlan) -> Iterator[None]:
    """Join the cluster at `RAY_ADDRESS` or start a local cluster, unless this process is in a
    cluster; leave the cluster when the context ends.
    """
    with ExitStack() as stack:
        if os.environ.get("RAY_ADDRESS"):
            stack.enter_context(joined())
        else:
            # The number of CPUs is logical: the user's number of workers must fit.
            needed_cpus = ceil(max(1, plan.workers) * most_cpus(plan.cases))
            cpus = max(os.cpu_count() or 1, needed_cpus)
            # Workers receive the API key when they are ready; Ray's daemons must not have it.
            with withheld():
                stack.enter_context(joined("local", num_cpus=cpus))
        yield


def runtime_env(case: EvalCase) -> dict[str, Any]:
    """Return Ray's runtime environment of a worker: the thread settings, and no visible GPUs if the
    worker requests none.

    It must not contain secrets: Ray writes runtime environments to logs that every user of a
    machine can read.
    """
    configured: dict[str, Any] = dict(case.worker.runtime_env)
    variables = dict.fromkeys(THREAD_VARIABLES, str(case.worker.threads))
    # Ray does not hide GPUs from an actor that requests no GPU, so hide them here. But a policy in
    # the worker may need the GPUs.
    is_served = bool(case.policy.url or case.policy.source)
    if not case.worker.gpus and is_served:
        variables[GPUS] = ""
    return configured | {"env_vars": variables | configured.get("env_vars", {})}


def unused_gpus(case: EvalCase, worker: WorkerInfo) -> str | None:
    """Return a warning if the workers of `case` render in software although the cluster has GPUs;
    otherwise None.
    """
    gpus = 0 if case.worker.gpus else ray.cluster_resources().get("GPU", 0)
    if not gpus:
        return None
    return (
        f"{case.env} renders on {worker.renderer}, as its workers have no GPU; the cluster has "
        f"{gpus:g}: {SHARE}, see docs/cluster/scaling.md"
    )


class Placement:
    """Chooses the node of a worker: a node with a replica of its policy, as long as there is
    room.

    Replicas are known only for policies that this cluster serves, at `serve://APP`.
    """

    def __init__(self) -> None:
        # Number of replicas on each node, by application.
        self._replicas: dict[str, ReplicaNodes] = {}

    def node(self, url: str | None, workers: Mapping[str | None, int]) -> str | None:
        """Return Ray's id of the node for one more worker of the policy at `url`; None for any
        node.

        `workers` contains the number of workers on each node: nodes with more replicas get more
        workers.
        """
        parts = urlsplit(url or "")
        if parts.scheme != "serve":
            return None
        replicas = self._replicas.setdefault(parts.netloc, ReplicaNodes(parts.netloc)).query()
        return fewest(replicas, workers)


def fewest(replicas: Mapping[str, int], workers: Mapping[str | None, int]) -> str | None:
    """Return the node that would have the fewest workers per replica after one more worker; among
    equal nodes, the first.
    """
    return min(replicas, key=lambda node: (workers.get(node, 0) + 1) / replicas[node], default=None)


def strategy(node: str | None) -> Any:
    """Return Ray's scheduling strategy for a worker on `node`, or on another node if `node` is full
    or gone.
    """
    if node is None:
        return "SPREAD"
    return NodeAffinitySchedulingStrategy(node, soft=True, _spill_on_unavailable=True)


class CapacityMonitor:
    """Decides whether an evaluation continues while the cluster has no room for some of its
    workers.

    The evaluation continues as long as other workers run: the node of a missing worker may have
    been lost, and may return.
    """

    def __init__(self, workers: int, place_s: float, now: Callable[[], float] = monotonic) -> None:
        """Create the monitor.

        Args:
            workers: The number of workers of the plan.
            place_s: The time limit until the cluster has resources for a worker, s.
            now: A clock, in s.
        """
        self._workers = workers
        self._place_s = place_s
        self._now = now
        self._last_played = now()  # time at which an episode last ran
        self._warned = False  # whether the user was warned that there is no room for all workers

    def note_playing(self) -> None:
        """Record that an episode runs."""
        self._last_played = self._now()

    def note_started(self) -> None:
        """Record that a worker has started, so that a later shortage is reported again."""
        self._warned = False

    def timed_out(self, since: float) -> bool:
        """Return whether a worker that was requested at `since` has waited for too long."""
        return self._now() - since > self._place_s

    def report_shortage(self, worker: WorkerConfig, running: int) -> None:
        """Warn that a worker has waited too long while `running` workers run.

        Raises `ConfigError` if no episode runs either.
        """
        idle_too_long = self.timed_out(self._last_played)
        if self._warned and not idle_too_long:
            return
        self._warned = True
        needed = {"CPU": worker.cpus, "GPU": worker.gpus}
        message = (
            f"expected {needed} for each worker within {self._place_s:g} s, got "
            f"{ray.available_resources()} free of {ray.cluster_resources()}; lower `workers` or "
            "`worker.cpus`, or raise `place_timeout_s` if the cluster is still growing"
        )
        if idle_too_long:
            raise ConfigError(message)
        log.warning("continuing with %d of %d workers: %s", running, self._workers, message)


def tail(paths: Sequence[str]) -> str:
    """Return the end of each existing file, below the name of the file."""
    ends = []
    for path in paths:
        with contextlib.suppress(OSError), open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            file.seek(max(0, size - MOST_BYTES // len(paths)))
            text = file.read().decode(errors="replace").strip()
            ends.append(f"== {Path(path).name}\n{text}")
    return "\n".join(ends)


def tail_at(host: str, paths: Sequence[str]) -> str:
    """Return `tail` of files on another host of the cluster; "" if the host is lost."""
    if host == socket.gethostname():
        return tail(paths)

    node_ids = []
    for node in ray.nodes():
        if node["Alive"] and node["NodeManagerHostname"] == host:
            node_ids.append(node["NodeID"])
    if not node_ids:
        return ""

    on_that_host = NodeAffinitySchedulingStrategy(node_ids[0], soft=False)
    read = ray.remote(tail).options(num_cpus=0, scheduling_strategy=on_that_host)
    try:
        return str(ray.get(read.remote(list(paths)), timeout=TIMEOUT_S))
    except GetTimeoutError:
        raise TimeoutError(f"host {host} did not answer within {TIMEOUT_S:g} s") from None
    except RayError:  # the node is gone, with its files
        return ""
