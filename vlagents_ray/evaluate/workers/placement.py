"""The placement of workers in the cluster, and what happens while there is no room for one."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from vlagents_ray.client.transports.serve_handle import ReplicaNodes
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.plan.config import EvalConfig, WorkerConfig

log = logging.getLogger(__name__)


class Placement:
    """Chooses the node of a worker: that of a replica which it will use, as long as there is room.

    Only the replicas of policies that this cluster serves are known, `serve://APP`.
    """

    def __init__(self) -> None:
        self._replicas: dict[str, ReplicaNodes] = {}  # nodes of the replicas, by application

    def node(self, url: str | None, workers: Mapping[str | None, int]) -> str | None:
        """Return Ray's id of the node for one more worker of the policy at `url`; None for any node.

        `workers` is the number of workers on each node: nodes with many replicas get many.
        """
        parts = urlsplit(url or "")
        if parts.scheme != "serve":
            return None
        replicas = self._replicas.setdefault(parts.netloc, ReplicaNodes(parts.netloc)).query()
        return fewest(replicas, workers)


def fewest(replicas: Mapping[str, int], workers: Mapping[str | None, int]) -> str | None:
    """Return the node with the fewest workers for each replica after one more is placed there; the first of equals."""
    return min(replicas, key=lambda node: (workers.get(node, 0) + 1) / replicas[node], default=None)


def strategy(node: str | None) -> Any:
    """Return Ray's scheduling strategy for a worker on `node`, or on another node if that one is full or gone."""
    if node is None:
        return "SPREAD"
    return NodeAffinitySchedulingStrategy(node, soft=True, _spill_on_unavailable=True)


class CapacityMonitor:
    """Decides whether an evaluation goes on while the cluster has no room for some of its workers.

    It goes on as long as other workers play: a worker's node may have been lost, and may return.
    """

    def __init__(self, config: EvalConfig, now: Callable[[], float] = monotonic) -> None:
        self._config = config
        self._now = now
        self._last_played = now()  # time at which an episode was last being played
        self._warned = False  # whether the user was warned that there is no room for all

    def note_playing(self) -> None:
        """Note that an episode is being played."""
        self._last_played = self._now()

    def note_started(self) -> None:
        """Note that a worker has started."""
        self._warned = False

    def timed_out(self, since: float) -> bool:
        """Whether a worker that was requested at `since` has waited for too long."""
        return self._now() - since > self._config.place_timeout_s

    def report_shortage(self, worker: WorkerConfig, running: int) -> None:
        """Warn that a worker has waited too long while `running` run.

        Raises `ConfigError` if no episode is played either.
        """
        idle_too_long = self.timed_out(self._last_played)
        if self._warned and not idle_too_long:
            return
        self._warned = True
        want = {"CPU": worker.cpus, "GPU": worker.gpus}
        message = (
            f"the cluster found no room for a worker in {self._config.place_timeout_s:g} s: each wants {want}, "
            f"free are {ray.available_resources()} of {ray.cluster_resources()}; lower `workers` or "
            f"`worker.cpus`, or raise `place_timeout_s` if the cluster is still growing"
        )
        if idle_too_long:
            raise ConfigError(message)
        log.warning("going on with %d of %d workers: %s", running, self._config.workers, message)
