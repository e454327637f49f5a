"""The Ray that episodes are played in."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from math import ceil

from vlagents_ray.evaluate.config import EvalConfig, WorkerConfig
from vlagents_ray.joining import joined


def ray_cluster(config: EvalConfig) -> AbstractContextManager[None]:
    """The cluster this process is in; or one that is left, and if local shut down, at the end."""
    if os.environ.get("RAY_ADDRESS"):
        return joined()
    # Its CPUs are bookkeeping: the user's number of workers must fit.
    needed = ceil(config.workers * most_cpus(config))
    return joined("local", num_cpus=max(os.cpu_count() or 1, needed), include_dashboard=False)


def most_cpus(config: EvalConfig) -> float:
    """What the hungriest worker takes."""
    return max(worker.cpus for worker in _kinds(config))


def most_gpus(config: EvalConfig) -> float:
    """Likewise."""
    return max(worker.gpus for worker in _kinds(config))


def _kinds(config: EvalConfig) -> list[WorkerConfig]:
    return [config.worker, *(suite.worker for suite in config.suites if suite.worker is not None)]
