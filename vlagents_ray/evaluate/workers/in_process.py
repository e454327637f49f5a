"""The worker of an evaluation without Ray: the driver's own process."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
from collections.abc import Iterator

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import RecorderFactory, Recording
from vlagents_ray.evaluate.plan.cases import EvalCase, cells
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.workers.base import WorkerHandle, Workers
from vlagents_ray.evaluate.workers.rollout import AgentFactory, Report, Rollout
from vlagents_ray.ray_tools.private import node_of_this_process
from vlagents_ray.ray_tools.session import variables

SHORT_STEPS = 10_000  # planned steps up to which Ray's start, some seconds, is a large part of the time
_STEPS = 300  # of an episode, if the options of its environment name no `max_steps`
_VARIABLES = "env_vars"  # in Ray's runtime environment
log = logging.getLogger(__name__)


def chosen_workers(config: EvalConfig) -> int:
    """Return `config.workers` or, if that is None, 0 for a short evaluation that needs no Ray, else 1.

    A single worker plays one episode after another, as this process does, so that Ray adds its start and a message to
    each act. In return a simulator that crashes or hangs is replaced, which a long evaluation needs. Ray is also chosen
    if this process is in a cluster or `RAY_ADDRESS` names one, and for whatever `ray_needed` finds.

    Raises:
        ConfigError: `config.workers` is 0, and something needs Ray.
    """
    need = ray_needed(config)
    if config.workers == 0 and need is not None:
        raise ConfigError(f"workers: got 0, which plays in this process without Ray, but {need}; want 1 or more")
    if config.workers is not None:
        return config.workers
    steps = sum(cell.planned * int(cell.suite.env_options.get("max_steps") or _STEPS) for cell in cells(config))
    in_cluster = node_of_this_process() is not None or bool(os.environ.get("RAY_ADDRESS"))
    on_gpu = any(cell.worker.gpus for cell in cells(config))
    return int(need is not None or in_cluster or on_gpu or steps > SHORT_STEPS)


def ray_needed(config: EvalConfig) -> str | None:
    """Return what in the plan only Ray can do, as a clause; None if there is nothing."""
    for policy in config.policies:
        for url in (policy.url, policy.source):
            if url is not None and url.startswith("serve://"):
                return f"{url} is a policy inside a Ray cluster"
    for cell in cells(config):
        if more := sorted(cell.worker.runtime_env.keys() - {_VARIABLES}):
            return f"the runtime_env of the worker of {cell.env!r} has {more}"
    return None


class InProcessWorkers(Workers):
    """One worker, which plays while it is waited for. No time limit can end a simulator that hangs."""

    def __init__(self, config: EvalConfig, agent_factory: AgentFactory, recorders: RecorderFactory = Recording) -> None:
        super().__init__()
        self._make = functools.partial(Rollout, config, agent_factory, recorders)
        self._rollout = self._make()
        self._variables = contextlib.ExitStack()

    def __exit__(self, *_: object) -> None:
        self.close()
        self._variables.close()

    def free_slot(self) -> bool:
        for worker in self.idle():
            self._workers.remove(worker)
        return not self._workers

    def start(self, cell: EvalCase) -> None:
        self._variables.enter_context(variables(cell.worker.runtime_env.get(_VARIABLES) or {}))  # type: ignore[arg-type]
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
