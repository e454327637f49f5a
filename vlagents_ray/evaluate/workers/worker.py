"""Workers of an evaluation: their interface, their jobs, and a worker in this process."""

from __future__ import annotations

import functools
import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from typing_extensions import Self

from vlagents_ray.errors import PolicyFailed, VLAgentsError, from_code
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory, Recording
from vlagents_ray.evaluate.episode.episode import Phase
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig, WorkerConfig
from vlagents_ray.evaluate.plan.jobs import Job, JobQueue
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Heartbeat, Report, Rollout

WATCH_S = 1.0  # s between two queries of a busy worker
GRACE_S = 5.0  # s that a call past its deadline has to fail by itself
log = logging.getLogger(__name__)


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

    @property
    def refs(self) -> list[Any]:
        return [ref for ref in (self.starting, self.running, self.query) if ref is not None]

    def query_is_due(self, now: float) -> bool:
        return self.query is None and now - self.queried_at > WATCH_S


class Workers(ABC):
    """The workers of an evaluation, wherever they play. Use it as a context manager, whose end ends them."""

    def __init__(self) -> None:
        self._workers: list[WorkerHandle] = []

    @property
    def busy(self) -> bool:
        return any(worker.jobs for worker in self._workers)

    def working(self) -> Counter[str]:
        return Counter(worker.jobs[0].cell.place for worker in self._workers if worker.jobs)

    def kinds(self) -> Counter[str]:
        return Counter(worker.kind for worker in self._workers)

    def unoccupied(self) -> Counter[str]:
        """Return the number of workers without jobs by kind; some may still be starting."""
        return Counter(worker.kind for worker in self._workers if not worker.jobs)

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

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None: ...


class PhaseTimeouts:
    """The time limits of the phases of an episode."""

    def __init__(self, config: EvalConfig) -> None:
        self._env_s = config.env_timeout_s
        self._limit_s: dict[Phase, float] = {
            "connect": config.connect_timeout_s + config.policy_timeout_s,
            "make": config.make_timeout_s,
            "env reset": config.env_timeout_s,
            "env step": config.env_timeout_s,
            "policy reset": config.policy_timeout_s,
            "policy act": config.policy_timeout_s,
        }

    def overdue(self, worker: WorkerHandle, now: float) -> str | None:
        """Return why the busy `worker` must be replaced; None if it need not be."""
        heartbeat = worker.heartbeat
        limit_s = self._limit_s.get(heartbeat.phase, self._env_s)
        if heartbeat.age_s > limit_s + GRACE_S:
            return (
                f"{heartbeat.phase} after {heartbeat.steps} steps took longer than {limit_s:g} s; the worker was killed"
            )
        # A simulator that hangs in C code holds the interpreter's lock, so that no call is answered.
        silent_s = now - worker.heartbeat_at
        if silent_s > max(limit_s, self._env_s) + GRACE_S + WATCH_S:
            return f"no sign of life for {silent_s:.0f} s, last seen in {heartbeat.phase}; the worker was killed"
        return None


def dispatch(pool: Workers, queue: JobQueue, begin: Callable[[tuple[Job, ...]], None] = lambda _jobs: None) -> None:
    """Hand waiting jobs to idle workers, and start workers while more are needed; `begin` is called with the jobs."""
    for worker in pool.idle():
        if jobs := queue.take(worker.kind, worker.env_place, pool.working()):
            begin(jobs)
            pool.dispatch(worker, jobs)
    while (cell := queue.needs_worker(pool.kinds(), pool.unoccupied())) is not None and pool.free_slot():
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


class InProcessWorkers(Workers):
    """One worker without Ray, which plays while it is waited for. No time limit can end a simulator that hangs."""

    def __init__(self, config: EvalConfig, agent_factory: AgentFactory, recorders: RecorderFactory = Recording) -> None:
        super().__init__()
        self._make = functools.partial(Rollout, config, agent_factory, recorders)
        self._rollout = self._make()

    def __exit__(self, *_: object) -> None:
        self.close()

    def free_slot(self) -> bool:
        for worker in self.idle():
            self._workers.remove(worker)
        return not self._workers

    def start(self, cell: EvalCase) -> None:
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
