"""Which node a worker is started on: that of a replica which it will use, as long as there is room."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from vlagents_ray.client.handle import ReplicaNodes


class Placement:
    """Knows where the replicas of the policies are that this cluster serves, `serve://APP`; no other's."""

    def __init__(self) -> None:
        self._replicas: dict[str, ReplicaNodes] = {}  # by application

    def node(self, url: str | None, workers: Mapping[str | None, int]) -> str | None:
        """Ray's id of the node for one more worker of the policy at `url`; None if any will do.

        `workers` says how many there are on which node: those with many replicas get many.
        """
        parts = urlsplit(url or "")
        if parts.scheme != "serve":
            return None
        replicas = self._replicas.setdefault(parts.netloc, ReplicaNodes(parts.netloc)).look()
        return fewest(replicas, workers)


def fewest(replicas: Mapping[str, int], workers: Mapping[str | None, int]) -> str | None:
    """The node where, with one more worker, there were the fewest for each replica; of equals, the first."""
    return min(replicas, key=lambda node: (workers.get(node, 0) + 1) / replicas[node], default=None)


def strategy(node: str | None) -> Any:
    """Ray's scheduling strategy for a worker that is wanted on `node`: elsewhere if that is full, or gone."""
    if node is None:
        return "SPREAD"
    return NodeAffinitySchedulingStrategy(node, soft=True, _spill_on_unavailable=True)
