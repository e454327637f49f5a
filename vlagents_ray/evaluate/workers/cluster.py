"""The Ray cluster that plays the episodes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from math import ceil
from typing import Any

import ray

from vlagents_ray.client.credentials import withheld
from vlagents_ray.envs.rendering.graphics import GPUS, SHARE
from vlagents_ray.evaluate.episode.records import WorkerInfo
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig, WorkerConfig
from vlagents_ray.ray_tools.session import joined

# Set before any import in the worker, since several workers share a machine.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "LP_NUM_THREADS",  # llvmpipe and lavapipe, Mesa's software renderers
)


@contextmanager
def ray_cluster(config: EvalConfig) -> Iterator[None]:
    """Join the cluster that `RAY_ADDRESS` names or start a local one, unless this process is in one; leave it after."""
    with ExitStack() as stack:
        if os.environ.get("RAY_ADDRESS"):
            stack.enter_context(joined())
        else:
            # The number of CPUs is only an account: the user's number of workers must fit.
            cpus = max(os.cpu_count() or 1, ceil(config.workers * most_cpus(config)))
            with withheld():  # workers get the key when they are ready; Ray's daemons do not need it
                stack.enter_context(joined("local", num_cpus=cpus, include_dashboard=False))
        yield


def most_cpus(config: EvalConfig) -> float:
    """The largest number of CPUs that any worker of the evaluation requests; a share of one may be requested."""
    return max(worker.cpus for worker in _kinds(config))


def most_gpus(config: EvalConfig) -> float:
    """The largest number of GPUs that any worker of the evaluation requests; a share of one may be requested."""
    return max(worker.gpus for worker in _kinds(config))


def runtime_env(cell: EvalCase) -> dict[str, Any]:
    """Return Ray's runtime environment of a worker: its thread settings, and no GPUs if it requests none.

    No secret may be in it: Ray writes runtime environments to logs that every user of a machine can read.
    """
    given: dict[str, Any] = dict(cell.worker.runtime_env)
    hides_gpus = not cell.worker.gpus and bool(
        cell.policy.url or cell.policy.source
    )  # else the policy is in the worker
    variables = worker_variables(cell.worker.threads, gpus=not hides_gpus)
    return given | {"env_vars": variables | given.get("env_vars", {})}


def worker_variables(threads: int, *, gpus: bool) -> dict[str, str]:
    """Return the environment variables of a worker.

    Args:
        threads: The number of threads of each library.
        gpus: Whether it may see GPUs: Ray does not hide them from an actor that requests none.
    """
    return dict.fromkeys(THREAD_VARIABLES, str(threads)) | ({} if gpus else {GPUS: ""})


def unused_gpus(cell: EvalCase, where: WorkerInfo) -> str | None:
    """Return a warning that the workers of `cell` render in software in a cluster with GPUs; None if they do not."""
    gpus = 0 if cell.worker.gpus else ray.cluster_resources().get("GPU", 0)
    if not gpus:
        return None
    return (
        f"{cell.env} draws on {where.renderer}, as its workers have no GPU; the cluster has {gpus:g}: {SHARE}, "
        f"see docs/cluster/placement.md"
    )


def _kinds(config: EvalConfig) -> list[WorkerConfig]:
    return [config.worker, *(suite.worker for suite in config.suites if suite.worker is not None)]
