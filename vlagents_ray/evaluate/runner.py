"""Runs an evaluation: dispatch, retries, recording, and a clean stop."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable

from vlagents_ray.errors import from_code
from vlagents_ray.evaluate.agents import agents
from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.cluster import ray_cluster
from vlagents_ray.evaluate.config import EvalConfig
from vlagents_ray.evaluate.deadline import Deadline
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.failures import Failure
from vlagents_ray.evaluate.html import FILE as REPORT
from vlagents_ray.evaluate.html import write_report
from vlagents_ray.evaluate.jobs import Job, JobQueue, plan
from vlagents_ray.evaluate.pool import WorkerPool
from vlagents_ray.evaluate.progress import Progress, SilentProgress
from vlagents_ray.evaluate.provenance import driver_code, policy_code, save_diffs, versions
from vlagents_ray.evaluate.recording import Kept, save
from vlagents_ray.evaluate.results import Results, rate_of
from vlagents_ray.evaluate.rollout import AgentFactory, Report
from vlagents_ray.evaluate.stopping import Stopping
from vlagents_ray.evaluate.store import Store
from vlagents_ray.evaluate.summary import Summary, summarize, write_summary
from vlagents_ray.evaluate.trackers import Tracking
from vlagents_ray.evaluate.whereabouts import Whereabouts, unused_gpus
from vlagents_ray.interface import Agent
from vlagents_ray.signals import stop_signals

log = logging.getLogger(__name__)

POLL_S = 0.25  # how soon a signal is noticed


class EvaluationInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; what was finished is kept, and `resume` goes on from there."""

    why = "interrupted"

    def __init__(self, summary: Summary) -> None:
        done, planned = summary.total.episodes, summary.total.planned
        super().__init__(f"{self.why} after {done} of {planned} episodes; go on with --resume --out {summary.out}")
        self.summary = summary


class OutOfTime(EvaluationInterrupted):
    """No further episode would have ended by `end_at`; `resume` goes on, as after an interruption."""

    why = "out of time"


def evaluate(
    config: EvalConfig,
    *,
    agent_factory: Callable[[], Agent] | None = None,
    progress: Progress | None = None,
    only: tuple[int, int] | None = None,
    end_at: float | None = None,
) -> Summary:
    """Play every episode of `config` that has no result yet; the results are in `config.out`.

    `only`: of each env the episode with this number and this seed, and no other.
    `end_at`, in seconds since 1970: begin no episode that would not end by then, as far as those before it tell.

    Episodes run in Ray actors: in the cluster that this process is connected to, or else in one
    that `RAY_ADDRESS` names, or in a local one started for the length of the run. Each worker talks to
    the policy at its `url`, or to an agent of its own that `agent_factory` makes there.

    Raises `ConfigError` for settings that cannot be, or that contradict the results in `config.out`;
    `ContractMismatch` if policy and env do not fit; the last infrastructure error after
    `config.abort_after` lost episodes in a row; `EvaluationInterrupted` on Ctrl-C or SIGTERM, and `OutOfTime`, which
    is one, when `end_at` left episodes over.
    Whatever it raises, each recorded episode is kept, and summary.json and report.html written.
    """
    factory = agents(config, agent_factory)
    tracking = Tracking(config)
    with Store(config) as store:
        store.begin_run(config, versions())
        save_diffs(config.out, driver_code().values())
        state = "stopped"
        try:
            with tracking:
                run = _Run(config, store, progress or SilentProgress(), tracking, only, end_at)
                state = run.play(factory)
        finally:
            store.end_run(state)
            summary = summarize(Results.load(config.out))
            write_summary(summary)
            write_report(summary.results, config.out / REPORT)
    for stopped in (EvaluationInterrupted, OutOfTime):
        if state == stopped.why:
            raise stopped(summary)
    return summary


def check(config: EvalConfig) -> None:
    """Raise the `ConfigError` that `evaluate` would raise, before a policy is served for it."""
    Store(config).close()


class _Run:
    """The driver's side of one run."""

    def __init__(
        self,
        config: EvalConfig,
        store: Store,
        progress: Progress,
        tracking: Tracking,
        only: tuple[int, int] | None,
        end_at: float | None,
    ) -> None:
        self._config = config
        self._store = store
        self._progress = progress
        self._tracking = tracking
        self._lost_in_a_row = 0
        self._looked_for_gpus = False  # when an env first drew
        earlier = {cell.cell: cell for cell in Results.load(config.out).cells}
        self._recorded = {cell: rate_of([results], "success_once") for cell, results in earlier.items()}
        self._stopping: dict[str, Stopping] = {}
        if config.stop is not None:
            for cell in store.cells:
                stopping = Stopping(config.stop, cell.suite.seeds, cell.planned)
                stopping.add_all(episode.result for episode in earlier[cell.fingerprint].episodes)
                self._stopping[cell.fingerprint] = stopping
        finished = store.finished()
        wanted = [job for job in plan(store.cells) if only in (None, (job.key.episode, job.key.seed))]
        pending = [job for job in wanted if str(job.key) not in finished and not self._has_stopped(job)]
        self._queue = JobQueue(pending)
        self._left = Counter(job.key.settings for job in pending)  # by cell
        played = (one.result.seconds for cell in earlier.values() for one in cell.episodes)
        self._deadline = Deadline(end_at, played)

    def play(self, factory: AgentFactory) -> str:
        """Play all that is queued, until a signal or the deadline ends it early; returns the state of the run."""
        if not len(self._queue):
            return "complete"
        with ray_cluster(self._config), stop_signals() as stop:
            self._progress.begin(self._store.cells, self._recorded, len(self._queue))
            try:
                with WorkerPool(self._config, factory) as pool:
                    while not stop.is_set() and not self._deadline.is_over and self._has_more(pool):
                        self._turn(pool)
                    unfinished = len(self._queue) or pool.busy
                    if not stop.is_set():
                        pool.close()
            finally:
                self._progress.end()
            if stop.is_set():
                return EvaluationInterrupted.why
            return OutOfTime.why if unfinished else "complete"

    def _has_more(self, pool: WorkerPool) -> bool:
        return pool.busy or (len(self._queue) > 0 and self._deadline.leaves_room)

    def _turn(self, pool: WorkerPool) -> None:
        if self._deadline.leaves_room:
            self._hand_out(pool)
        for job, report in pool.wait(POLL_S):
            self._deadline.end(job)
            self._handle(job, report)

    def _hand_out(self, pool: WorkerPool) -> None:
        for worker in pool.idle():
            if jobs := self._queue.take(worker.kind, worker.made, pool.working()):
                self._deadline.begin(jobs)
                pool.dispatch(worker, jobs)
        while (cell := self._queue.wants(pool.kinds(), pool.unoccupied())) is not None and pool.make_room():
            pool.start(cell)

    def _handle(self, job: Job, report: Report) -> None:
        if report.policy is not None:
            self._store.note_policy(job.cell.policy.name, report.policy)
            save_diffs(self._config.out, [policy_code(report.policy)])
        if report.made is not None:
            self._store.note_env(job.cell.place, report.made)
            save_diffs(self._config.out, [report.made.code])
        if report.where is not None:
            self._met(job.cell, report.where)
        if report.failure is not None:
            self._failed(job, report.failure)
        elif report.result is not None:
            self._lost_in_a_row = 0
            self._record(job, report.result, report.kept)

    def _met(self, cell: Cell, where: Whereabouts) -> None:
        self._store.note_worker(where)
        if where.renderer is not None and not self._looked_for_gpus:
            self._looked_for_gpus = True
            if (hint := unused_gpus(cell, where)) is not None:
                log.warning(hint)

    def _failed(self, job: Job, failure: Failure) -> None:
        beyond = self._has_stopped(job)  # nobody waits for it
        retried = failure.cause != "user" and job.attempt <= self._config.retries and not beyond
        self._store.record_attempt(job, failure, retried=retried)
        if failure.cause == "user":
            raise from_code(failure.code, failure.message)
        if retried:
            self._queue.put_back(job.again())
            self._progress.retry(job, failure)
            return
        if beyond:
            return
        lost = EpisodeResult(job.key, "infra_failed", error=f"{failure.code}: {failure.message}")
        self._record(job, lost, Kept())
        self._lost_in_a_row += 1
        if self._lost_in_a_row == self._config.abort_after:
            raise from_code(
                failure.code,
                f"{self._lost_in_a_row} episodes in a row lost to infrastructure; resume when this is mended "
                f"(--resume): {failure.message}",
            )

    def _record(self, job: Job, result: EpisodeResult, kept: Kept) -> None:
        # Files first: a crash in between repeats the episode, and they are overwritten.
        videos, trajectory = save(self._config.out, job.cell, result, kept)
        self._store.record(result, job.attempt, videos, trajectory)
        self._progress.episode(job.cell, result)
        self._left[job.key.settings] -= 1
        self._stop_if_certain(job, result)
        if not self._left[job.key.settings]:
            self._tracking.look()

    def _has_stopped(self, job: Job) -> bool:
        stopping = self._stopping.get(job.cell.fingerprint)
        return stopping is not None and stopping.at is not None

    def _stop_if_certain(self, job: Job, result: EpisodeResult) -> None:
        """Leave out what waits of the cell once its outcomes are enough; what is being played is played to its end."""
        stopping = self._stopping.get(job.cell.fingerprint)
        if stopping is None or self._has_stopped(job):
            return
        stopping.add(result)
        if stopping.at is not None:
            dropped = self._queue.drop(job.cell.fingerprint)
            self._left[job.key.settings] -= dropped
            self._progress.stopped(job.cell, stopping.at, dropped)
