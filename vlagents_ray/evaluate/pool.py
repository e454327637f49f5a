"""Workers: Ray actors that play episodes, watched, and killed when they hang. Nothing here knows results."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from time import monotonic
from typing import Any

import ray
from ray.exceptions import RayActorError, RayError

from vlagents_ray.errors import ClusterLost, EnvFailed
from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.config import EvalConfig
from vlagents_ray.evaluate.episode import Phase
from vlagents_ray.evaluate.failures import Failure
from vlagents_ray.evaluate.head import Head
from vlagents_ray.evaluate.jobs import Job
from vlagents_ray.evaluate.logs import tail_at
from vlagents_ray.evaluate.placement import Placement, strategy
from vlagents_ray.evaluate.process import runtime_env
from vlagents_ray.evaluate.rollout import AgentFactory, Pulse, Report, Rollout
from vlagents_ray.evaluate.room import Room
from vlagents_ray.evaluate.worker import Limits, Worker

log = logging.getLogger(__name__)

KILL_S = 3.0  # for Ray to take note that workers are to be killed
CLOSE_S = 10.0  # for workers to close their simulators when they leave
MOST_FAILED_STARTS = 3  # in a row; those that fail together, as with their node, count as one
MUTE_S = 60.0  # a host that did not give the logs of a lost worker is not asked for so long


class WorkerPool:
    """Up to `config.workers` workers. Use as a context manager: leaving it kills every worker.

    While the head of the cluster does not answer, those that are there play on, and no others are started.
    """

    def __init__(self, config: EvalConfig, agent_factory: AgentFactory) -> None:
        self._config = config
        self._actor_class = ray.remote(concurrency_groups={"watch": 1})(Rollout)
        self._agent_factory = agent_factory
        self._head = Head()
        self._placement = Placement()
        self._failed_starts = 0
        self._failed_start = 0.0  # when the last of them failed
        self._mute: dict[str, float] = {}  # hosts that do not answer, until when
        self._room = Room(config)
        self._limits = Limits(config)
        self._workers: list[Worker] = []
        self._leaving: list[tuple[Any, float]] = []  # actors on their way out, and since when

    def __enter__(self) -> WorkerPool:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is ClusterLost:  # nobody is there to kill them; Ray ends them for want of a head, too
            return
        actors = [worker.actor for worker in self._workers] + [actor for actor, _ in self._leaving]
        # A Ray that is itself being ended, as with a job of a cluster's, does not answer; the results are to be kept.
        killing = threading.Thread(target=_kill, args=(actors,), daemon=True)
        killing.start()
        killing.join(KILL_S)
        self._workers.clear()
        self._leaving.clear()

    @property
    def busy(self) -> bool:
        """Is an episode being played?"""
        return any(worker.jobs for worker in self._workers)

    def working(self) -> Counter[str]:
        """How many workers are busy at which place."""
        return Counter(worker.jobs[0].cell.place for worker in self._workers if worker.jobs)

    def kinds(self) -> Counter[str]:
        """How many workers there are of which kind."""
        return Counter(worker.kind for worker in self._workers)

    def unoccupied(self) -> Counter[str]:
        """How many of them play nothing; some may still be starting."""
        return Counter(worker.kind for worker in self._workers if not worker.jobs)

    def idle(self) -> list[Worker]:
        """Workers that can take a job."""
        return [worker for worker in self._workers if worker.starting is None and not worker.jobs]

    def make_room(self) -> bool:
        """Is there room for one more worker? An idle one leaves if there is none."""
        if not self._head.answers():
            return False
        if len(self._workers) < self._config.workers:
            return True
        idle = self.idle()
        if not idle:
            return False
        self._workers.remove(idle[0])
        idle[0].actor.close.remote()  # frees its simulator; some need that for a clean exit
        idle[0].actor.__ray_terminate__.remote()
        self._leaving.append((idle[0].actor, monotonic()))
        return True

    def start(self, cell: Cell) -> None:
        """Have one more worker, which can play `cell`, near to its policy if there is room."""
        node = self._placement.node(cell.policy.url, Counter(worker.node for worker in self._workers))
        options = {
            "num_cpus": cell.worker.cpus,
            "num_gpus": cell.worker.gpus,
            "max_restarts": 0,
            "scheduling_strategy": strategy(node),
            "runtime_env": runtime_env(cell),
        }
        actor = self._actor_class.options(**options).remote(self._config, self._agent_factory)
        starting, since = actor.ready.remote(), monotonic()
        self._workers.append(Worker(cell.worker, cell.kind, actor, starting=starting, since=since, node=node))

    def dispatch(self, worker: Worker, jobs: tuple[Job, ...]) -> None:
        """Have `worker` play `jobs`, side by side."""
        phase: Phase = "env reset" if worker.made == jobs[0].cell.place else "make"
        worker.jobs = jobs
        worker.pulse, worker.heard = Pulse(phase, 0.0, 0), monotonic()
        worker.looked, worker.looking = monotonic(), None
        worker.running = worker.actor.run.remote(jobs)

    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Reports that arrive within `timeout_s`, those of workers that died or hung included.

        Such a worker, and one that reports that its simulator broke, is killed. `ClusterLost` when the head of the
        cluster has not answered for long.
        """
        self._head.answers()
        refs = {ref: worker for worker in self._workers for ref in worker.refs}
        if refs:
            done, waiting = ray.wait(list(refs), num_returns=1, timeout=timeout_s)
            if done and waiting:  # all that have come: a turn looks at every worker, so it must not be one's alone
                done += ray.wait(waiting, num_returns=len(waiting), timeout=0)[0]
            for ref in done:
                yield from self._arrived(refs[ref], ref)
        yield from self._look()

    def close(self) -> None:
        """Let idle workers close their simulators, which some need for a clean exit."""
        closing = {worker.actor.close.remote(): worker for worker in self.idle()}
        if not closing:
            return
        done, late = ray.wait(list(closing), num_returns=len(closing), timeout=CLOSE_S)
        for ref in done:
            try:
                ray.get(ref)
            except RayError as error:
                log.warning("a worker did not close its env: %s", error)
        if late:
            log.warning("%d workers did not close their envs within %g s", len(late), CLOSE_S)

    def _end(self, worker: Worker) -> None:
        self._workers.remove(worker)
        ray.kill(worker.actor)

    def _arrived(self, worker: Worker, ref: Any) -> Iterator[tuple[Job, Report]]:
        if ref == worker.starting:
            self._started(worker)
        elif ref == worker.looking:
            worker.looking = None
            try:
                worker.pulse, worker.heard = ray.get(ref), monotonic()
            except RayError as error:  # the answer to its job says the same
                log.debug("a worker did not answer: %s", error)
        elif worker.jobs:
            jobs, worker.jobs, worker.running = worker.jobs, (), None
            try:
                reports: list[Report] = ray.get(ref)
            except RayError as error:
                what = "died" if isinstance(error, RayActorError) else "failed"
                reason = f"the worker on {worker.process['host']} {what}: {error}"
                reports = [Report(failure=Failure("worker", EnvFailed.code, reason))] * len(jobs)
            if reports[0].made is not None:
                worker.made = jobs[0].cell.place
            broken = [one.failure for one in reports if one.failure is not None and one.failure.cause == "worker"]
            if broken:
                self._end(worker)
                with_log = self._with_log(broken[0], worker)
                reports = [replace(one, failure=with_log) if one.failure in broken else one for one in reports]
            yield from zip(jobs, reports, strict=True)

    def _started(self, worker: Worker) -> None:
        try:
            worker.process = ray.get(worker.starting)
        except RayError as error:
            if worker.since > self._failed_start:
                self._failed_starts, self._failed_start = self._failed_starts + 1, monotonic()
            if self._failed_starts >= MOST_FAILED_STARTS:
                raise EnvFailed(f"workers do not start, {self._failed_starts} in a row: {error}") from error
            self._end(worker)
        else:
            log.info("worker %s", worker.process)
            self._failed_starts = 0
            self._room.found()
            worker.starting = None
            worker.node = worker.process["node"]

    def _look(self) -> Iterator[tuple[Job, Report]]:
        now = monotonic()
        if self.busy:
            self._room.used()
        self._see_off(now)
        for worker in list(self._workers):
            if worker.starting is not None:
                if self._room.lacks(worker.since) and self._head.answers():
                    self._room.miss(worker.config, sum(one.starting is None for one in self._workers))
            elif worker.jobs:
                reason = self._limits.overdue(worker, now)
                if reason is not None:
                    self._end(worker)
                    failure = self._with_log(Failure("worker", EnvFailed.code, reason, worker.pulse.stack), worker)
                    yield from ((job, Report(failure=failure)) for job in worker.jobs)
                elif worker.is_to_be_asked(now):
                    worker.looked = now
                    worker.looking = worker.actor.progress.options(concurrency_group="watch").remote()

    def _see_off(self, now: float) -> None:
        """Kill what does not leave by itself: it holds what the worker in its place waits for."""
        for actor, since in self._leaving:
            if now - since > CLOSE_S:
                ray.kill(actor)
        self._leaving = [one for one in self._leaving if now - one[1] <= CLOSE_S]

    def _with_log(self, failure: Failure, worker: Worker) -> Failure:
        """Nobody waits for a lost node more than once, however many workers it had."""
        host: str = worker.process["host"]
        if monotonic() < self._mute.get(host, 0.0) or not self._head.answers():
            return failure
        try:
            return replace(failure, log=tail_at(host, worker.process["logs"]))
        except TimeoutError:
            self._mute[host] = monotonic() + MUTE_S
            return failure


def _kill(actors: list[Any]) -> None:
    for actor in actors:
        if not ray.is_initialized():  # nobody waited any longer; whoever asks Ray for anything now starts another one
            return
        with contextlib.suppress(RayError):  # it ends with this process in any case
            ray.kill(actor)
