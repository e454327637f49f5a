"""The driver of evaluations and of rollouts: it assigns the jobs of a plan to workers, repeats
attempts that failed because of infrastructure, and ends the run when too many episodes in a row are
lost.

A policy in a sweep over checkpoints has one checkpoint at a time. All episodes of a checkpoint end
before the policy's server loads the next one, so that no episode acts with two.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Protocol

from vlagents_ray.errors import PolicyFailed, from_code
from vlagents_ray.evaluate.artifacts.recorder import Artifacts
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job, JobQueue
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.workers.base import Workers
from vlagents_ray.evaluate.workers.rollout import Report


class Consumer(ABC):
    """Receives the results of a driver's episodes, e.g. to write them to disk or to return them to
    a learner.
    """

    # The cures in the errors that end a run: after many policy errors in a row, and after many lost
    # episodes in a row.
    policy_cure: str
    loss_cure: str

    @abstractmethod
    def began(self, jobs: tuple[Job, ...]) -> None:
        """Called when a worker begins these jobs."""

    @abstractmethod
    def described(self, job: Job, report: Report) -> None:
        """Called with each report, which may describe a new policy, environment or worker."""

    def is_needed(self, job: Job) -> bool:
        """Return whether a failed attempt at this episode may be repeated."""
        return True

    @abstractmethod
    def attempt_failed(self, job: Job, failure: Failure, *, repeated: bool) -> None:
        """Called when an attempt has failed because of infrastructure; `repeated`: whether another
        attempt follows.
        """

    @abstractmethod
    def finished(self, job: Job, result: EpisodeResult, artifacts: Artifacts) -> None:
        """Called with the final result of an episode. The status of a lost episode is
        "infra_failed".
        """


class CheckpointSwaps(Protocol):
    """The servers of the policies in a sweep over checkpoints. No method waits."""

    def begin(self, policy: str, step: int) -> None:
        """Begin to load the checkpoint of a training step in place of the present one; the server
        may have it already.
        """

    def is_done(self, policy: str) -> bool:
        """Return whether the policy acts with the checkpoint of the last call of `begin`.

        Raises:
            VLAgentsError: The checkpoint cannot be loaded, or not within a time limit.
        """


@dataclass(slots=True)
class _Sweep:
    """The jobs of a policy whose checkpoints are not loaded yet."""

    policy: str
    server: CheckpointSwaps | None  # None if the workers create agents with the checkpoints
    later: dict[int, list[Job]] = field(default_factory=dict)  # by step, in the order of the plan
    swapping_to: int | None = None  # the step that the server is loading


class Driver:
    """Assigns the unfinished jobs of a plan to workers, and handles their reports.

    The driver has no thread and no loop: its owner calls `hand_out`, waits for the workers'
    reports, and passes each report to `take`.
    """

    def __init__(
        self,
        plan: ResolvedPlan,
        jobs: Iterable[Job],
        consumer: Consumer,
        swaps: CheckpointSwaps | None = None,
    ) -> None:
        """Queue the jobs.

        Args:
            plan: The plan of the jobs.
            jobs: The jobs; within each environment, they begin in this order.
            consumer: Receives the results.
            swaps: Loads the checkpoints of the policies with a `url` into their servers. Workers
                create the agents of other policies with the checkpoints themselves.
        """
        self.queue = JobQueue()
        self._sweeps: dict[str, _Sweep] = {}
        for job in jobs:
            policy, step = job.case.policy, job.case.checkpoint_step
            if step is None:
                self.queue.put(job)
                continue
            sweep = self._sweeps.get(policy.name)
            if sweep is None:
                server = None if policy.url is None else swaps
                sweep = self._sweeps[policy.name] = _Sweep(policy.name, server)
            sweep.later.setdefault(step, []).append(job)
        self._retries = plan.retries
        self._abort_after = plan.abort_after
        self._consumer = consumer
        self._lost = 0  # number of consecutive lost episodes
        self._policy_errors = 0  # number of consecutive episodes with a policy error
        # The last result of each episode whose simulation diverged, if the policy is the cause.
        self._diverged: dict[EpisodeKey, EpisodeResult] = {}

    @property
    def waiting(self) -> int:
        """The number of jobs that no worker has begun."""
        later = [jobs for sweep in self._sweeps.values() for jobs in sweep.later.values()]
        return len(self.queue) + sum(map(len, later))

    def hand_out(self, pool: Workers) -> None:
        """Assign waiting jobs to idle workers, and start more workers if they are needed.

        Raises:
            VLAgentsError: A checkpoint of a sweep cannot be loaded.
        """
        for sweep in self._sweeps.values():
            self._advance(sweep, pool)

        for worker in pool.idle():
            jobs = self.queue.take(worker.kind, worker.env_place, pool.busy_places())
            if jobs:
                self._consumer.began(jobs)
                pool.dispatch(worker, jobs)

        while True:
            case = self.queue.needs_worker(pool.kinds(), pool.kinds(occupied=False))
            if case is None or not pool.free_slot():
                return
            pool.start(case)

    def _advance(self, sweep: _Sweep, pool: Workers) -> None:
        """Queue the jobs of the next step of a sweep, once no other job of its policy is left and
        its checkpoint is loaded.
        """
        if sweep.swapping_to is None:
            is_busy = self.queue.has_jobs_of(sweep.policy) or sweep.policy in pool.busy_policies()
            if is_busy or not sweep.later:
                return
            sweep.swapping_to = next(iter(sweep.later))
            if sweep.server is not None:
                sweep.server.begin(sweep.policy, sweep.swapping_to)

        if sweep.server is None or sweep.server.is_done(sweep.policy):
            for job in sweep.later.pop(sweep.swapping_to):
                self.queue.put(job)
            sweep.swapping_to = None

    def take(self, job: Job, report: Report) -> None:
        """Pass the result in a report to the consumer, or repeat the job.

        Raises:
            PolicyFailed: Too many episodes in a row ended with an error of the policy.
            VLAgentsError: The error of a failure that the user can correct; or the last error, if
                too many episodes in a row were lost.
        """
        self._consumer.described(job, report)
        if report.failure is not None:
            self._failed(job, report.failure)
        elif report.result is not None:
            self._finish(job, report.result, report.artifacts)

    def _failed(self, job: Job, failure: Failure) -> None:
        """Repeat a failed attempt, or finish its episode as lost."""
        if failure.diverged is not None and self._diverged_before(job, failure.diverged):
            # The simulation diverged again under the same actions, so further attempts would, too.
            self._finish(job, failure.diverged, Artifacts())
            return

        is_needed = self._consumer.is_needed(job)
        repeated = is_needed and failure.cause != "user" and job.attempt <= self._retries
        self._consumer.attempt_failed(job, failure, repeated=repeated)
        if failure.cause == "user":
            raise from_code(failure.code, failure.message)
        if repeated:
            self.queue.put_back(job.again(alone=self._must_be_alone(job, failure)))
        elif is_needed and job.key in self._diverged:
            # A policy that makes the simulator diverge, with other actions at each attempt, has
            # failed. Otherwise, its episodes would be in no rate, and it would win comparisons.
            self._finish(job, self._diverged[job.key], Artifacts())
        elif is_needed:
            error = f"{failure.code}: {failure.message}"
            lost = EpisodeResult(job.key, "infra_failed", error=error)
            self._consumer.finished(job, lost, Artifacts())
            self._count_loss(failure)

    def _must_be_alone(self, job: Job, failure: Failure) -> bool:
        """Return whether the next attempt must run without other episodes in its simulator, since
        one of them may be the cause of the failure.

        After a simulator broke, all its episodes are first repeated together, since most simulators
        do not break again. The last attempt is always alone, so that no other episode is lost if
        this episode breaks the simulator.
        """
        broke_again = failure.cause == "worker" and job.attempt >= min(2, self._retries)
        return failure.names_no_episode or broke_again

    def _diverged_before(self, job: Job, result: EpisodeResult) -> bool:
        """Return whether the simulation of an episode has diverged before under the same
        actions.
        """
        earlier = self._diverged.get(job.key)
        self._diverged[job.key] = result
        return earlier is not None and (earlier.steps, earlier.actions_sha256) == (
            result.steps,
            result.actions_sha256,
        )

    def _finish(self, job: Job, result: EpisodeResult, artifacts: Artifacts) -> None:
        """Pass the result of a finished episode to the consumer."""
        if result.status != "policy_error":
            self._lost = self._policy_errors = 0
        self._consumer.finished(job, result, artifacts)
        if result.status == "policy_error":
            self._count_policy_error(result.error or "")

    def _count_policy_error(self, error: str) -> None:
        self._policy_errors += 1
        if self._policy_errors == self._abort_after:
            raise PolicyFailed(
                f"{self._policy_errors} episodes in a row ended with an error of the policy: "
                f"{error.strip()}; {self._consumer.policy_cure}"
            )

    def _count_loss(self, failure: Failure) -> None:
        self._lost += 1
        if self._lost == self._abort_after:
            raise from_code(
                failure.code,
                f"{self._lost} episodes in a row lost to infrastructure; "
                f"{self._consumer.loss_cure}: {failure.message}",
            )
