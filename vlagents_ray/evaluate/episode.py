"""One episode: an env and an agent played against each other. Plain Python, no Ray."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from time import perf_counter
from typing import Any, Literal

import numpy as np

from vlagents_ray.contract import Contract, check_action
from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.batch import BatchEnv
from vlagents_ray.errors import CheckpointFailed, EnvFailed, PolicyFailed
from vlagents_ray.evaluate.clock import Player
from vlagents_ray.evaluate.config import ClockConfig
from vlagents_ray.evaluate.jobs import EpisodeKey
from vlagents_ray.evaluate.sides import env_side, policy_side
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
    latency_ms: float | None = None  # real-time mode: median of what an act counted as
    ticks_waited: int = 0  # real-time mode: steps between an observation and its answer
    ticks_held: int = 0  # those of them for which no row of a chunk was left
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
class Tally:
    """What is known of an episode so far."""

    key: EpisodeKey
    started: float = field(default_factory=perf_counter)
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
    latency_ms: list[float] = field(default_factory=list)
    ticks_waited: int = 0
    ticks_held: int = 0
    timing_ms: dict[str, list[float]] = field(default_factory=dict)

    def began(self, info: object) -> None:
        """The policy's reset returned `info`."""
        named = info.get("checkpoint") if isinstance(info, dict) else None
        self.checkpoint = named if isinstance(named, str) else None

    def acted(self, act: Act, milliseconds: float) -> None:
        """The policy answered, after so long."""
        self.act_ms.append(milliseconds)
        for stage, spent in act.info.get("timing", {}).items():
            if stage.endswith("_ms"):  # the size of a batch stands among them
                self.timing_ms.setdefault(stage, []).append(float(spent))

    def stepped(
        self,
        action: np.ndarray,
        reward: float,
        terminated: bool,
        truncated: bool,
        info: Mapping[str, Any],
        limit: int,
    ) -> bool:
        """`action` was executed; is the episode over, be it at the `limit` of steps?

        `EnvFailed` for a reward that is no number.
        """
        self.steps += 1
        self.actions.update(action.astype("<f4").tobytes())
        if not math.isfinite(reward):  # a simulation that blew up; neither the results file nor JSON has a NaN
            raise EnvFailed(f"env step: got the reward {reward}, want a finite number")
        self.episode_return += float(reward)
        self.success = _success(info)
        if self.success and self.first_success is None:
            self.first_success = self.steps
        over = terminated or truncated or self.steps >= limit
        if over:
            self.ending = "terminated" if terminated else "truncated"
        return over

    def result(self, transport: str, failed: PolicyFailed | None = None) -> EpisodeResult:
        """The episode's, now that it is over; `failed` is what the policy ended it with."""
        return EpisodeResult(
            key=self.key,
            status="done" if failed is None else "policy_error",
            success_once=self.first_success is not None and failed is None,
            success_at_end=self.success and failed is None,
            first_success=self.first_success if failed is None else None,
            steps=self.steps,
            episode_return=self.episode_return,
            ending=self.ending if failed is None else "error",
            instruction=self.instruction,
            error=None if failed is None else f"{failed.code}: {failed}",
            seconds=perf_counter() - self.started,
            reset_ms=self.reset_ms,
            env_step_ms=_quantile(self.step_ms, 0.5),
            acts=len(self.act_ms),
            policy_ms=_quantile(self.act_ms, 0.5),
            policy_p95_ms=_quantile(self.act_ms, 0.95),
            latency_ms=_quantile(self.latency_ms, 0.5),
            ticks_waited=self.ticks_waited,
            ticks_held=self.ticks_held,
            timing_ms={stage: float(np.median(spent)) for stage, spent in sorted(self.timing_ms.items())},
            transport=transport,
            checkpoint=self.checkpoint,
            actions_sha256=self.actions.hexdigest(),
        )


def run_episode(
    env: EvalEnv,
    agent: Agent,
    key: EpisodeKey,
    *,
    execute: int | None = None,
    clock: ClockConfig | None = None,
    reset_options: Mapping[str, Any] | None = None,
    policy_options: Mapping[str, Any] | None = None,
    watch: Watch = lambda _phase, _steps: None,
    record: Record = lambda _obs: None,
    images: bool = True,
    executed: Executed = lambda _action, _reward, _success: None,
) -> EpisodeResult:
    """Play the episode `key`; of each action chunk execute the first `execute` rows, open loop.

    The env waits for the policy, unless there is a `clock` (see `vlagents_ray.evaluate.clock`).

    `reset_options` are the env's, `policy_options` the policy's. Without `images`, `record` wants none, and the env is
    spared those between two questions.

    A policy that raises or returns an unusable action ends its episode with status
    "policy_error". Whatever is not the policy's doing is raised: `EnvFailed` for the simulator,
    `PolicyUnavailable`, `DeadlineExceeded` and the like for the way to the policy, and
    `CheckpointFailed`, as no episode was played by what did not load.
    """
    tally = Tally(key)
    error: PolicyFailed | None = None
    try:
        _play(env, agent, tally, execute, clock, reset_options, policy_options, watch, record, images, executed)
    except CheckpointFailed:
        raise
    except PolicyFailed as failed:
        error = failed
    return tally.result(transport_of(agent), error)


def _play(
    env: EvalEnv,
    agent: Agent,
    tally: Tally,
    execute: int | None,
    clock: ClockConfig | None,
    reset_options: Mapping[str, Any] | None,
    policy_options: Mapping[str, Any] | None,
    watch: Watch,
    record: Record,
    images: bool,
    executed: Executed,
) -> None:
    watch("env reset", 0)
    key = tally.key
    begun = perf_counter()
    with env_side("reset"):
        obs, _ = env.reset(seed=key.seed, options=env_options(env, key, reset_options))
        tally.instruction = env.instruction
    tally.reset_ms = 1e3 * (perf_counter() - begun)
    record(obs)
    watch("policy reset", 0)
    with policy_side("reset"):
        given = {**(policy_options or {}), **policy_arguments(env.contract, agent, key)}
        tally.began(agent.reset(for_policy(obs), tally.instruction, **given))
    contract = env.contract
    player = Player(execute, clock, contract)
    while True:
        watch("policy act", tally.steps)
        begun = perf_counter()
        with policy_side("act"):
            act = agent.act(for_policy(obs, player.told()))
        took_s = perf_counter() - begun
        tally.acted(act, 1e3 * took_s)
        latency_s = player.latency_s(took_s)
        if clock is not None:
            tally.latency_ms.append(1e3 * latency_s)
        rows = Act(check_action(act.action, contract)).rows()
        ticks = list(player.ticks(rows, latency_s))
        for i, tick in enumerate(ticks):
            watch("env step", tally.steps)
            env.looked_at = images or i == len(ticks) - 1
            begun = perf_counter()
            with env_side("step"):
                obs, reward, terminated, truncated, info = env.step(Act(tick.action))
            tally.step_ms.append(1e3 * (perf_counter() - begun))
            record(obs)
            tally.ticks_waited += tick.waited
            tally.ticks_held += tick.held
            over = tally.stepped(tick.action, reward, terminated, truncated, info, env.max_steps)
            executed(tick.action, float(reward), tally.success)
            if over:
                return
        if act.done:
            tally.ending = "policy_done"
            return


def is_remote(agent: Agent) -> bool:
    """Does the policy run elsewhere? Then its server says what it is, as `metadata`."""
    return hasattr(agent, "metadata")


def transport_of(agent: Agent) -> str:
    """What carries an agent's observations: "local" for one in this process."""
    return str(getattr(agent, "transport", "local"))


def env_options(env: EvalEnv | BatchEnv, key: EpisodeKey, options: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """What the env's reset is given for the episode `key`: the user's `options` go before the benchmark's."""
    begin = {} if env.init_states is None else {"init_state": key.episode % env.init_states}
    return begin | dict(options or {}) or None


def policy_arguments(contract: Contract, agent: Agent, key: EpisodeKey) -> dict[str, Any]:
    """What the policy's reset is given for the episode `key` of an env with this contract."""
    arguments: dict[str, Any] = {"seed": key.seed, "env": key.env}
    if is_remote(agent):
        arguments["contract"] = contract.to_json()  # the server compares it too, and answers 409
    return arguments


def for_policy(obs: Obs, told: Mapping[str, Any] | None = None) -> Obs:
    """The observation without the views that are for the record only, and with what it is `told` besides."""
    if HIGH_RES not in obs.info and not told:
        return obs
    return replace(obs, info={k: v for k, v in obs.info.items() if k != HIGH_RES} | dict(told or {}))


def _success(info: Mapping[str, Any]) -> bool:
    if "success" not in info:
        raise EnvFailed(f"env step: got info with {sorted(info)}, want 'success' among it; see EvalEnv.step")
    return bool(info["success"])


def _quantile(milliseconds: list[float], q: float) -> float | None:
    return float(np.quantile(milliseconds, q)) if milliseconds else None
