"""Workers without Ray: one, in this process; and the choice between it and Ray actors."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory, Recording
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.workers.base import VARIABLES, WorkerHandle, Workers
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Report, Rollout
from vlagents_ray.ray_tools.session import variables

log = logging.getLogger(__name__)


class InProcessWorkers(Workers):
    """One worker, which plays while it is waited for. No time limit can end a simulator that hangs."""

    def __init__(self, config: EvalConfig, agent_factory: AgentFactory, recorders: RecorderFactory = Recording) -> None:
        super().__init__()
        self._make = functools.partial(Rollout, config, agent_factory, recorders)
        self._rollout = self._make()
        self._variables = contextlib.ExitStack()

    def __exit__(self, *_: object) -> None:
        self.close()
        self._variables.close()

    def free_slot(self) -> bool:
        for worker in self.idle():
            self._workers.remove(worker)
        return not self._workers

    def start(self, cell: EvalCase) -> None:
        self._variables.enter_context(variables(cell.worker.runtime_env.get(VARIABLES) or {}))  # type: ignore[arg-type]
        self._workers.append(WorkerHandle(cell.worker, cell.kind, actor=None, starting=self, started_at=0.0))

    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        worker.jobs = jobs

    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        for worker in self._workers:
            worker.starting = None
            jobs, worker.jobs = worker.jobs, ()
            if not jobs:
                continue
            reports = self._rollout.run(jobs)
            if reports[0].env is not None:
                worker.env_place = jobs[0].cell.place
            if any(one.failure is not None and one.failure.cause == "worker" for one in reports):
                self.close()
                worker.env_place = None
            yield from zip(jobs, reports, strict=True)

    def close(self) -> None:
        broken, self._rollout = self._rollout, self._make()
        try:
            broken.close()
        except VLAgentsError as error:
            log.warning("closing the env: %s", error)


def workers_class(config: EvalConfig, stack: contextlib.ExitStack) -> Callable[..., Workers]:
    """Return the class of the workers: without Ray if `config.workers` is 0, else in a cluster that `stack` leaves."""
    if config.workers == 0:
        return InProcessWorkers
    from vlagents_ray.evaluate.workers import cluster, pool

    stack.enter_context(cluster.ray_cluster(config))
    return pool.WorkerPool
