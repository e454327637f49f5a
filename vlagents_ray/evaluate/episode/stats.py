"""The counts and measurements of an episode while it is played."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any

import numpy as np

from vlagents_ray.errors import PolicyFailed
from vlagents_ray.evaluate.episode.failures import EnvStep
from vlagents_ray.evaluate.episode.latency import Tick
from vlagents_ray.evaluate.episode.records import Ending, EpisodeResult, version_of
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import POLICY, Act

_LITTLE_ENDIAN = np.dtype("<f4")


@dataclass(slots=True)
class EpisodeStats:
    """The counts and measurements of an episode so far."""

    key: EpisodeKey
    started: float = field(default_factory=perf_counter)
    steps: int = 0
    episode_return: float = 0.0
    success: bool = False
    first_success: int | None = None
    ending: Ending = "error"
    instruction: str = ""  # the present one
    earlier: list[str] = field(default_factory=list)  # instructions of this episode before it
    checkpoint: str | None = None
    weights: str | None = None
    revision: str | None = None
    policy_version: int | None = None
    policy_fingerprint: str | None = None
    first_policy_version: int | None = None
    actions: Any = field(default_factory=hashlib.sha256)  # digest of the executed actions
    reset_ms: float | None = None
    step_ms: list[float] = field(default_factory=list)
    act_ms: list[float] = field(default_factory=list)
    policy_seconds: float = 0.0
    latency_ms: list[float] = field(default_factory=list)
    ticks_waited: int = 0
    ticks_held: int = 0
    timing_ms: dict[str, list[float]] = field(default_factory=dict)

    def began(self, info: object) -> None:
        said = info if isinstance(info, dict) else {}
        self.checkpoint, self.weights, self.revision = (
            value if isinstance(value := said.get(name), str) else None
            for name in ("checkpoint", "weights", "revision")
        )

    def instructed(self, instruction: str) -> None:
        self.earlier.append(self.instruction)
        self.instruction = instruction

    def acted(self, act: Act, seconds: float, latency_s: float | None) -> None:
        """Record an answer of the policy, its duration and, in real-time mode, its latency."""
        self.act_ms.append(1e3 * seconds)
        timing = act.info.get("timing", {})
        # Each answer counts its share of a batch; a policy in this process computes during the whole wait.
        computed_ms = timing.get("inference_ms", 1e3 * seconds)
        self.policy_seconds += computed_ms / 1e3 / max(1, timing.get("batch_size", 1))
        for stage, spent in timing.items():
            if stage.endswith("_ms"):  # the batch size is not a time
                self.timing_ms.setdefault(stage, []).append(float(spent))
        if (version := version_of(act)) is not None:
            self.policy_version, self.policy_fingerprint = version, act.info[POLICY].get("fingerprint") or None
            self.first_policy_version = version if self.first_policy_version is None else self.first_policy_version
        if latency_s is not None:
            self.latency_ms.append(1e3 * latency_s)

    def stepped(self, tick: Tick, step: EnvStep, limit: int) -> bool:
        """Record that `tick` was executed; return whether the episode is over, also by the `limit` of steps."""
        self.steps += 1
        self.ticks_waited += tick.waited
        self.ticks_held += tick.held
        self.actions.update(tick.action.astype(_LITTLE_ENDIAN, copy=False).tobytes())
        self.episode_return += step.reward
        self.success = step.success
        if self.success and self.first_success is None:
            self.first_success = self.steps
        over = step.terminated or step.truncated or self.steps >= limit
        if over:
            self.ending = "terminated" if step.terminated else "truncated"
        return over

    def result(self, transport: str, failed: PolicyFailed | None = None) -> EpisodeResult:
        """Return the result of the finished episode; `failed` is the policy error that ended it, if any."""
        return EpisodeResult(
            key=self.key,
            status="done" if failed is None else "policy_error",
            success_once=self.first_success is not None and failed is None,
            success_at_end=self.success and failed is None,
            first_success=self.first_success if failed is None else None,
            steps=self.steps,
            episode_return=self.episode_return,
            ending=self.ending if failed is None else "error",
            instruction="; ".join([*self.earlier, self.instruction]),
            error=None if failed is None else f"{failed.code}: {failed}",
            seconds=perf_counter() - self.started,
            reset_ms=self.reset_ms,
            env_step_ms=_quantile(self.step_ms, 0.5),
            env_seconds=((self.reset_ms or 0.0) + sum(self.step_ms)) / 1e3,
            acts=len(self.act_ms),
            policy_ms=_quantile(self.act_ms, 0.5),
            policy_p95_ms=_quantile(self.act_ms, 0.95),
            policy_seconds=self.policy_seconds,
            latency_ms=_quantile(self.latency_ms, 0.5),
            ticks_waited=self.ticks_waited,
            ticks_held=self.ticks_held,
            timing_ms={stage: float(np.median(spent)) for stage, spent in sorted(self.timing_ms.items())},
            transport=transport,
            checkpoint=self.checkpoint,
            weights=self.weights,
            revision=self.revision,
            policy_version=self.policy_version,
            policy_fingerprint=self.policy_fingerprint,
            first_policy_version=self.first_policy_version,
            actions_sha256=self.actions.hexdigest(),
        )


def _quantile(milliseconds: list[float], q: float) -> float | None:
    return float(np.quantile(milliseconds, q)) if milliseconds else None
