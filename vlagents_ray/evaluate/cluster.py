"""The Ray that episodes are played in."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil
from typing import Any

import ray

from vlagents_ray.errors import ClusterLost
from vlagents_ray.evaluate.config import EvalConfig, WorkerConfig
from vlagents_ray.signals import own_sigterm


@contextmanager
def ray_cluster(config: EvalConfig) -> Iterator[None]:
    """The cluster this process is in; or one that is left, and if local shut down, at the end."""
    if ray.is_initialized():
        yield
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "WARNING"}
    if not os.environ.get("RAY_ADDRESS"):
        # Its CPUs are bookkeeping: the user's number of workers must fit.
        needed = ceil(config.workers * most_cpus(config))
        options |= {"num_cpus": max(os.cpu_count() or 1, needed), "include_dashboard": False}
    with own_sigterm():
        ray.init(**options)
    try:
        yield
    except ClusterLost:  # to take leave would wait for the head
        raise
    except BaseException:
        ray.shutdown()
        raise
    ray.shutdown()


def most_cpus(config: EvalConfig) -> float:
    """What the hungriest worker takes."""
    return max(worker.cpus for worker in _kinds(config))


def most_gpus(config: EvalConfig) -> float:
    """Likewise."""
    return max(worker.gpus for worker in _kinds(config))


def _kinds(config: EvalConfig) -> list[WorkerConfig]:
    return [config.worker, *(suite.worker for suite in config.suites if suite.worker is not None)]
