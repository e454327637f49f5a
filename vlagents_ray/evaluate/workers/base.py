"""The interface of the workers that run episodes, and the state of a worker."""

from __future__ import annotations

import contextlib
import functools
from abc import abstractmethod
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory, Recording
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import WorkerConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Heartbeat, Report

SIGNAL_S = 0.2  # maximum delay, s, with which a signal reaches this process after a worker


@dataclass(slots=True, eq=False)
class WorkerHandle:
    """A worker of the pool. Times are values of `time.monotonic()`."""

    config: WorkerConfig
    kind: str  # identifies `config`
    actor: Any
    starting: Any  # ObjectRef of `ready()`; None once the worker runs
    started_at: float  # time at which the worker was started
    jobs: tuple[Job, ...] = ()  # the jobs that the worker runs, all of one case
    running: Any = None  # ObjectRef of `run(jobs)`
    env_place: str | None = None  # the place of the worker's environment
    query: Any = None  # ObjectRef of `progress()`
    queried_at: float = 0.0  # time of the last query
    heartbeat: Heartbeat = field(default_factory=lambda: Heartbeat("idle", 0.0, 0))
    heartbeat_at: float = 0.0  # time of the last answer
    process: dict[str, Any] = field(default_factory=dict)  # the result of `ready()`
    # Ray's id of the node on which the worker runs or, while it starts, is requested; None: any
    # node.
    node: str | None = None


class Workers(contextlib.AbstractContextManager["Workers"]):
    """The workers of an evaluation. Use it as a context manager; the workers end when the context
    ends.
    """

    def __init__(
        self,
        plan: ResolvedPlan,
        agent_factory: AgentFactory,
        recorders: RecorderFactory | None = None,
    ) -> None:
        """Prepare workers; each worker starts when there are jobs for it.

        Args:
            plan: The plan of the jobs.
            agent_factory: Creates a worker's agent for a case.
            recorders: Creates the recorder of an episode; None: recorders of the plan's videos and
                trajectories.
        """
        self._plan = plan
        self._agent_factory = agent_factory
        self._recorders = recorders or functools.partial(
            Recording, plan.video, plan.record, images=plan.record_images
        )
        self._workers: list[WorkerHandle] = []

    @property
    def busy(self) -> bool:
        """Whether any worker runs an episode."""
        return any(worker.jobs for worker in self._workers)

    def kinds(self, *, occupied: bool = True) -> Counter[str]:
        """Return the number of workers by kind. With `occupied` False, count only workers without
        jobs, which may still be starting.
        """
        return Counter(worker.kind for worker in self._workers if occupied or not worker.jobs)

    def busy_policies(self) -> set[str]:
        """Return the policies with whose agents workers run episodes."""
        return {worker.jobs[0].case.policy.name for worker in self._workers if worker.jobs}

    def busy_places(self) -> Counter[str]:
        """Return the number of busy workers at each place."""
        return Counter(worker.jobs[0].case.place for worker in self._workers if worker.jobs)

    def idle(self) -> list[WorkerHandle]:
        """Return the workers that can run a job."""
        return [worker for worker in self._workers if worker.starting is None and not worker.jobs]

    @abstractmethod
    def free_slot(self) -> bool:
        """Return whether one more worker may start; if there is no room, end an idle worker."""

    @abstractmethod
    def start(self, case: EvalCase) -> None:
        """Start one more worker that can run `case`."""

    @abstractmethod
    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        """Run `jobs` on `worker`, in lockstep."""

    @abstractmethod
    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Yield the reports that arrive within `timeout_s`, including the reports about workers
        that broke.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the simulators of idle workers, as some need this for a clean exit."""
