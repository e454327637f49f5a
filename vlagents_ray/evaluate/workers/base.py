"""The interface of the workers that play episodes, how jobs are dispatched to them, and when failures end a run."""

from __future__ import annotations

import contextlib
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.errors import PolicyFailed, from_code
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig, WorkerConfig
from vlagents_ray.evaluate.plan.jobs import Job, JobQueue
from vlagents_ray.evaluate.workers.rollout import Heartbeat, Report


@dataclass(slots=True, eq=False)
class WorkerHandle:
    """A worker of the pool. Times are those of `time.monotonic()`."""

    config: WorkerConfig
    kind: str  # identifies `config`
    actor: Any
    starting: Any  # ObjectRef of `ready()`; None once the worker runs
    started_at: float  # time of its start
    jobs: tuple[Job, ...] = ()  # the jobs that it plays, all of one cell
    running: Any = None  # ObjectRef of `run(jobs)`
    env_place: str | None = None  # the place of its environment
    query: Any = None  # ObjectRef of `progress()`
    queried_at: float = 0.0  # time of the last query
    heartbeat: Heartbeat = field(default_factory=lambda: Heartbeat("idle", 0.0, 0))
    heartbeat_at: float = 0.0  # time of the last answer
    process: dict[str, Any] = field(default_factory=dict)  # the answer of `ready()`
    node: str | None = None  # Ray's id of the node it runs on or, while it starts, is requested on; None: any node


class Workers(contextlib.AbstractContextManager["Workers"]):
    """The workers of an evaluation, wherever they play. Use it as a context manager, whose end ends them."""

    def __init__(self) -> None:
        self._workers: list[WorkerHandle] = []

    @property
    def busy(self) -> bool:
        return any(worker.jobs for worker in self._workers)

    def kinds(self, *, occupied: bool = True) -> Counter[str]:
        """Return the number of workers by kind; with `occupied` False, of those without jobs, which may be starting."""
        return Counter(worker.kind for worker in self._workers if occupied or not worker.jobs)

    def idle(self) -> list[WorkerHandle]:
        """Return the workers that can take a job."""
        return [worker for worker in self._workers if worker.starting is None and not worker.jobs]

    @abstractmethod
    def free_slot(self) -> bool:
        """Return whether one more worker may start; ends an idle one if there is no room."""

    @abstractmethod
    def start(self, cell: EvalCase) -> None:
        """Start one more worker that can play `cell`."""

    @abstractmethod
    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        """Play `jobs` on `worker`, side by side."""

    @abstractmethod
    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Yield the reports that arrive within `timeout_s`, also of workers that broke."""

    @abstractmethod
    def close(self) -> None:
        """Close the simulators of idle workers, as some need this for a clean exit."""


def dispatch(pool: Workers, queue: JobQueue, begin: Callable[[tuple[Job, ...]], None] = lambda _jobs: None) -> None:
    """Hand waiting jobs to idle workers, and start workers while more are needed; `begin` is called with the jobs."""
    for worker in pool.idle():
        working = Counter(one.jobs[0].cell.place for one in pool._workers if one.jobs)
        if jobs := queue.take(worker.kind, worker.env_place, working):
            begin(jobs)
            pool.dispatch(worker, jobs)
    while (cell := queue.needs_worker(pool.kinds(), pool.kinds(occupied=False))) is not None and pool.free_slot():
        pool.start(cell)


class FailedAttempts:
    """Decides whether an attempt is repeated, and when too many episodes in a row were lost."""

    def __init__(self, config: EvalConfig) -> None:
        self._config = config
        self._lost = 0  # episodes in a row
        self._policy_errors = 0  # episodes in a row

    def repeats(self, job: Job, failure: Failure) -> bool:
        """Return whether the episode of a failed attempt is to be played again."""
        return failure.cause != "user" and job.attempt <= self._config.retries

    def note_played(self) -> None:
        self._lost = self._policy_errors = 0

    def note_policy_error(self, error: str) -> None:
        """Note that an error of the policy ended an episode."""
        self._policy_errors += 1
        if self._policy_errors == self._config.abort_after:
            raise PolicyFailed(
                f"{self._policy_errors} episodes in a row ended by an error of the policy: {error.strip()}; mend the "
                f"policy and evaluate it with a new --out, or raise abort_after"
            )

    def note_lost(self, failure: Failure, cure: str) -> None:
        """Note that an episode was lost, its last attempt to `failure`.

        Raises:
            VLAgentsError: The failure, if too many episodes in a row were lost; the message ends with the `cure`.
        """
        self._lost += 1
        if self._lost == self._config.abort_after:
            raise from_code(
                failure.code, f"{self._lost} episodes in a row lost to infrastructure; {cure}: {failure.message}"
            )
