"""The driver's handle of a worker, and the time limits of a worker's phases."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.evaluate.episode.episode import Phase
from vlagents_ray.evaluate.plan.config import EvalConfig, WorkerConfig
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.workers.rollout import Heartbeat

WATCH_S = 1.0  # s between two queries of a busy worker
GRACE_S = 5.0  # s that a call past its deadline has to fail by itself


@dataclass(slots=True, eq=False)
class WorkerHandle:
    """A worker of the pool. Times are those of `time.monotonic()`."""

    config: WorkerConfig
    kind: str  # identifies `config`
    actor: Any
    starting: Any  # ObjectRef of `ready()`; None once the worker runs
    started_at: float  # time of its start
    jobs: tuple[Job, ...] = ()  # the jobs that it plays, all of one cell
    running: Any = None  # ObjectRef of `run(jobs)`
    env_place: str | None = None  # the place of its environment
    query: Any = None  # ObjectRef of `progress()`
    queried_at: float = 0.0  # time of the last query
    heartbeat: Heartbeat = field(default_factory=lambda: Heartbeat("idle", 0.0, 0))
    heartbeat_at: float = 0.0  # time of the last answer
    process: dict[str, Any] = field(default_factory=dict)  # the answer of `ready()`
    node: str | None = None  # Ray's id of the node it runs on or, while it starts, is requested on; None: any node

    @property
    def refs(self) -> list[Any]:
        """Return the references of the pending answers."""
        return [ref for ref in (self.starting, self.running, self.query) if ref is not None]

    def query_is_due(self, now: float) -> bool:
        """Whether it is time to query its progress."""
        return self.query is None and now - self.queried_at > WATCH_S


class PhaseTimeouts:
    """The time limits of the phases of an episode."""

    def __init__(self, config: EvalConfig) -> None:
        self._env_s = config.env_timeout_s
        self._limit_s: dict[Phase, float] = {
            "connect": config.connect_timeout_s + config.policy_timeout_s,
            "make": config.make_timeout_s,
            "env reset": config.env_timeout_s,
            "env step": config.env_timeout_s,
            "policy reset": config.policy_timeout_s,
            "policy act": config.policy_timeout_s,
        }

    def overdue(self, worker: WorkerHandle, now: float) -> str | None:
        """Return why the busy `worker` must be replaced; None if it need not be."""
        heartbeat = worker.heartbeat
        limit_s = self._limit_s.get(heartbeat.phase, self._env_s)
        if heartbeat.age_s > limit_s + GRACE_S:
            return (
                f"{heartbeat.phase} after {heartbeat.steps} steps took longer than {limit_s:g} s; the worker was killed"
            )
        # A simulator that hangs in C code holds the interpreter's lock, so that no call is answered.
        silent_s = now - worker.heartbeat_at
        if silent_s > max(limit_s, self._env_s) + GRACE_S + WATCH_S:
            return f"no sign of life for {silent_s:.0f} s, last seen in {heartbeat.phase}; the worker was killed"
        return None
