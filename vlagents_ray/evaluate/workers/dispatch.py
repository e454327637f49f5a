"""Jobs for the workers of a pool, and what follows from attempts and episodes that failed."""

from __future__ import annotations

from collections.abc import Callable

from vlagents_ray.errors import PolicyFailed, from_code
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job, JobQueue
from vlagents_ray.evaluate.workers.worker import Workers


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
        """Whether the episode of a failed attempt is to be played again."""
        return failure.cause != "user" and job.attempt <= self._config.retries

    def note_played(self) -> None:
        """Note that an episode was played to its end."""
        self._lost = self._policy_errors = 0

    def note_policy_error(self, error: str) -> None:
        """Note that an error of the policy ended an episode.

        Raises:
            PolicyFailed: The error, if it ended too many episodes in a row.
        """
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
