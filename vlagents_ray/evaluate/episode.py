"""One episode: an env and an agent played against each other. Plain Python, no Ray."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from time import perf_counter
from typing import Any, Literal

import numpy as np

from vlagents_ray.contract import check_action
from vlagents_ray.envs import EvalEnv
from vlagents_ray.errors import CheckpointFailed, EnvFailed, PolicyFailed, VLAgentsError
from vlagents_ray.evaluate.jobs import EpisodeKey
from vlagents_ray.interface import HIGH_RES, Act, Agent, Obs

Status = Literal["done", "policy_error", "infra_failed"]
Ending = Literal["terminated", "truncated", "policy_done", "error"]
Phase = Literal["idle", "connect", "make", "env reset", "policy reset", "policy act", "env step"]
Watch = Callable[[Phase, int], None]  # told the phase and the number of steps so far
Record = Callable[[Obs], None]  # told every observation, the first one included
Executed = Callable[[np.ndarray, float, bool], None]  # told every action, (D,), its reward, and whether it succeeded


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """What came of an episode. Infrastructure failures have no success, neither True nor False."""

    key: EpisodeKey
    status: Status
    success_once: bool | None = None  # the task was solved after some step
    success_at_end: bool | None = None  # the task was solved after the last step
    first_success: int | None = None  # steps after which the task was solved for the first time
    steps: int = 0  # actions executed
    episode_return: float = 0.0  # sum of rewards
    ending: Ending = "error"
    instruction: str = ""
    error: str | None = None
    seconds: float = 0.0  # from reset to the last step
    reset_ms: float | None = None  # of the env
    env_step_ms: float | None = None  # median
    acts: int = 0  # answers of the policy; fewer than steps with action chunks
    policy_ms: float | None = None  # median of one act, transport included
    policy_p95_ms: float | None = None
    timing_ms: dict[str, float] = field(default_factory=dict)  # medians of what `act.info["timing"]` says of one act
    transport: str = "local"
    checkpoint: str | None = None  # that the policy's reset named
    actions_sha256: str | None = None  # of the actions as executed, (steps, D) little-endian float32, row by row

    @property
    def outcome(self) -> dict[str, Any]:
        """What two runs of one key must have in common: all but how long it took, and the way to the policy."""
        return {one.name: getattr(self, one.name) for one in fields(self) if one.name not in _CIRCUMSTANCES}


_CIRCUMSTANCES = {"seconds", "reset_ms", "env_step_ms", "policy_ms", "policy_p95_ms", "timing_ms", "transport"}


@dataclass(slots=True)
class _Tally:
    """What is known of an episode so far."""

    steps: int = 0
    episode_return: float = 0.0
    success: bool = False
    first_success: int | None = None
    ending: Ending = "error"
    instruction: str = ""
    checkpoint: str | None = None
    actions: Any = field(default_factory=hashlib.sha256)  # that were executed
    reset_ms: float | None = None
    step_ms: list[float] = field(default_factory=list)
    act_ms: list[float] = field(default_factory=list)
    timing_ms: dict[str, list[float]] = field(default_factory=dict)


def run_episode(
    env: EvalEnv,
    agent: Agent,
    key: EpisodeKey,
    *,
    execute: int | None = None,
    reset_options: Mapping[str, Any] | None = None,
    policy_options: Mapping[str, Any] | None = None,
    watch: Watch = lambda _phase, _steps: None,
    record: Record = lambda _obs: None,
    executed: Executed = lambda _action, _reward, _success: None,
) -> EpisodeResult:
    """Play the episode `key`; of each action chunk execute the first `execute` rows, open loop.

    `reset_options` are the env's, `policy_options` the policy's.

    A policy that raises or returns an unusable action ends its episode with status
    "policy_error". Whatever is not the policy's doing is raised: `EnvFailed` for the simulator,
    `PolicyUnavailable`, `DeadlineExceeded` and the like for the way to the policy, and
    `CheckpointFailed`, as no episode was played by what did not load.
    """
    tally = _Tally()
    started = perf_counter()
    error: str | None = None
    try:
        _play(
            env,
            agent,
            key,
            tally,
            execute=execute,
            reset_options=reset_options,
            policy_options=policy_options,
            watch=watch,
            record=record,
            executed=executed,
        )
    except CheckpointFailed:
        raise
    except PolicyFailed as failed:
        error = f"{failed.code}: {failed}"
        tally.ending = "error"
    return EpisodeResult(
        key=key,
        status="done" if error is None else "policy_error",
        success_once=tally.first_success is not None and error is None,
        success_at_end=tally.success and error is None,
        first_success=tally.first_success if error is None else None,
        steps=tally.steps,
        episode_return=tally.episode_return,
        ending=tally.ending,
        instruction=tally.instruction,
        error=error,
        seconds=perf_counter() - started,
        reset_ms=tally.reset_ms,
        env_step_ms=_quantile(tally.step_ms, 0.5),
        acts=len(tally.act_ms),
        policy_ms=_quantile(tally.act_ms, 0.5),
        policy_p95_ms=_quantile(tally.act_ms, 0.95),
        timing_ms={stage: float(np.median(spent)) for stage, spent in sorted(tally.timing_ms.items())},
        transport=str(getattr(agent, "transport", "local")),
        checkpoint=tally.checkpoint,
        actions_sha256=tally.actions.hexdigest(),
    )


def _play(
    env: EvalEnv,
    agent: Agent,
    key: EpisodeKey,
    tally: _Tally,
    *,
    execute: int | None,
    reset_options: Mapping[str, Any] | None,
    policy_options: Mapping[str, Any] | None,
    watch: Watch,
    record: Record,
    executed: Executed,
) -> None:
    watch("env reset", 0)
    begun = perf_counter()
    with env_side("reset"):
        obs, _ = env.reset(seed=key.seed, options=_begin(env, key, reset_options))
        tally.instruction = env.instruction
    tally.reset_ms = 1e3 * (perf_counter() - begun)
    record(obs)
    watch("policy reset", 0)
    with policy_side("reset"):
        info = agent.reset(_for_policy(obs), tally.instruction, **(policy_options or {}), **_given(env, agent, key))
    named = info.get("checkpoint") if isinstance(info, dict) else None
    tally.checkpoint = named if isinstance(named, str) else None
    contract = env.contract
    while True:
        watch("policy act", tally.steps)
        begun = perf_counter()
        with policy_side("act"):
            act = agent.act(_for_policy(obs))
        tally.act_ms.append(1e3 * (perf_counter() - begun))
        for stage, spent in act.info.get("timing", {}).items():
            tally.timing_ms.setdefault(stage, []).append(float(spent))
        chunk = Act(check_action(act.action, contract)).rows()[:execute]
        for row in chunk:
            watch("env step", tally.steps)
            begun = perf_counter()
            with env_side("step"):
                obs, reward, terminated, truncated, info = env.step(Act(row))
            tally.step_ms.append(1e3 * (perf_counter() - begun))
            record(obs)
            tally.steps += 1
            tally.actions.update(row.astype("<f4").tobytes())
            tally.episode_return += float(reward)
            tally.success = _success(info)
            executed(row, float(reward), tally.success)
            if tally.success and tally.first_success is None:
                tally.first_success = tally.steps
            if terminated or truncated or tally.steps >= env.max_steps:
                tally.ending = "terminated" if terminated else "truncated"
                return
        if act.done:
            tally.ending = "policy_done"
            return


@contextmanager
def env_side(what: str) -> Iterator[None]:
    """Anything that a simulator raises becomes `EnvFailed`; this package's own errors pass."""
    try:
        yield
    except VLAgentsError:
        raise
    except (Exception, SystemExit) as error:  # ManiSkill leaves by SystemExit when an asset is missing
        raise EnvFailed(f"env {what}: {type(error).__name__}: {error}") from error


@contextmanager
def policy_side(what: str) -> Iterator[None]:
    """Anything that a policy raises becomes `PolicyFailed`; this package's own errors pass."""
    try:
        yield
    except VLAgentsError:
        raise
    except Exception as error:
        raise PolicyFailed(f"policy {what}: {type(error).__name__}: {error}") from error


def is_remote(agent: Agent) -> bool:
    """Does the policy run elsewhere? Then its server says what it is, as `metadata`."""
    return hasattr(agent, "metadata")


def _begin(env: EvalEnv, key: EpisodeKey, options: Mapping[str, Any] | None) -> dict[str, Any] | None:
    begin = {} if env.init_states is None else {"init_state": key.episode % env.init_states}
    return begin | dict(options or {}) or None


def _given(env: EvalEnv, agent: Agent, key: EpisodeKey) -> dict[str, Any]:
    arguments: dict[str, Any] = {"seed": key.seed, "env": key.env}
    if is_remote(agent):
        arguments["contract"] = env.contract.to_json()  # the server compares it too, and answers 409
    return arguments


def _for_policy(obs: Obs) -> Obs:
    """The observation without the views that are for the record only."""
    if HIGH_RES not in obs.info:
        return obs
    return replace(obs, info={k: v for k, v in obs.info.items() if k != HIGH_RES})


def _success(info: Mapping[str, Any]) -> bool:
    if "success" not in info:
        raise EnvFailed(f"env step: got info with {sorted(info)}, want 'success' among it; see EvalEnv.step")
    return bool(info["success"])


def _quantile(milliseconds: list[float], q: float) -> float | None:
    return float(np.quantile(milliseconds, q)) if milliseconds else None
