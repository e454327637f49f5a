"""The workers that play episodes: their interface and number, and the dispatch of jobs."""

from __future__ import annotations

import contextlib
import os
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.errors import ConfigError, PolicyFailed, from_code
from vlagents_ray.evaluate.episode.episode import Phase
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases
from vlagents_ray.evaluate.plan.config import EvalConfig, WorkerConfig
from vlagents_ray.evaluate.plan.jobs import Job, JobQueue
from vlagents_ray.evaluate.workers.rollout import Heartbeat, Report
from vlagents_ray.ray_tools.private import node_of_this_process

# Planned steps up to which Ray's start, some seconds, is a large part of the time.
SHORT_STEPS = 10_000
_STEPS = 300  # of an episode, if the options of its environment name no `max_steps`
SIGNAL_S = 0.2  # the time by which a signal may reach this process later than a worker, s
VARIABLES = "env_vars"  # in Ray's runtime environment


def chosen_workers(config: EvalConfig) -> int:
    """Return `config.workers` or, if that is None, 0 for a short evaluation that needs no Ray, else
    1.

    A single worker plays one episode after another, as this process does, so that Ray adds its
    start and a message to each act. In return a simulator that crashes or hangs is replaced, which
    a long evaluation needs. Ray is also chosen if this process is in a cluster or `RAY_ADDRESS`
    names one, and for workers with a GPU.

    Raises:
        ConfigError: `config.workers` is 0, and something needs Ray.
    """
    cases = plan_cases(config)
    reasons = _reasons_for_ray(config, cases)
    if config.workers == 0 and reasons:
        raise ConfigError(
            f"workers: got 0, which plays in this process without Ray, but {reasons[0]}; want 1 or "
            "more"
        )
    if config.workers is not None:
        return config.workers

    is_in_cluster = node_of_this_process() is not None or bool(os.environ.get("RAY_ADDRESS"))
    needs_gpu = any(case.worker.gpus for case in cases)
    steps = 0
    for case in cases:
        limit = case.suite.env_options.get("max_steps")
        steps += case.planned * (limit if isinstance(limit, int) else _STEPS)
    return 1 if reasons or is_in_cluster or needs_gpu or steps > SHORT_STEPS else 0


def _reasons_for_ray(config: EvalConfig, cases: Sequence[EvalCase]) -> list[str]:
    """Return why the evaluation cannot be played without Ray, one reason an entry."""
    reasons = []
    for policy in config.policies:
        for url in (policy.url, policy.source):
            if url and url.startswith("serve://"):
                reasons.append(f"{url} is inside a Ray cluster")

    settings: set[str] = set()
    for case in cases:
        settings |= case.worker.runtime_env.keys()
    reasons += [f"a worker's runtime_env has {name!r}" for name in sorted(settings - {VARIABLES})]
    return reasons


@dataclass(slots=True, eq=False)
class WorkerHandle:
    """A worker of the pool. Times are those of `time.monotonic()`."""

    config: WorkerConfig
    kind: str  # identifies `config`
    actor: Any
    starting: Any  # ObjectRef of `ready()`; None once the worker runs
    started_at: float  # time of its start
    jobs: tuple[Job, ...] = ()  # the jobs that it plays, all of one case
    running: Any = None  # ObjectRef of `run(jobs)`
    env_place: str | None = None  # the place of its environment
    query: Any = None  # ObjectRef of `progress()`
    queried_at: float = 0.0  # time of the last query
    heartbeat: Heartbeat = field(default_factory=lambda: Heartbeat("idle", 0.0, 0))
    heartbeat_at: float = 0.0  # time of the last answer
    process: dict[str, Any] = field(default_factory=dict)  # the answer of `ready()`
    # Ray's id of the node it runs on or, while it starts, is requested on; None: any node.
    node: str | None = None


class Workers(contextlib.AbstractContextManager["Workers"]):
    """The workers of an evaluation, wherever they play. Use it as a context manager, whose end
    ends them.
    """

    def __init__(self) -> None:
        self._workers: list[WorkerHandle] = []

    @property
    def busy(self) -> bool:
        """Whether any worker plays."""
        return any(worker.jobs for worker in self._workers)

    def kinds(self, *, occupied: bool = True) -> Counter[str]:
        """Return the number of workers by kind; with `occupied` False, of those without jobs,
        which may be starting.
        """
        return Counter(worker.kind for worker in self._workers if occupied or not worker.jobs)

    def busy_places(self) -> Counter[str]:
        """Return the number of busy workers at each place."""
        return Counter(worker.jobs[0].case.place for worker in self._workers if worker.jobs)

    def idle(self) -> list[WorkerHandle]:
        """Return the workers that can take a job."""
        return [worker for worker in self._workers if worker.starting is None and not worker.jobs]

    @abstractmethod
    def free_slot(self) -> bool:
        """Return whether one more worker may start; ends an idle one if there is no room."""

    @abstractmethod
    def start(self, case: EvalCase) -> None:
        """Start one more worker that can play `case`."""

    @abstractmethod
    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        """Play `jobs` on `worker`, side by side."""

    @abstractmethod
    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Yield the reports that arrive within `timeout_s`, also of workers that broke."""

    @abstractmethod
    def close(self) -> None:
        """Close the simulators of idle workers, as some need this for a clean exit."""


def dispatch(
    pool: Workers, queue: JobQueue, begin: Callable[[tuple[Job, ...]], None] = lambda _jobs: None
) -> None:
    """Hand waiting jobs to idle workers, and start workers while more are needed; `begin` is
    called with the jobs.
    """
    for worker in pool.idle():
        jobs = queue.take(worker.kind, worker.env_place, pool.busy_places())
        if jobs:
            begin(jobs)
            pool.dispatch(worker, jobs)

    while True:
        case = queue.needs_worker(pool.kinds(), pool.kinds(occupied=False))
        if case is None or not pool.free_slot():
            return
        pool.start(case)


def phase_limits_s(config: EvalConfig) -> dict[Phase, float]:
    """Return the time limits of the phases of an episode, s; that of other phases is
    `config.env_timeout_s`.
    """
    return {
        "connect": config.connect_timeout_s + config.policy_timeout_s,
        "make": config.make_timeout_s,
        "policy reset": config.policy_timeout_s,
        "policy act": config.policy_timeout_s,
    }


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
        """Note that an episode ended without an error."""
        self._lost = self._policy_errors = 0

    def note_policy_error(self, error: str) -> None:
        """Note that an error of the policy ended an episode.

        Raises:
            PolicyFailed: Too many episodes in a row ended so.
        """
        self._policy_errors += 1
        if self._policy_errors == self._config.abort_after:
            raise PolicyFailed(
                f"{self._policy_errors} episodes in a row ended by an error of the policy: "
                f"{error.strip()}; mend the policy and evaluate it with a new --out, or raise "
                "abort_after"
            )

    def note_lost(self, failure: Failure, cure: str) -> None:
        """Note that an episode was lost, its last attempt to `failure`.

        Raises:
            VLAgentsError: The failure, if too many episodes in a row were lost; the message ends
                with the `cure`.
        """
        self._lost += 1
        if self._lost == self._config.abort_after:
            raise from_code(
                failure.code,
                f"{self._lost} episodes in a row lost to infrastructure; {cure}: {failure.message}",
            )
