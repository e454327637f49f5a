"""A single worker in this process, without Ray, and the choice between this worker and Ray
actors.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from typing import NoReturn

from vlagents_ray.errors import PolicyFailed, VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.plan.resolved import VARIABLES, ResolvedPlan, TimeLimits
from vlagents_ray.evaluate.workers.base import WorkerHandle, Workers
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Report, Rollout
from vlagents_ray.ray_tools.session import variables
from vlagents_ray.signals import is_stopping, raised_at_once

log = logging.getLogger(__name__)


_LOOK_S = 1.0  # s, time between two checks of the phase
_STACK_LINES = 6  # shown lines of the stack: the innermost three calls
_CLOSE_S = 5.0  # s, time limit for closing the agent and the environment after a signal


class InProcessWorkers(Workers):
    """A single worker, which runs its episodes in `wait`.

    A hanging call is reported, but no time limit can end it. A signal ends the call by raising
    `KeyboardInterrupt`, since this thread runs the episodes and cannot check the flag of
    `stop_signals` meanwhile.
    """

    def __init__(
        self,
        plan: ResolvedPlan,
        agent_factory: AgentFactory,
        recorders: RecorderFactory | None = None,
    ) -> None:
        super().__init__(plan, agent_factory, recorders)
        self._rollout = Rollout(self._agent_factory, self._recorders)
        self._variables = contextlib.ExitStack()

    def __exit__(self, *_: object) -> None:
        try:
            self.close()
        except KeyboardInterrupt:
            if not is_stopping():
                raise
            log.warning("the policy and the env were not closed: closing them took too long")
        finally:
            self._variables.close()

    def free_slot(self) -> bool:
        """Remove the worker if it is idle; return whether there is no worker."""
        for worker in self.idle():
            self._workers.remove(worker)
        return not self._workers

    def start(self, case: EvalCase) -> None:
        """Start the worker for a case, and set the worker's environment variables in this
        process.
        """
        self._variables.enter_context(variables(case.worker.runtime_env.get(VARIABLES) or {}))  # type: ignore[arg-type]
        self._workers.append(
            WorkerHandle(case.worker, case.kind, actor=None, starting=self, started_at=0.0)
        )

    def dispatch(self, worker: WorkerHandle, jobs: tuple[Job, ...]) -> None:
        worker.jobs = jobs

    def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
        """Run the dispatched jobs, and yield their reports; the time is not limited."""
        for worker in self._workers:
            worker.starting = None
            jobs, worker.jobs = worker.jobs, ()
            if not jobs:
                continue

            hangs = _hangs_reported(self._rollout, self._plan.limits)
            # Innermost, so that no signal interrupts the end of the other contexts.
            with _exits_raised(), hangs, raised_at_once():
                reports = self._rollout.run(jobs)
            if reports[0].env is not None:
                worker.env_place = jobs[0].case.place
            failures = [report.failure for report in reports if report.failure is not None]
            if any(failure.cause == "worker" for failure in failures):
                self.close()
                worker.env_place = None
            yield from zip(jobs, reports, strict=True)

    def close(self) -> None:
        """Close the agent and the environment; the next jobs create new ones."""
        rollout = self._rollout
        self._rollout = Rollout(self._agent_factory, self._recorders)
        try:
            with raised_at_once(_CLOSE_S):
                rollout.close()
        except VLAgentsError as error:
            log.warning("closing the env: %s", error)


@contextlib.contextmanager
def _exits_raised() -> Iterator[None]:
    """Make `os._exit` raise `PolicyFailed` if a policy or a simulator calls it in this thread.

    Otherwise the call would end the command without a message, and possibly with status 0.
    """
    end_process = os._exit
    player = (os.getpid(), threading.get_ident())

    def end(status: int) -> NoReturn:
        """Raise an error in this thread; end the process in any other thread."""
        # A child process, or the thread that watches Ray, may end the process.
        if (os.getpid(), threading.get_ident()) != player:
            end_process(status)
        caller = sys._getframe(1)
        line = f"{os.path.basename(caller.f_code.co_filename)}:{caller.f_lineno}"
        raise PolicyFailed(f"os._exit({status}) was called ({line}); raise an exception instead")

    os._exit = end
    try:
        yield
    finally:
        os._exit = end_process


@contextlib.contextmanager
def _hangs_reported(rollout: Rollout, limits: TimeLimits) -> Iterator[None]:
    """Log the present line of a phase of an episode that has exceeded its time limit, once for each
    such phase.
    """
    ended = threading.Event()

    def watch() -> None:
        """Check the phase periodically until the episode has ended."""
        reported = ("", -1)
        while not ended.wait(_LOOK_S):
            heartbeat = rollout.progress()
            limit_s = limits.of_phase(heartbeat.phase)
            phase = (heartbeat.phase, heartbeat.steps)
            if heartbeat.phase != "idle" and heartbeat.age_s > limit_s and phase != reported:
                reported = phase
                innermost = "\n".join(heartbeat.stack.splitlines()[-_STACK_LINES:])
                log.warning(
                    "%s after %d steps has taken longer than %g s, and may hang; Ctrl-C ends the "
                    "evaluation. It is at\n%s",
                    *phase,
                    limit_s,
                    innermost,
                )

    threading.Thread(target=watch, name="hangs", daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def workers_class(plan: ResolvedPlan, stack: contextlib.ExitStack) -> Callable[..., Workers]:
    """Return the class of the workers: without Ray if the plan has 0 workers, otherwise Ray actors
    in a cluster that `stack` leaves at its end.
    """
    if plan.workers == 0:
        return InProcessWorkers
    from vlagents_ray.evaluate.workers import cluster, pool

    stack.enter_context(cluster.ray_cluster(plan))
    return pool.WorkerPool
