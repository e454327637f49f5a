"""A worker in the driver's own process, as a trainer's evaluations want it."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory, Recording
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.workers.agents import AgentFactory
from vlagents_ray.evaluate.workers.rollout import Report, Rollout
from vlagents_ray.evaluate.workers.worker import WorkerHandle, Workers

log = logging.getLogger(__name__)


class InProcessWorkers(Workers):
    """One worker without Ray, which plays while it is waited for. No time limit can end a simulator that hangs."""

    def __init__(
        self, config: EvalConfig, agent_factory: AgentFactory, recorder_factory: RecorderFactory = Recording
    ) -> None:
        super().__init__()
        self._make = functools.partial(Rollout, config, agent_factory, recorder_factory)
        self._rollout = self._make()

    def __exit__(self, *_: object) -> None:
        self.close()

    def free_slot(self) -> bool:
        """Return whether the worker may start; ends one of another kind that is idle."""
        for worker in self.idle():
            self._workers.remove(worker)
        return not self._workers

    def start(self, cell: EvalCase) -> None:
        """Start the worker, which is ready once it is waited for."""
        self._workers.append(WorkerHandle(cell.worker, cell.kind, actor=None, starting=self, started_at=0.0))

    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        """Let the worker play `jobs`, side by side, when it is waited for."""
        worker.jobs = jobs

    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Play the episodes that were dispatched, however long it takes, and yield their reports."""
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
        """Close the simulator and the connection; further episodes begin with new ones."""
        broken, self._rollout = self._rollout, self._make()
        try:
            broken.close()
        except VLAgentsError as error:
            log.warning("closing the env: %s", error)
