"""A worker as the driver sees it, and how long it may take for what it does."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from vlagents_ray.evaluate.config import EvalConfig, WorkerConfig
from vlagents_ray.evaluate.episode import Phase
from vlagents_ray.evaluate.jobs import Job
from vlagents_ray.evaluate.rollout import Pulse

WATCH_S = 1.0  # between two looks at a busy worker
GRACE_S = 5.0  # a call past its deadline gets this long to fail by itself


@dataclass(slots=True, eq=False)
class Worker:
    """One of them. Times are `time.monotonic()`'s."""

    config: WorkerConfig
    kind: str  # stands for `config`
    actor: Any
    starting: Any  # ref of `ready()`; None once it runs
    since: float  # when it was started
    jobs: tuple[Job, ...] = ()  # that it plays, of one cell
    running: Any = None  # ref of `run(jobs)`
    made: str | None = None  # the place of the env it holds
    looking: Any = None  # ref of `progress()`
    looked: float = 0.0  # when it was asked
    pulse: Pulse = field(default_factory=lambda: Pulse("idle", 0.0, 0))
    heard: float = 0.0  # when it last answered
    process: dict[str, Any] = field(default_factory=dict)  # what `ready()` said
    node: str | None = None  # Ray's id of the one it runs on or, while it starts, is wanted on; None: any

    @property
    def refs(self) -> list[Any]:
        """Of the answers that it owes."""
        return [ref for ref in (self.starting, self.running, self.looking) if ref is not None]

    def is_to_be_asked(self, now: float) -> bool:
        """Is it time to look how it gets on?"""
        return self.looking is None and now - self.looked > WATCH_S


class Limits:
    """How long a worker may take for each phase of an episode."""

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

    def overdue(self, worker: Worker, now: float) -> str | None:
        """Why `worker`, which is busy, must be replaced, if it must."""
        pulse = worker.pulse
        limit_s = self._limit_s.get(pulse.phase, self._env_s)
        if pulse.age_s > limit_s + GRACE_S:
            return f"{pulse.phase} after {pulse.steps} steps took longer than {limit_s:g} s; the worker was killed"
        # A simulator that hangs inside C code holds the interpreter, so that nothing answers.
        silent_s = now - worker.heard
        if silent_s > max(limit_s, self._env_s) + GRACE_S + WATCH_S:
            return f"no sign of life for {silent_s:.0f} s, last seen in {pulse.phase}; the worker was killed"
        return None
