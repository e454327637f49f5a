"""Evaluations and rollouts whose worker plays in the driver's own process: for tests of the driver without Ray."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from vlagents_ray.evaluate import run
from vlagents_ray.evaluate.workers.worker import InProcessWorkers


@contextlib.contextmanager
def without_ray(module: Any = run, pool: type[InProcessWorkers] = InProcessWorkers) -> Iterator[None]:
    """Within this the module's pool is one in this process, so that by default `evaluate` plays here."""
    before: dict[str, Any] = {name: getattr(module, name) for name in ("WorkerPool", "ray_cluster")}
    module.WorkerPool = pool
    module.ray_cluster = lambda _config: contextlib.nullcontext()
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)
