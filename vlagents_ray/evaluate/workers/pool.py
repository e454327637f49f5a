"""Workers that are Ray actors, which are killed if they hang."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from time import monotonic, sleep
from typing import Any

import ray
from ray.exceptions import RayActorError, RayError

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.errors import ClusterLost, EnvFailed
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory, Recording
from vlagents_ray.evaluate.episode.episode import Phase
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.workers.base import SIGNAL_S, WorkerHandle, Workers, phase_limits_s
from vlagents_ray.evaluate.workers.cluster import (
    CapacityMonitor,
    Placement,
    runtime_env,
    strategy,
    tail_at,
)
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Heartbeat, Report, Rollout
from vlagents_ray.ray_tools.head_monitor import HeadMonitor, head_is_gone

WATCH_S = 1.0  # s between two queries of a busy worker, unless there are many
QUERIES_PER_S = 250  # of all workers, at most: each takes the driver up to 1 ms
GRACE_S = 5.0  # s that a call past its deadline has to fail by itself
KILL_S = 3.0  # s for Ray to register that workers are to be killed
CLOSE_S = 10.0  # s for workers to close their simulators when they end
MOST_FAILED_STARTS = 3  # in a row; workers that fail together, as with their node, count as one
# S without further requests to a host that did not return a lost worker's logs.
UNREACHABLE_S = 60.0

log = logging.getLogger(__name__)


class WorkerPool(Workers):
    """Up to `config.workers` workers. Use it as a context manager: its end kills every worker.

    While the head of the cluster does not answer, the existing workers continue, and no others are
    started.
    """

    def __init__(
        self,
        config: EvalConfig,
        agent_factory: AgentFactory,
        recorders: RecorderFactory = Recording,
    ) -> None:
        super().__init__()
        self._config, self._recorders = config, recorders
        self._actor_class = ray.remote(concurrency_groups={"watch": 1})(Rollout)
        self._agent_factory = agent_factory
        # from this process's environment, which workers on other nodes do not inherit
        self._credentials = Credentials()
        self._head = HeadMonitor(
            "what was played is kept: go on with --resume when there is a cluster again"
        )
        self._placement = Placement()
        self._failed_starts = 0
        self._failed_start = 0.0  # time of the last one
        # By silent host: time until which no request is sent.
        self._unreachable: dict[str, float] = {}
        self._capacity = CapacityMonitor(config)
        self._limits_s = phase_limits_s(config)
        self._leaving: list[tuple[Any, float]] = []  # actors that are ending, and since when

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is ClusterLost:  # nothing can kill them; Ray ends them when the head is lost
            return
        actors = [worker.actor for worker in self._workers] + [actor for actor, _ in self._leaving]
        # A Ray cluster that is being stopped, for instance with its job, does not answer; the
        # results must still be kept.
        killing = threading.Thread(target=_kill, args=(actors,), daemon=True)
        killing.start()
        killing.join(KILL_S)
        self._workers.clear()
        self._leaving.clear()

    def free_slot(self) -> bool:
        if not self._head.answers():
            return False
        if len(self._workers) < (self._config.workers or 1):
            return True
        if not (idle := self.idle()):
            return False
        self._workers.remove(idle[0])
        idle[0].actor.close.remote()  # frees its simulator; some need that for a clean exit
        idle[0].actor.__ray_terminate__.remote()
        self._leaving.append((idle[0].actor, monotonic()))
        return True

    def start(self, case: EvalCase) -> None:
        node = self._placement.node(
            case.policy.url, Counter(worker.node for worker in self._workers)
        )
        options = {
            "num_cpus": case.worker.cpus,
            "num_gpus": case.worker.gpus,
            "max_restarts": 0,
            "scheduling_strategy": strategy(node),
            "runtime_env": runtime_env(case),
        }
        actor = self._actor_class.options(**options).remote(
            self._config, self._agent_factory, self._recorders
        )
        starting, now = actor.ready.remote(self._credentials), monotonic()
        self._workers.append(
            WorkerHandle(
                case.worker, case.kind, actor, starting=starting, started_at=now, node=node
            )
        )

    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        phase: Phase = "env reset" if worker.env_place == jobs[0].case.place else "make"
        worker.jobs = jobs
        worker.heartbeat, worker.heartbeat_at = Heartbeat(phase, 0.0, 0), monotonic()
        worker.queried_at, worker.query = monotonic(), None
        worker.running = worker.actor.run.remote(jobs)

    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Yield the reports that arrive within `timeout_s`, including those of workers that died or
        hung.

        Such a worker is killed, as is one that reports that its simulator broke.

        Raises:
            ClusterLost: The head of the cluster has not answered for long.
        """
        self._head.answers()
        refs = {
            ref: one
            for one in self._workers
            for ref in (one.starting, one.running, one.query)
            if ref is not None
        }
        if refs:
            done, waiting = ray.wait(list(refs), num_returns=1, timeout=timeout_s)
            # take all that have arrived: each pass looks at every worker, so it must not serve only
            # one
            if done and waiting:
                done += ray.wait(waiting, num_returns=len(waiting), timeout=0)[0]
            for ref in done:
                yield from self._handle_answer(refs[ref], ref)
        yield from self._check_workers()

    def close(self) -> None:
        if not (closing := {worker.actor.close.remote(): worker for worker in self.idle()}):
            return
        done, late = ray.wait(list(closing), num_returns=len(closing), timeout=CLOSE_S)
        for ref in done:
            try:
                ray.get(ref)
            except RayError as error:
                log.warning("a worker did not close its env: %s", error)
        if late:
            log.warning("%d workers did not close their envs within %g s", len(late), CLOSE_S)

    def _kill_worker(self, worker: WorkerHandle) -> None:
        self._workers.remove(worker)
        ray.kill(worker.actor)

    def _handle_answer(self, worker: WorkerHandle, ref: Any) -> Iterator[tuple[Job, Report]]:
        if ref == worker.starting:
            self._started(worker)
        elif ref == worker.query:
            worker.query = None
            try:
                worker.heartbeat, worker.heartbeat_at = ray.get(ref), monotonic()
            except RayError as error:  # the result of its job reports the same error
                log.debug("a worker did not answer: %s", error)
        elif worker.jobs:
            jobs, worker.jobs, worker.running = worker.jobs, (), None
            try:
                reports: list[Report] = ray.get(ref)
            except RayError as error:
                what = "died" if isinstance(error, RayActorError) else "failed"
                reason = f"the worker on {worker.process['host']} {what}: {error}"
                reports = [Report(failure=Failure("worker", EnvFailed.code, reason))] * len(jobs)
            if reports[0].env is not None:
                worker.env_place = jobs[0].case.place
            broken = [
                one.failure
                for one in reports
                if one.failure is not None and one.failure.cause == "worker"
            ]
            if broken:
                self._kill_worker(worker)
                with_log = self._with_log(broken[0], worker)
                reports = [
                    replace(one, failure=with_log) if one.failure in broken else one
                    for one in reports
                ]
            yield from zip(jobs, reports, strict=True)

    def _started(self, worker: WorkerHandle) -> None:
        try:
            worker.process = ray.get(worker.starting)
        except RayError as error:
            if worker.started_at > self._failed_start:
                self._failed_starts, self._failed_start = self._failed_starts + 1, monotonic()
            if self._failed_starts >= MOST_FAILED_STARTS:
                raise EnvFailed(
                    f"workers do not start, {self._failed_starts} in a row: {error}"
                ) from error
            self._kill_worker(worker)
        else:
            log.info("worker %s", worker.process)
            self._failed_starts = 0
            self._capacity.note_started()
            worker.starting = None
            worker.node = worker.process["node"]

    def _check_workers(self) -> Iterator[tuple[Job, Report]]:
        now = monotonic()
        if self.busy:
            self._capacity.note_playing()
        # Kill workers that do not end by themselves: they hold resources that their successors wait
        # for.
        for actor, since in self._leaving:
            if now - since > CLOSE_S:
                ray.kill(actor)
        self._leaving = [(actor, since) for actor, since in self._leaving if now - since <= CLOSE_S]
        for worker in list(self._workers):
            if worker.starting is not None:
                if self._capacity.timed_out(worker.started_at) and self._head.answers():
                    self._capacity.report_shortage(
                        worker.config, sum(one.starting is None for one in self._workers)
                    )
            elif worker.jobs:
                if (reason := self._overdue(worker, now)) is not None:
                    self._kill_worker(worker)
                    failure = self._with_log(
                        Failure("worker", EnvFailed.code, reason, worker.heartbeat.stack), worker
                    )
                    yield from ((job, Report(failure=failure)) for job in worker.jobs)
                elif worker.query is None and now - worker.queried_at > watch_s(len(self._workers)):
                    worker.queried_at = now
                    worker.query = worker.actor.progress.options(concurrency_group="watch").remote()

    def _overdue(self, worker: WorkerHandle, now: float) -> str | None:
        """Return why the busy `worker` must be replaced; None if it need not be."""
        heartbeat, env_s = worker.heartbeat, self._config.env_timeout_s
        limit_s = self._limits_s.get(heartbeat.phase, env_s)
        if heartbeat.age_s > limit_s + GRACE_S:
            return (
                f"{heartbeat.phase} after {heartbeat.steps} steps took longer than {limit_s:g} "
                "s; the worker was killed"
            )
        # A simulator that hangs in C code holds the interpreter's lock, so that no call is
        # answered.
        silent_s = now - worker.heartbeat_at
        if silent_s > max(limit_s, env_s) + GRACE_S + watch_s(len(self._workers)):
            return (
                f"no sign of life for {silent_s:.0f} s, last seen in {heartbeat.phase}; the "
                "worker was killed"
            )
        return None

    def _with_log(self, failure: Failure, worker: WorkerHandle) -> Failure:
        """Add the worker's log to the failure; a lost node is awaited only once, whatever its
        number of workers.
        """
        host: str = worker.process["host"]
        if monotonic() < self._unreachable.get(host, 0.0) or not self._head.answers():
            return failure
        sleep(SIGNAL_S)
        # Slurm signals all of a job at once; Ray's calls would block until it kills this process.
        if head_is_gone():
            return failure
        try:
            return replace(failure, log=tail_at(host, worker.process["logs"]))
        except TimeoutError:
            self._unreachable[host] = monotonic() + UNREACHABLE_S
            return failure


def watch_s(workers: int) -> float:
    """Return the time between two queries of one of so many workers, s."""
    return max(WATCH_S, workers / QUERIES_PER_S)


def _kill(actors: list[Any]) -> None:
    for actor in actors:
        # `__exit__` has stopped waiting; a call to Ray now would start another cluster.
        if not ray.is_initialized():
            return
        with contextlib.suppress(RayError):  # it ends with this process in any case
            ray.kill(actor)
