"""The loop of episodes, in which an agent acts in environments. It does not need Ray.

The episodes of a batch run in lockstep: at each step, one request to the policy contains the
observations of all environments that need an action. A single environment is a batch of one. Each
episode has the same result as if it ran alone, except for the times.
"""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any, Literal

import numpy as np

from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.chunking.timeliness import Timeliness
from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import ERROR, BatchEnv, Environment
from vlagents_ray.errors import (
    ConfigError,
    EnvFailed,
    InvalidAction,
    PolicyFailed,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.evaluate.episode import failures
from vlagents_ray.evaluate.episode.latency import ChunkExecutor, Tick
from vlagents_ray.evaluate.episode.records import (
    Ending,
    EpisodeObserver,
    EpisodeResult,
    start_of,
    version_of,
)
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import POLICY, Act, Agent, Obs
from vlagents_ray.validation import check_action

_LITTLE_ENDIAN = np.dtype("<f4")
_FIELDS_OF_RESULT = (  # names of the fields that `EpisodeStats` and `EpisodeResult` share
    "key",
    "steps",
    "episode_return",
    "reset_ms",
    "policy_seconds",
    "ticks_waited",
    "checkpoint",
    "weights",
    "revision",
    "policy_version",
    "policy_fingerprint",
    "first_policy_version",
    "start",
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
    instructions: list[str] = field(
        default_factory=list
    )  # instruction of each task so far; the last one is current
    checkpoint: str | None = None
    weights: str | None = None
    revision: str | None = None
    policy_version: int | None = None
    policy_fingerprint: str | None = None
    first_policy_version: int | None = None
    actions: Any = field(default_factory=hashlib.sha256)  # digest of the executed actions
    reset_ms: float | None = None
    start: str | None = None  # name of the initial state, see `start_of`
    step_ms: list[float] = field(default_factory=list)
    act_ms: list[float] = field(default_factory=list)
    policy_seconds: float = 0.0
    latency_ms: list[float] = field(default_factory=list)
    ticks_waited: int = 0
    timeliness: Timeliness | None = None  # None if the environment waits for the policy
    timing_ms: dict[str, list[float]] = field(default_factory=dict)

    def began(self, info: object) -> None:
        """Record the checkpoint and the weights that the policy's reset returned."""
        fields_of_info = info if isinstance(info, dict) else {}
        for name in ("checkpoint", "weights", "revision"):
            value = fields_of_info.get(name)
            setattr(self, name, value if isinstance(value, str) else None)

    def acted(self, act: Act, seconds: float, latency_s: float | None) -> None:
        """Record an answer of the policy, its duration and, in real-time mode, its latency."""
        self.act_ms.append(1e3 * seconds)
        if latency_s is not None:
            self.latency_ms.append(1e3 * latency_s)

        timing = act.info.get("timing", {})
        # An answer counts only its share of a batch's time; a policy in this process computes
        # during the whole wait.
        computed_ms = timing.get("inference_ms", 1e3 * seconds)
        self.policy_seconds += computed_ms / 1e3 / max(1, timing.get("batch_size", 1))
        for stage, value in timing.items():
            if stage.endswith("_ms"):  # the batch size is not a duration
                self.timing_ms.setdefault(stage, []).append(float(value))

        version = version_of(act)
        if version is not None:
            self.policy_version = version
            self.policy_fingerprint = act.info[POLICY].get("fingerprint") or None
            if self.first_policy_version is None:
                self.first_policy_version = version

    def result(self, transport: str, failed: PolicyFailed | None = None) -> EpisodeResult:
        """Return the result of the finished episode; `failed` is the policy error that ended it,
        if any.
        """
        seconds = perf_counter() - self.started
        common = {name: getattr(self, name) for name in _FIELDS_OF_RESULT}
        time_share = {} if self.timeliness is None else self.timeliness.time_share._asdict()
        medians_ms = {
            stage: float(np.median(times)) for stage, times in sorted(self.timing_ms.items())
        }

        result = EpisodeResult(
            **common,
            **time_share,
            status="done",
            success_once=self.first_success is not None,
            success_at_end=self.success,
            first_success=self.first_success,
            ending=self.ending,
            instruction="; ".join(self.instructions),
            seconds=seconds,
            env_step_ms=_quantile(self.step_ms, 0.5),
            env_seconds=((self.reset_ms or 0.0) + sum(self.step_ms)) / 1e3,
            acts=len(self.act_ms),
            policy_ms=_quantile(self.act_ms, 0.5),
            policy_p95_ms=_quantile(self.act_ms, 0.95),
            latency_ms=_quantile(self.latency_ms, 0.5),
            timing_ms=medians_ms,
            transport=transport,
            actions_sha256=self.actions.hexdigest(),
        )
        if failed is None:
            return result

        return replace(
            result,
            status="policy_error",
            success_once=False,
            success_at_end=False,
            first_success=None,
            ending="error",
            error=f"{failed.code}: {failed}",
        )


def _quantile(milliseconds: list[float], q: float) -> float | None:
    return float(np.quantile(milliseconds, q)) if milliseconds else None


Phase = Literal["idle", "connect", "make", "env reset", "policy reset", "policy act", "env step"]


@dataclass(frozen=True, slots=True)
class Diverged:
    """The outcome of an episode whose simulation diverged.

    The state or the reward is not a finite number, or the simulator raised an exception that
    reports the divergence.
    """

    error: VLAgentsError
    # The result that applies if no attempt succeeds, since the policy is then the cause.
    result: EpisodeResult


Outcome = EpisodeResult | VLAgentsError | Diverged
# The observations whose images are used: "all"; "requested", those for which an action is
# requested; or "none", if the agent repeats recorded actions.
Images = Literal["all", "requested", "none"]
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
    checkpoint: str | None = None,
    observers: Sequence[EpisodeObserver] = (),
    watch: Watch = lambda _phase, _steps: None,
    images: Images = "all",
) -> list[Outcome]:
    """Run the episodes `keys` together, at most `env.num_envs`, each with its own session.

    `agent.act_batch` is called for all sessions that have no rows of a chunk left. Either `agent`
    is a `RemoteAgent` and `sessions` are results of its `sessions(n)`, or `agent` is an initialized
    policy in this process and `sessions` are copies of it. A single session may be `agent` itself;
    then its `act` is called. A finished episode is idle until all episodes are finished. In an
    environment with `several_tasks`, the policy is reset with each further instruction.

    Args:
        sessions: The session of each episode.
        keys: Environment, number and seed of each episode.
        execute: The number of rows of each action chunk that are executed, open loop; None: all,
            or as the mode of the clock requires.
        clock: The real-time mode, in which simulated time passes while the policy computes (see
            `latency`); None: the environments wait for the policy.
        reset_options: The options of each reset of an environment.
        policy_options: The options of each reset of the policy.
        checkpoint: The name of the checkpoint with which the policy must begin each episode; None
            for any.
        observers: The observer of each episode; may be empty.
        watch: Called before each phase that may take a long time.
        images: The observations whose images are used; the environments may leave out all other
            images.

    Returns:
        An outcome for each key. A policy error ends only its own episode, with status
        "policy_error". If an episode failed with another error, such as `PolicyUnavailable`, the
        outcome is this error; if its simulation diverged, the outcome is `Diverged`.

    Raises:
        ConfigError: The numbers of episodes and sessions differ, or there are too few environments.
        EnvFailed: The simulator of all environments broke, which ends all episodes.
        InvalidAction: An action does not fit one of several environments that one simulator runs.
    """
    if not len(keys) == len(sessions) <= env.num_envs or not keys:
        raise ConfigError(
            f"expected one session for each episode, and at most {env.num_envs} episodes, as "
            f"there are environments, got {len(keys)} episodes and {len(sessions)} sessions"
        )

    # Reset the environments.
    watch("env reset", 0)
    start = perf_counter()
    with failures.env_side("reset"):
        contract = env.contract
        seeds = [key.seed for key in keys]
        options = [options_of_reset(env, key.episode, reset_options) for key in keys]
        returned = env.reset(seeds=seeds, options=options)
        observations = []
        instructions = []
        for obs, text in zip(returned, env.instructions, strict=True):
            observations.append(
                failures.checked_obs(obs, contract, "reset", images=images != "none")
            )
            instructions.append(failures.checked_instruction(text, "reset"))
    reset_ms = 1e3 * (perf_counter() - start)

    if clock is not None:
        # The mode and the settings that a robot with this policy has.
        choice = choose_for(agent, **clock.choice(execute, contract.control_hz))
        clock, execute = clock.chosen(choice), choice.settings.execute

    def new_executor(last: np.ndarray | None) -> ChunkExecutor:
        return ChunkExecutor(execute, clock, contract, last)

    observers = observers or [EpisodeObserver()] * len(keys)
    episodes: list[_Episode] = []
    for key, session, observer, obs, text, reset_option in zip(
        keys, sessions, observers, observations, instructions, options, strict=True
    ):
        observer.add_observation(obs)
        observer.add_instruction(text)
        timeliness = None if clock is None else Timeliness()
        stats = EpisodeStats(
            key,
            start,
            instructions=[text],
            reset_ms=reset_ms,
            start=start_of(obs, text, reset_option),
            timeliness=timeliness,
        )
        episodes.append(_Episode(len(episodes), session, stats, observer, new_executor, obs))

    watch("policy reset", 0)
    _reset_policy(agent, episodes, contract, policy_options or {}, checkpoint)

    # Run until all episodes are finished.
    steps = 0
    playing = _unfinished(episodes)
    while playing:
        requesting = [episode for episode in playing if not episode.ticks]
        if requesting:
            watch("policy act", steps)
            _request_actions(agent, requesting, contract)
            playing = _unfinished(playing)
            if not playing:
                break

        watch("env step", steps)
        some_request_next = any(len(episode.ticks) == 1 for episode in playing)
        is_requested = some_request_next and steps + 1 < env.max_steps
        env.looked_at = images == "all" or (images == "requested" and is_requested)
        _step(env, episodes, playing, contract)
        steps += 1
        playing = _unfinished(playing)

        if env.several_tasks:
            instructed = _instructed(env, playing)
            if instructed:
                watch("policy reset", steps)
                _reset_policy(agent, instructed, contract, policy_options or {}, checkpoint)
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
    new_executor: Callable[[np.ndarray | None], ChunkExecutor]
    obs: Obs  # the newest observation
    ticks: deque[Tick] = field(default_factory=deque)  # ticks to execute before the next request
    outcome: Outcome | None = None  # set once the episode is over
    _executor: ChunkExecutor = field(init=False)
    _width: int | None = None  # number of values in an action
    _last: np.ndarray | None = None  # the last executed action, (D,)

    def __post_init__(self) -> None:
        self._executor = self.new_executor(None)

    def began(self, answer: dict[str, Any] | Exception, checkpoint: str | None) -> None:
        """Begin the episode, with the policy's answer to the reset of the session, unless the
        policy has another checkpoint than `checkpoint`.
        """
        try:
            with failures.policy_side("reset"):
                if isinstance(answer, Exception):
                    raise answer
                self.stats.began(answer)
            if checkpoint is not None and self.stats.checkpoint != checkpoint:
                # The server may be loading the checkpoint, so the episode is repeated.
                raise PolicyUnavailable(
                    f"reset: expected an episode with the checkpoint {checkpoint!r}, got one with "
                    f"{self.stats.checkpoint!r}; let only this evaluation change the server"
                )
        except VLAgentsError as error:
            self.failed(error)

    def instructed(self, instruction: str) -> None:
        """Begin a further task, and drop the remaining plan of the previous task."""
        self.stats.instructions.append(instruction)
        self.observer.add_instruction(instruction)
        self.ticks.clear()
        self._executor = self.new_executor(self._last)

    def request(self) -> Obs:
        """Return the newest observation, with the entries that observer and executor add to its
        info.
        """
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
            # The contract of the environment may not declare a size.
            if self._width not in (None, rows.shape[1]):
                raise InvalidAction(
                    f"action: expected {self._width} numbers in each row, as in the first action, "
                    f"got shape {rows.shape}"
                )
            self._width = rows.shape[1]

            ticks = list(
                self._executor.ticks(rows, latency_s or 0.0, answer.info, done=answer.done)
            )
            self.observer.add_act(answer, sum(tick.waited for tick in ticks))
            self.ticks.extend(ticks)
        except VLAgentsError as error:
            self.failed(error)

    def stepped(self, step: failures.EnvStep, limit: int) -> None:
        """Record that the next of `ticks` was executed, and set the outcome if the episode is over,
        e.g. at the `limit` of steps.
        """
        self.observer.add_observation(step.obs)
        self.obs, stats = step.obs, self.stats
        tick = self._executed()
        stats.episode_return += step.reward
        stats.success = step.success
        if stats.success and stats.first_success is None:
            stats.first_success = stats.steps

        is_over = True
        if step.terminated:
            stats.ending = "terminated"
        elif step.truncated or stats.steps >= limit:
            stats.ending = "truncated"
        elif tick.done:
            stats.ending = "policy_done"
        else:
            is_over = False
        if is_over:
            self.outcome = stats.result(transport_of(self.session))
        self.observer.add_action(tick.action, step.reward, step.success)

    def _executed(self) -> Tick:
        """Count the next of `ticks`, which the environment has executed, and return it."""
        tick, stats = self.ticks.popleft(), self.stats
        self._last = tick.action
        stats.steps += 1
        stats.ticks_waited += tick.waited
        if stats.timeliness is not None:
            stats.timeliness.add(
                in_time=not tick.starved, age_ms=tick.age_ms, is_careful=tick.careful
            )
        stats.actions.update(tick.action.astype(_LITTLE_ENDIAN, copy=False).tobytes())
        return tick

    def diverged(self, error: VLAgentsError) -> None:
        """End the episode, because the simulation diverged at the next of `ticks`."""
        self._executed()
        cause = PolicyFailed(f"the simulation diverged, and again when it was repeated: {error}")
        self.outcome = Diverged(error, self.stats.result(transport_of(self.session), cause))

    def failed(self, error: VLAgentsError) -> None:
        """End the episode with an error; an error of the policy is recorded as a result."""
        if isinstance(error, PolicyFailed):
            self.outcome = self.stats.result(transport_of(self.session), error)
        else:
            self.outcome = error


def _instructed(env: BatchEnv, playing: Sequence[_Episode]) -> list[_Episode]:
    """Return the episodes whose environment has a further task."""
    instructed = []
    with _STEPPING:
        instructions = env.instructions if playing else []
        for episode in playing:
            instruction = instructions[episode.number]
            if instruction != episode.stats.instructions[-1]:
                episode.instructed(failures.checked_instruction(instruction, "step"))
                instructed.append(episode)
    return instructed


def _reset_policy(
    agent: Agent,
    episodes: Sequence[_Episode],
    contract: Contract,
    options: Mapping[str, Any],
    checkpoint: str | None,
) -> None:
    """Reset the session of each episode with its observation, in one message to a server."""
    keys = [episode.stats.key for episode in episodes]
    sessions = [episode.session for episode in episodes]
    observations = [episode.obs for episode in episodes]
    instructions = [episode.stats.instructions[-1] for episode in episodes]
    seeds = [key.seed if key.policy_seed is None else key.policy_seed for key in keys]
    all_options = {**options, "env": keys[0].env}
    if hasattr(agent, "metadata"):  # a server also compares the contracts, and may answer 409
        all_options["contract"] = contract.to_json()

    answers: list[dict[str, Any] | Exception] = []
    if isinstance(agent, RemoteAgent):
        try:
            answers = agent.reset_batch(
                observations,
                instructions,
                sessions,  # type: ignore[arg-type]
                seeds=seeds,
                **all_options,
            )
        except VLAgentsError as error:
            answers = [error] * len(episodes)
    else:
        for session, obs, text, seed in zip(
            sessions, observations, instructions, seeds, strict=True
        ):
            try:
                answers.append(session.reset(obs, text, **{**all_options, "seed": seed}))
            except Exception as error:  # noqa: BLE001 - becomes the outcome of the episode
                answers.append(error)

    for episode, answer in zip(episodes, answers, strict=True):
        episode.began(answer, checkpoint)


def _request_actions(agent: Agent, episodes: Sequence[_Episode], contract: Contract) -> None:
    """Request an action for each episode, all in one call of the policy."""
    start = perf_counter()
    try:
        with _ACTING:
            requests = [episode.request() for episode in episodes]
            if len(episodes) == 1 and episodes[0].session is agent:
                answers: list[Act | Exception] = [agent.act(requests[0])]
            else:
                answers = agent.act_batch(requests, [episode.session for episode in episodes])
            if len(answers) != len(episodes):
                raise PolicyFailed(
                    f"act_batch: expected {len(episodes)} actions, one for each observation, got "
                    f"{len(answers)}"
                )
    except VLAgentsError as error:
        answers = [error] * len(episodes)
    seconds = perf_counter() - start

    for episode, answer in zip(episodes, answers, strict=True):
        episode.answered(answer, contract, seconds)


def _step(
    env: BatchEnv, episodes: Sequence[_Episode], playing: Sequence[_Episode], contract: Contract
) -> None:
    """Execute the next tick of each running episode; finished episodes are idle in the same
    step.
    """
    acts: list[Act | None] = []
    for episode in episodes:
        is_playing = episode.outcome is None
        acts.append(Act(episode.ticks[0].action) if is_playing else None)

    start = perf_counter()
    try:
        with _STEPPING:
            observations, rewards, terminated, truncated, infos = env.step(acts)
            outputs = list(
                zip(episodes, observations, rewards, terminated, truncated, infos, strict=True)
            )
    except (EnvFailed, InvalidAction) as error:
        # One simulator runs all environments, so the error does not identify the episode.
        if len(playing) > 1:
            raise
        if failures.raised_by_divergence(error):
            playing[0].diverged(error)
            return
        if isinstance(error, EnvFailed):
            raise
        playing[0].failed(error)
        return
    step_ms = 1e3 * (perf_counter() - start)

    for episode, obs, reward, is_terminated, is_truncated, info in outputs:
        if episode.outcome is not None:
            continue
        raised = info.get(ERROR) if isinstance(info, Mapping) else None
        try:
            with _STEPPING:
                if isinstance(raised, BaseException):
                    raise raised
            step = failures.checked_step(
                obs, reward, is_terminated, is_truncated, info, contract, images=env.looked_at
            )
        except VLAgentsError as error:
            is_finite = raised is not None or failures.is_finite(obs, reward)
            if not is_finite or failures.raised_by_divergence(error):
                episode.diverged(error)
            else:
                episode.failed(error)
            continue
        episode.stats.step_ms.append(step_ms)
        episode.stepped(step, env.max_steps)


def transport_of(agent: Agent) -> str:
    """Return the transport of an agent's observations: "local" for an agent in this process."""
    return str(getattr(agent, "transport", "local"))


def options_of_reset(
    env: Environment, episode: int, options: Mapping[str, Any] | None
) -> dict[str, Any] | None:
    """Return the options for the environment's reset: the user's `options` override the benchmark's
    options.
    """
    of_benchmark = {} if env.init_states is None else {"init_state": episode % env.init_states}
    return of_benchmark | dict(options or {}) or None
