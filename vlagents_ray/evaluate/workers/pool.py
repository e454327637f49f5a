"""Workers that are Ray actors; they are killed if they hang."""

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
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory
from vlagents_ray.evaluate.episode.episode import Phase
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.workers.base import SIGNAL_S, WorkerHandle, Workers
from vlagents_ray.evaluate.workers.cluster import (
    CapacityMonitor,
    Placement,
    runtime_env,
    strategy,
    tail_at,
)
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Heartbeat, Report, Rollout
from vlagents_ray.ray_tools.head_monitor import HeadMonitor, head_is_gone

WATCH_S = 1.0  # time between two queries of a busy worker, s, unless there are many workers
# Maximum number of queries per second to all workers: each takes up to 1 ms of the driver's time.
QUERIES_PER_S = 250
GRACE_S = 5.0  # s, time after the deadline in which a call can still fail by itself
KILL_S = 3.0  # s, time limit for Ray to accept the requests to kill workers
CLOSE_S = 10.0  # s, time limit for workers to close their simulators when they end
# Maximum number of consecutive failed starts; workers that fail together, e.g. with their node,
# count as one.
MOST_FAILED_STARTS = 3
# Time, s, without further requests to a host that did not return a lost worker's logs.
UNREACHABLE_S = 60.0

log = logging.getLogger(__name__)


class WorkerPool(Workers):
    """The workers of a plan, as Ray actors. Use it as a context manager; when the context ends,
    every worker is killed.

    While the head of the cluster does not answer, the existing workers continue, and no new workers
    are started.
    """

    def __init__(
        self,
        plan: ResolvedPlan,
        agent_factory: AgentFactory,
        recorders: RecorderFactory | None = None,
    ) -> None:
        super().__init__(plan, agent_factory, recorders)
        self._actor_class = ray.remote(concurrency_groups={"watch": 1})(Rollout)
        # The API key from this process's environment, which workers on other nodes do not inherit.
        self._credentials = Credentials()
        self._head = HeadMonitor(
            "finished episodes are kept: continue with --resume when a cluster is running again"
        )
        self._placement = Placement()
        self._failed_starts = 0  # number of consecutive failed starts
        self._last_failed_start = 0.0  # time of the last failed start
        # Time until which no request is sent to a host that did not answer, by host.
        self._unreachable: dict[str, float] = {}
        self._limits = plan.limits
        self._capacity = CapacityMonitor(plan.workers, plan.limits.place_s)
        # Actors that are ending, and the times at which their end began.
        self._leaving: list[tuple[Any, float]] = []

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # Without the head, actors cannot be killed; Ray ends them when the head is lost.
        if kind is ClusterLost:
            return
        actors = [worker.actor for worker in self._workers]
        actors += [actor for actor, _ in self._leaving]
        # A Ray cluster that is being stopped, e.g. with its job, does not answer. Kill the actors
        # in another thread, so that this thread can still save the results.
        killing = threading.Thread(target=_kill, args=(actors,), daemon=True)
        killing.start()
        killing.join(KILL_S)
        self._workers.clear()
        self._leaving.clear()

    def free_slot(self) -> bool:
        """Return whether a worker can be started, after ending an idle worker if necessary."""
        if not self._head.answers():
            return False
        if len(self._workers) < max(1, self._plan.workers):
            return True
        idle = self.idle()
        if not idle:
            return False

        worker = idle[0]
        self._workers.remove(worker)
        # Closes the simulator, which some simulators need for a clean exit.
        worker.actor.close.remote()
        worker.actor.__ray_terminate__.remote()
        self._leaving.append((worker.actor, monotonic()))
        return True

    def start(self, case: EvalCase) -> None:
        """Start an actor with the resources that the case needs, if possible near the policy."""
        workers_by_node = Counter(worker.node for worker in self._workers)
        node = self._placement.node(case.policy.url, workers_by_node)
        options = {
            "num_cpus": case.worker.cpus,
            "num_gpus": case.worker.gpus,
            "max_restarts": 0,
            "scheduling_strategy": strategy(node),
            "runtime_env": runtime_env(case),
        }
        actor = self._actor_class.options(**options).remote(self._agent_factory, self._recorders)
        worker = WorkerHandle(
            case.worker,
            case.kind,
            actor,
            starting=actor.ready.remote(self._credentials),
            started_at=monotonic(),
            node=node,
        )
        self._workers.append(worker)

    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        """Send jobs to a worker; `wait` receives the reports."""
        phase: Phase = "env reset" if worker.env_place == jobs[0].case.place else "make"
        worker.jobs = jobs
        worker.heartbeat, worker.heartbeat_at = Heartbeat(phase, 0.0, 0), monotonic()
        worker.queried_at, worker.query = monotonic(), None
        worker.running = worker.actor.run.remote(jobs)

    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Yield the reports that arrive within `timeout_s`, including those of workers that died or
        hung.

        A worker that died, hung or reports that its simulator broke is killed.

        Raises:
            ClusterLost: The head of the cluster has not answered for too long.
        """
        self._head.answers()
        owners: dict[Any, WorkerHandle] = {}  # workers by the reference of the awaited answer
        for worker in self._workers:
            for ref in (worker.starting, worker.running, worker.query):
                if ref is not None:
                    owners[ref] = worker

        if owners:
            done, waiting = ray.wait(list(owners), num_returns=1, timeout=timeout_s)
            # Each pass checks every worker, so it should process all answers that have arrived.
            if done and waiting:
                done += ray.wait(waiting, num_returns=len(waiting), timeout=0)[0]
            for ref in done:
                yield from self._handle_answer(owners[ref], ref)
        yield from self._check_workers()

    def close(self) -> None:
        """Close the agents and the environments of the idle workers."""
        closing = [worker.actor.close.remote() for worker in self.idle()]
        if not closing:
            return
        done, late = ray.wait(closing, num_returns=len(closing), timeout=CLOSE_S)
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
            except RayError as error:  # the result of the job reports the same error
                log.debug("a worker did not answer: %s", error)
        elif worker.jobs:
            jobs = worker.jobs
            yield from zip(jobs, self._reports(worker, ref), strict=True)

    def _reports(self, worker: WorkerHandle, ref: Any) -> list[Report]:
        """Return the reports of a worker that has run its jobs; kill it if it broke."""
        jobs, worker.jobs, worker.running = worker.jobs, (), None
        try:
            reports: list[Report] = ray.get(ref)
        except RayError as error:
            event = "died" if isinstance(error, RayActorError) else "failed"
            reason = f"the worker on {worker.process['host']} {event}: {error}"
            reports = [Report(failure=Failure("worker", EnvFailed.code, reason))] * len(jobs)
        if reports[0].env is not None:
            worker.env_place = jobs[0].case.place

        failures = [report.failure for report in reports if report.failure is not None]
        breakdowns = [failure for failure in failures if failure.cause == "worker"]
        if not breakdowns:
            return reports
        self._kill_worker(worker)
        with_log = self._with_log(breakdowns[0], worker)
        return [
            replace(report, failure=with_log) if report.failure in breakdowns else report
            for report in reports
        ]

    def _started(self, worker: WorkerHandle) -> None:
        try:
            worker.process = ray.get(worker.starting)
        except RayError as error:
            # Workers that were requested before the last failure may have failed for the same
            # reason.
            if worker.started_at > self._last_failed_start:
                self._failed_starts += 1
                self._last_failed_start = monotonic()
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
        # Kill workers that do not end by themselves, since new workers wait for their resources.
        for actor, since in self._leaving:
            if now - since > CLOSE_S:
                ray.kill(actor)
        self._leaving = [(actor, since) for actor, since in self._leaving if now - since <= CLOSE_S]

        for worker in list(self._workers):
            if worker.starting is not None:
                if self._capacity.timed_out(worker.started_at) and self._head.answers():
                    running = sum(handle.starting is None for handle in self._workers)
                    self._capacity.report_shortage(worker.config, running)
                continue
            if not worker.jobs:
                continue

            reason = self._overdue(worker, now)
            if reason is not None:
                self._kill_worker(worker)
                failure = Failure("worker", EnvFailed.code, reason, worker.heartbeat.stack)
                report = Report(failure=self._with_log(failure, worker))
                yield from ((job, report) for job in worker.jobs)
            elif worker.query is None and now - worker.queried_at > watch_s(len(self._workers)):
                worker.queried_at = now
                worker.query = worker.actor.progress.options(concurrency_group="watch").remote()

    def _overdue(self, worker: WorkerHandle, now: float) -> str | None:
        """Return the reason why the busy `worker` must be replaced; None if there is no reason."""
        heartbeat = worker.heartbeat
        limit_s = self._limits.of_phase(heartbeat.phase)
        if heartbeat.age_s > limit_s + GRACE_S:
            return (
                f"{heartbeat.phase} after {heartbeat.steps} steps took longer than {limit_s:g} "
                "s; the worker was killed"
            )
        # A simulator that hangs in C code keeps the interpreter lock, so that no call is answered.
        silent_s = now - worker.heartbeat_at
        if silent_s > max(limit_s, self._limits.env_s) + GRACE_S + watch_s(len(self._workers)):
            return (
                f"no sign of life for {silent_s:.0f} s, last seen in {heartbeat.phase}; the "
                "worker was killed"
            )
        return None

    def _with_log(self, failure: Failure, worker: WorkerHandle) -> Failure:
        """Add the worker's log to the failure. The timeout for a lost node occurs only once, even
        if the node had several workers.
        """
        host: str = worker.process["host"]
        if monotonic() < self._unreachable.get(host, 0.0) or not self._head.answers():
            return failure
        # Slurm sends signals to all processes of a job at once. Calls to Ray would then block until
        # Slurm kills this process.
        sleep(SIGNAL_S)
        if head_is_gone():
            return failure
        try:
            return replace(failure, log=tail_at(host, worker.process["logs"]))
        except TimeoutError:
            self._unreachable[host] = monotonic() + UNREACHABLE_S
            return failure


def watch_s(workers: int) -> float:
    """Return the time between two queries of a worker, s, given the number of workers."""
    return max(WATCH_S, workers / QUERIES_PER_S)


def _kill(actors: list[Any]) -> None:
    for actor in actors:
        # `__exit__` no longer waits for this thread; a call to Ray now would start another cluster.
        if not ray.is_initialized():
            return
        with contextlib.suppress(RayError):  # the actor ends with this process in any case
            ray.kill(actor)
