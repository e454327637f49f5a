"""Runs an evaluation: dispatch, retries, recording, and a clean stop."""

from __future__ import annotations

import functools
import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import ceil
from types import FrameType
from typing import Any

import ray

from vlagents_ray.client import RemoteAgent
from vlagents_ray.errors import ClusterLost, ConfigError, from_code
from vlagents_ray.evaluate.config import EvalConfig, PolicyConfig
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
from vlagents_ray.interface import Agent
from vlagents_ray.signals import own_sigterm

POLL_S = 0.25  # how soon a signal is noticed


class EvaluationInterrupted(KeyboardInterrupt):
    """Ctrl-C or SIGTERM; what was finished is kept, and `resume` goes on from there."""

    def __init__(self, summary: Summary) -> None:
        done, planned = summary.total.episodes, summary.total.planned
        super().__init__(f"interrupted after {done} of {planned} episodes; go on with --resume --out {summary.out}")
        self.summary = summary


def evaluate(
    config: EvalConfig,
    *,
    agent_factory: Callable[[], Agent] | None = None,
    progress: Progress | None = None,
    only: tuple[int, int] | None = None,
) -> Summary:
    """Play every episode of `config` that has no result yet; the results are in `config.out`.

    `only`: of each env the episode with this number and this seed, and no other.

    Episodes run in Ray actors: in the cluster that this process is connected to, or else in one
    that `RAY_ADDRESS` names, or in a local one started for the length of the run. Each worker talks to
    the policy at its `url`, or to an agent of its own that `agent_factory` makes there.

    Raises `ConfigError` for settings that cannot be, or that contradict the results in `config.out`;
    `ContractMismatch` if policy and env do not fit; the last infrastructure error after
    `config.abort_after` lost episodes in a row; `EvaluationInterrupted` on Ctrl-C or SIGTERM.
    Whatever it raises, each recorded episode is kept, and summary.json and report.html written.
    """
    factory = _remote_agents(config) if agent_factory is None else functools.partial(_own_agent, agent_factory)
    tracking = Tracking(config)
    with Store(config) as store:
        store.begin_run(config, versions())
        save_diffs(config.out, driver_code().values())
        state = "stopped"
        try:
            with tracking:
                run = _Run(config, store, progress or SilentProgress(), tracking, only)
                complete = run.play(factory)
            state = "complete" if complete else "interrupted"
        finally:
            store.end_run(state)
            summary = summarize(Results.load(config.out))
            write_summary(summary)
            write_report(summary.results, config.out / REPORT)
    if state == "interrupted":
        raise EvaluationInterrupted(summary)
    return summary


def check(config: EvalConfig) -> None:
    """Raise the `ConfigError` that `evaluate` would raise, before a policy is served for it."""
    Store(config).close()


class _Run:
    """The driver's side of one run."""

    def __init__(
        self, config: EvalConfig, store: Store, progress: Progress, tracking: Tracking, only: tuple[int, int] | None
    ) -> None:
        self._config = config
        self._store = store
        self._progress = progress
        self._tracking = tracking
        self._lost_in_a_row = 0
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

    def play(self, factory: AgentFactory) -> bool:
        """Play all that is queued; False if a signal ended it early."""
        if not len(self._queue):
            return True
        with ray_cluster(self._config), stop_signals() as stop:
            self._progress.begin(self._store.cells, self._recorded, len(self._queue))
            try:
                with WorkerPool(self._config, factory) as pool:
                    while (len(self._queue) or pool.busy) and not stop.is_set():
                        self._turn(pool)
                    if not stop.is_set():
                        pool.close()
            finally:
                self._progress.end()
            return not stop.is_set()

    def _turn(self, pool: WorkerPool) -> None:
        for worker in pool.idle():
            if jobs := self._queue.take(worker.kind, worker.made, pool.working()):
                pool.dispatch(worker, jobs)
        while (cell := self._queue.wants(pool.kinds(), pool.unoccupied())) is not None and pool.make_room():
            pool.start(cell)
        for job, report in pool.wait(POLL_S):
            self._handle(job, report)

    def _handle(self, job: Job, report: Report) -> None:
        if report.policy is not None:
            self._store.note_policy(job.cell.policy.name, report.policy)
            save_diffs(self._config.out, [policy_code(report.policy)])
        if report.made is not None:
            self._store.note_env(job.cell.place, report.made)
            save_diffs(self._config.out, [report.made.code])
        if report.failure is not None:
            self._failed(job, report.failure)
        elif report.result is not None:
            self._lost_in_a_row = 0
            self._record(job, report.result, report.kept)

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


@contextmanager
def ray_cluster(config: EvalConfig) -> Iterator[None]:
    """The cluster this process is in; or one that is left, and if local shut down, at the end."""
    if ray.is_initialized():
        yield
        return
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "WARNING"}
    if not os.environ.get("RAY_ADDRESS"):
        # Its CPUs are bookkeeping: the user's number of workers must fit.
        needed = ceil(config.workers * most_cpus(config))
        options |= {"num_cpus": max(os.cpu_count() or 1, needed), "include_dashboard": False}
    with own_sigterm():
        ray.init(**options)
    try:
        yield
    except ClusterLost:  # to take leave would wait for the head
        raise
    except BaseException:
        ray.shutdown()
        raise
    ray.shutdown()


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set; a second one interrupts whatever is running.

    A signal that only sets a flag cannot split a transaction. Outside the main thread Python delivers
    no signals, and the event stays unset.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def most_cpus(config: EvalConfig) -> float:
    """What the hungriest worker takes."""
    return max(worker.cpus for worker in [config.worker, *(suite.worker or config.worker for suite in config.suites)])


def _remote_agents(config: EvalConfig) -> AgentFactory:
    for policy in config.policies:
        if policy.url is None:
            raise ConfigError(
                f"policy {policy.name!r}: got no url, want that of its server, e.g. http://localhost:8000"
            )
    return functools.partial(_remote_agent, config)


def _own_agent(make: Callable[[], Agent], _policy: PolicyConfig) -> Agent:
    return make()


def _remote_agent(config: EvalConfig, policy: PolicyConfig) -> RemoteAgent:
    assert policy.url is not None  # noqa: S101 - looked at by `_remote_agents`
    return RemoteAgent(
        policy.url,
        transport=policy.transport,
        timeout_s=config.policy_timeout_s,
        connect_timeout_s=config.connect_timeout_s,
        codec=policy.codec,
        rank="simulation",
        resume=False,  # an episode that was interrupted is played again, so that its result depends on its key alone
    )
