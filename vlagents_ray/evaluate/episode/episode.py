"""The loop of episodes: environments and an agent play against each other. Plain Python, no Ray.

The episodes of a batch are played in lockstep: at each step, one request to the policy serves all
that need an answer. A single environment is a batch of one. Each episode has the same result as if
it were played alone, except for the times."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, Literal

import numpy as np

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import ERROR, BatchEnv, Environment
from vlagents_ray.errors import (
    CheckpointFailed,
    ConfigError,
    EnvFailed,
    InvalidAction,
    PolicyFailed,
    VLAgentsError,
)
from vlagents_ray.evaluate.episode import failures
from vlagents_ray.evaluate.episode.latency import ChunkExecutor, Tick
from vlagents_ray.evaluate.episode.records import Ending, EpisodeObserver, EpisodeResult, version_of
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import POLICY, Act, Agent, Obs
from vlagents_ray.validation import check_action

_LITTLE_ENDIAN = np.dtype("<f4")
_KEPT = (  # what `EpisodeStats` counts as a result has it
    "key",
    "steps",
    "episode_return",
    "reset_ms",
    "policy_seconds",
    "ticks_waited",
    "ticks_held",
    "checkpoint",
    "weights",
    "revision",
    "policy_version",
    "policy_fingerprint",
    "first_policy_version",
)


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
    # One after the other; the last is the present one.
    instructions: list[str] = field(default_factory=list)
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

    def acted(self, act: Act, seconds: float, latency_s: float | None) -> None:
        """Record an answer of the policy, its duration and, in real-time mode, its latency."""
        self.act_ms.append(1e3 * seconds)
        timing = act.info.get("timing", {})
        # Each answer counts its share of a batch; a policy in this process computes during the
        # whole wait.
        computed_ms = timing.get("inference_ms", 1e3 * seconds)
        self.policy_seconds += computed_ms / 1e3 / max(1, timing.get("batch_size", 1))
        for stage, spent in timing.items():
            if stage.endswith("_ms"):  # the batch size is not a time
                self.timing_ms.setdefault(stage, []).append(float(spent))
        if (version := version_of(act)) is not None:
            self.policy_version, self.policy_fingerprint = (
                version,
                act.info[POLICY].get("fingerprint") or None,
            )
            self.first_policy_version = (
                version if self.first_policy_version is None else self.first_policy_version
            )
        if latency_s is not None:
            self.latency_ms.append(1e3 * latency_s)

    def result(self, transport: str, failed: PolicyFailed | None = None) -> EpisodeResult:
        """Return the result of the finished episode; `failed` is the policy error that ended it,
        if any.
        """
        kept = {name: getattr(self, name) for name in _KEPT}
        return EpisodeResult(
            **kept,
            status="done" if failed is None else "policy_error",
            success_once=self.first_success is not None and failed is None,
            success_at_end=self.success and failed is None,
            first_success=self.first_success if failed is None else None,
            ending=self.ending if failed is None else "error",
            instruction="; ".join(self.instructions),
            error=None if failed is None else f"{failed.code}: {failed}",
            seconds=perf_counter() - self.started,
            env_step_ms=_quantile(self.step_ms, 0.5),
            env_seconds=((self.reset_ms or 0.0) + sum(self.step_ms)) / 1e3,
            acts=len(self.act_ms),
            policy_ms=_quantile(self.act_ms, 0.5),
            policy_p95_ms=_quantile(self.act_ms, 0.95),
            latency_ms=_quantile(self.latency_ms, 0.5),
            timing_ms={
                stage: float(np.median(spent)) for stage, spent in sorted(self.timing_ms.items())
            },
            transport=transport,
            actions_sha256=self.actions.hexdigest(),
        )


def _quantile(milliseconds: list[float], q: float) -> float | None:
    return float(np.quantile(milliseconds, q)) if milliseconds else None


Phase = Literal["idle", "connect", "make", "env reset", "policy reset", "policy act", "env step"]


@dataclass(frozen=True, slots=True)
class Diverged:
    """The outcome of an episode whose simulation diverged.

    Its state or its reward is not a finite number, or the simulator raised an exception that says
    so.
    """

    error: VLAgentsError
    # If the policy is the cause, as the simulation diverges again under the same actions.
    result: EpisodeResult


Outcome = EpisodeResult | VLAgentsError | Diverged
# Called with the phase that begins and the number of steps so far.
Watch = Callable[[Phase, int], None]

_ACTING, _STEPPING = failures.policy_side("act"), failures.env_side("step")  # entered at each step


def run_episodes(
    env: BatchEnv,
    agent: Agent,
    sessions: Sequence[Agent],
    keys: Sequence[EpisodeKey],
    *,
    execute: int | None = None,
    clock: ClockConfig | None = None,
    reset_options: Mapping[str, Any] | None = None,
    policy_options: Mapping[str, Any] | None = None,
    observers: Sequence[EpisodeObserver] = (),
    watch: Watch = lambda _phase, _steps: None,
    images: bool = True,
) -> list[Outcome]:
    """Play the episodes `keys` together, at most `env.num_envs`, each with its own session.

    `agent.act_batch` is called for all sessions that have no rows of a chunk left. Either `agent`
    is a `RemoteAgent` and `sessions` come from its `sessions(n)`, or it is an initialized policy in
    this process and they are copies of it. A single session may be `agent` itself, whose `act` is
    then called. A finished episode is idle until all are. The policy is reset with each further
    instruction of an environment with `several_tasks`.

    Args:
        sessions: The session of each episode.
        keys: Environment, number and seed of each episode.
        execute: The rows of each action chunk that are executed, open loop; None: all.
        clock: Real-time mode, in which each episode's time passes while the policy computes (see
            `latency`); None: the environments wait for the policy.
        reset_options: The options of each reset of an environment.
        policy_options: The options of each reset of the policy.
        observers: The observer of each episode, or none.
        watch: Called before each phase that may take long.
        images: Whether the observers need the images of every step. If not, the environments may
            leave out those between two requests to the policy, and after the last step.

    Returns:
        An outcome for each key. A policy error ends only its own episode, with status
        "policy_error". Where an episode failed by another error, such as `PolicyUnavailable`, the
        error stands in place of the result; `Diverged` if its simulation diverged.

    Raises:
        ConfigError: The numbers of episodes and sessions differ, or there are fewer environments.
        EnvFailed: The simulator of all environments broke, which ends all episodes.
        InvalidAction: An action does not fit one of several environments that one simulator runs.
    """
    if not len(keys) == len(sessions) <= env.num_envs or not keys:
        raise ConfigError(
            f"got {len(keys)} episodes and {len(sessions)} sessions for {env.num_envs} "
            "environments; "
            f"want one session an episode, and an environment for each"
        )
    watch("env reset", 0)
    begun = perf_counter()
    with failures.env_side("reset"):
        contract = env.contract
        seen = env.reset(
            seeds=[key.seed for key in keys],
            options=[options_of_reset(env, key.episode, reset_options) for key in keys],
        )
        first = [
            (
                failures.checked_obs(obs, contract, "reset"),
                failures.checked_instruction(text, "reset"),
            )
            for obs, text in zip(seen, env.instructions, strict=True)
        ]
    reset_ms = 1e3 * (perf_counter() - begun)
    executor = partial(ChunkExecutor, execute, clock, contract)
    watched = observers or [EpisodeObserver()] * len(keys)
    episodes = []
    for i, (key, session, observer, (obs, text)) in enumerate(
        zip(keys, sessions, watched, first, strict=True)
    ):
        observer.add_observation(obs)
        stats = EpisodeStats(key, begun, instructions=[text], reset_ms=reset_ms)
        episodes.append(_Episode(i, session, stats, observer, executor, obs))
    watch("policy reset", 0)
    _reset_policy(agent, episodes, contract, policy_options or {})
    steps, playing = 0, _unfinished(episodes)
    while playing:
        if requesting := [episode for episode in playing if not episode.ticks]:
            watch("policy act", steps)
            _request_actions(agent, requesting, contract)
            playing = _unfinished(playing)
        if playing:
            watch("env step", steps)
            asks = steps + 1 < env.max_steps and any(len(episode.ticks) == 1 for episode in playing)
            env.looked_at = images or asks
            _step(env, episodes, playing, contract)
            steps, playing = steps + 1, _unfinished(playing)
            if env.several_tasks and (begun_anew := _instructed(env, playing)):
                watch("policy reset", steps)
                _reset_policy(agent, begun_anew, contract, policy_options or {})
                playing = _unfinished(playing)
    return [episode.outcome for episode in episodes if episode.outcome is not None]


def _unfinished(episodes: Sequence[_Episode]) -> list[_Episode]:
    return [episode for episode in episodes if episode.outcome is None]


@dataclass(slots=True, eq=False)
class _Episode:
    """One of the episodes in lockstep."""

    number: int
    session: Agent
    stats: EpisodeStats
    observer: EpisodeObserver
    new_executor: Callable[[], ChunkExecutor]
    obs: Obs  # the newest
    ticks: deque[Tick] = field(default_factory=deque)  # before the next request
    outcome: Outcome | None = None  # set once the episode is over
    _executor: ChunkExecutor = field(init=False)
    _width: int | None = None  # numbers of an action
    _done: bool = False  # the policy ends the episode with these ticks

    def __post_init__(self) -> None:
        self._executor = self.new_executor()

    def began(self, answer: dict[str, Any] | Exception) -> None:
        """Begin with the policy's answer to the reset of the session."""
        try:
            with failures.policy_side("reset"):
                if isinstance(answer, Exception):
                    raise answer
                self.stats.began(answer)
        except VLAgentsError as error:
            self.failed(error)

    def instructed(self, instruction: str) -> None:
        """Begin a further task, and drop the rest of the plan, which was for the last one."""
        self.stats.instructions.append(instruction)
        self.ticks.clear()
        self._executor, self._done = self.new_executor(), False

    def request(self) -> Obs:
        info = {**self.observer.request_info, **self._executor.request_info()}
        return replace(self.obs, info={**self.obs.info, **info}) if info else self.obs

    def answered(self, answer: Act | Exception, contract: Contract, seconds: float) -> None:
        """Plan the next ticks from the policy's answer, which took `seconds`."""
        try:
            with _ACTING:
                if isinstance(answer, Exception):
                    raise answer
                latency_s = self._executor.latency_s(seconds)
                self.stats.acted(answer, seconds, latency_s)
            rows = Act(check_action(answer.action, contract)).rows()
            # If the environment's contract states no size.
            if self._width not in (None, rows.shape[1]):
                raise InvalidAction(
                    f"action: got {rows.shape}, want {self._width} numbers a row, as in the first"
                )
            self._width = rows.shape[1]
            ticks = list(
                self._executor.ticks(rows, latency_s or 0.0, answer.info, done=answer.done)
            )
            self.observer.add_act(answer, sum(tick.waited for tick in ticks))
            self.ticks.extend(ticks)
            self._done = answer.done
        except VLAgentsError as error:
            self.failed(error)

    def stepped(self, step: failures.EnvStep, limit: int) -> None:
        """Record that the next of `ticks` was executed; the episode may be over, also by the
        `limit` of steps.
        """
        self.observer.add_observation(step.obs)
        self.obs, stats = step.obs, self.stats
        tick = self._executed()
        stats.episode_return += step.reward
        stats.success = step.success
        if stats.success and stats.first_success is None:
            stats.first_success = stats.steps
        if over := step.terminated or step.truncated or stats.steps >= limit:
            stats.ending = "terminated" if step.terminated else "truncated"
        elif over := self._done and not self.ticks:
            stats.ending = "policy_done"
        if over:
            self.outcome = stats.result(transport_of(self.session))
        self.observer.add_action(tick.action, step.reward, step.success)

    def _executed(self) -> Tick:
        """Count the next of `ticks`, which the environment has executed, and return it."""
        tick, stats = self.ticks.popleft(), self.stats
        stats.steps += 1
        stats.ticks_waited += tick.waited
        stats.ticks_held += tick.held
        stats.actions.update(tick.action.astype(_LITTLE_ENDIAN, copy=False).tobytes())
        return tick

    def diverged(self, error: VLAgentsError) -> None:
        """End the episode, as the simulation diverged at the next of `ticks`."""
        self._executed()
        cause = PolicyFailed(f"the simulation diverged, and again under the same actions: {error}")
        self.outcome = Diverged(error, self.stats.result(transport_of(self.session), cause))

    def failed(self, error: VLAgentsError) -> None:
        if isinstance(error, PolicyFailed) and not isinstance(error, CheckpointFailed):
            self.outcome = self.stats.result(transport_of(self.session), error)
        else:
            self.outcome = error


def _instructed(env: BatchEnv, playing: Sequence[_Episode]) -> list[_Episode]:
    """Return the episodes whose environment has a further task."""
    with _STEPPING:
        texts = env.instructions if playing else []
        found = [one for one in playing if texts[one.number] != one.stats.instructions[-1]]
        for episode in found:
            episode.instructed(failures.checked_instruction(texts[episode.number], "step"))
    return found


def _reset_policy(
    agent: Agent, episodes: Sequence[_Episode], contract: Contract, options: Mapping[str, Any]
) -> None:
    """Reset the session of each episode with its observation, in one message to a server."""
    keys, sessions = [one.stats.key for one in episodes], [one.session for one in episodes]
    first, texts = [one.obs for one in episodes], [one.stats.instructions[-1] for one in episodes]
    seeds = [key.seed if key.policy_seed is None else key.policy_seed for key in keys]
    given = {**options, "env": keys[0].env}
    if hasattr(agent, "metadata"):  # a server also compares the contract, and answers 409
        given["contract"] = contract.to_json()
    answers: list[dict[str, Any] | Exception] = []
    if isinstance(agent, RemoteAgent):
        try:
            answers = agent.reset_batch(first, texts, sessions, seeds=seeds, **given)  # type: ignore[arg-type]
        except VLAgentsError as error:
            answers = [error] * len(episodes)
    else:
        for session, obs, text, seed in zip(sessions, first, texts, seeds, strict=True):
            try:
                answers.append(session.reset(obs, text, **{**given, "seed": seed}))
            except Exception as error:  # noqa: BLE001 - becomes the outcome of the episode
                answers.append(error)
    for episode, answer in zip(episodes, answers, strict=True):
        episode.began(answer)


def _request_actions(agent: Agent, episodes: Sequence[_Episode], contract: Contract) -> None:
    begun = perf_counter()
    try:
        with _ACTING:
            requests = [episode.request() for episode in episodes]
            if len(episodes) == 1 and episodes[0].session is agent:
                answers: list[Act | Exception] = [agent.act(requests[0])]
            else:
                answers = agent.act_batch(requests, [episode.session for episode in episodes])
            if len(answers) != len(episodes):
                raise PolicyFailed(
                    f"act_batch: got {len(episodes)} observations, returned {len(answers)} actions"
                )
    except VLAgentsError as error:
        answers = [error] * len(episodes)
    seconds = perf_counter() - begun
    for episode, answer in zip(episodes, answers, strict=True):
        episode.answered(answer, contract, seconds)


def _step(
    env: BatchEnv, episodes: Sequence[_Episode], playing: Sequence[_Episode], contract: Contract
) -> None:
    acts = [
        Act(episode.ticks[0].action) if episode.outcome is None else None for episode in episodes
    ]
    begun = perf_counter()
    try:
        with _STEPPING:
            seen, rewards, terminated, truncated, infos = env.step(acts)
            answers = list(zip(episodes, seen, rewards, terminated, truncated, infos, strict=True))
    except (EnvFailed, InvalidAction) as error:
        # Of environments that one simulator runs: the error does not name the episode.
        if len(playing) > 1:
            raise
        if failures.raised_by_divergence(error):
            playing[0].diverged(error)
            return
        if isinstance(error, EnvFailed):
            raise
        playing[0].failed(error)
        return
    took_ms = 1e3 * (perf_counter() - begun)
    for episode, obs, reward, terminated, truncated, info in answers:
        if episode.outcome is None:
            raised = info.get(ERROR) if isinstance(info, Mapping) else None
            try:
                with _STEPPING:
                    if isinstance(raised, BaseException):
                        raise raised
                step = failures.checked_step(
                    obs, reward, terminated, truncated, info, contract, images=env.looked_at
                )
            except VLAgentsError as error:
                finite = raised is not None or failures.is_finite(obs, reward)
                if not finite or failures.raised_by_divergence(error):
                    episode.diverged(error)
                else:
                    episode.failed(error)
                continue
            episode.stats.step_ms.append(took_ms)
            episode.stepped(step, env.max_steps)


def transport_of(agent: Agent) -> str:
    """Return the transport of an agent's observations: "local" for one in this process."""
    return str(getattr(agent, "transport", "local"))


def options_of_reset(
    env: Environment, episode: int, options: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Return the options for the environment's reset: the user's `options` override the
    benchmark's.
    """
    begin = {} if env.init_states is None else {"init_state": episode % env.init_states}
    return begin | dict(options or {}) or None
