"""What a worker's process finds in its environment."""

from __future__ import annotations

import os
from typing import Any

from vlagents_ray.client.credentials import KEY_VARIABLE
from vlagents_ray.envs.graphics import GPUS
from vlagents_ray.evaluate.cells import Cell

# Pinned before any import in the worker: several workers share a machine.
THREAD_VARIABLES = (
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "OPENCV_FOR_THREADS_NUM",
    "LP_NUM_THREADS",  # llvmpipe and lavapipe, Mesa's software renderers
)


def runtime_env(cell: Cell) -> dict[str, Any]:
    """Ray's, with the thread settings of a worker's process, and without GPUs if none is set aside for it."""
    given: dict[str, Any] = dict(cell.worker.runtime_env)
    variables = dict.fromkeys(THREAD_VARIABLES, str(cell.worker.threads))
    if not cell.worker.gpus and (cell.policy.url or cell.policy.source):  # else the policy is in the worker
        variables[GPUS] = ""  # Ray hides none from whoever asked for none
    if key := os.environ.get(KEY_VARIABLE):  # for the policy's server, on nodes that do not know it
        variables[KEY_VARIABLE] = key
    return given | {"env_vars": variables | given.get("env_vars", {})}
