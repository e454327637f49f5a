"""A pool of one worker that plays in the driver's own process: for tests of the driver that need no Ray."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from vlagents_ray.evaluate import run
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory, Recording
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.workers.agents import AgentFactory
from vlagents_ray.evaluate.workers.pool import WorkerPool
from vlagents_ray.evaluate.workers.rollout import Report, Rollout
from vlagents_ray.evaluate.workers.worker import WorkerHandle


@contextlib.contextmanager
def without_ray(module: Any = run, pool: type[WorkerPool] | None = None) -> Iterator[None]:
    """Within this the module's pool is one in this process, so that by default `evaluate` plays here."""
    before: dict[str, Any] = {name: getattr(module, name) for name in ("WorkerPool", "ray_cluster")}
    module.WorkerPool = pool or InProcessPool
    module.ray_cluster = lambda _config: contextlib.nullcontext()
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)


class InProcessPool(WorkerPool):
    """Its one worker is no actor, and starts and ends at once."""

    def __init__(self, config: EvalConfig, factory: AgentFactory, recorders: RecorderFactory = Recording) -> None:
        self._rollout = Rollout(config, factory, recorders)
        self._workers: list[WorkerHandle] = []

    def __exit__(self, *_: object) -> None:
        self._rollout.close()

    def free_slot(self) -> bool:
        return not self._workers

    def start(self, cell: EvalCase) -> None:
        self._workers.append(WorkerHandle(cell.worker, cell.kind, actor=None, starting=None, started_at=0.0))

    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        worker.jobs = jobs

    def wait(self, _timeout_s: float) -> Iterator[tuple[Job, Report]]:
        for worker in self._workers:
            jobs, worker.jobs = worker.jobs, ()
            if jobs:
                yield from zip(jobs, self._rollout.run(jobs), strict=True)

    def close(self) -> None:
        """Nothing is left running."""
