"""Several episodes at once: a batch of environments, and one question a step to the policy for all of them.

Each episode comes out as `run_episode` would have played it alone, but for the times.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from vlagents_ray.contract import check_action
from vlagents_ray.envs.batch import BatchEnv
from vlagents_ray.errors import CheckpointFailed, ConfigError, PolicyFailed, VLAgentsError
from vlagents_ray.evaluate.episode import (
    EpisodeResult,
    Tally,
    Watch,
    env_options,
    for_policy,
    policy_arguments,
    transport_of,
)
from vlagents_ray.evaluate.jobs import EpisodeKey
from vlagents_ray.evaluate.sides import env_side, policy_side
from vlagents_ray.interface import Act, Agent, Obs

Outcome = EpisodeResult | VLAgentsError
Record = Callable[[int, Obs], None]  # told the number of the key and each of its observations
Executed = Callable[[int, np.ndarray, float, bool], None]  # and each action, its reward, and whether that solved it


def run_episodes(
    env: BatchEnv,
    agent: Agent,
    sessions: Sequence[Agent],
    keys: Sequence[EpisodeKey],
    *,
    execute: int | None = None,
    reset_options: Mapping[str, Any] | None = None,
    policy_options: Mapping[str, Any] | None = None,
    watch: Watch = lambda _phase, _steps: None,
    record: Record = lambda _i, _obs: None,
    executed: Executed = lambda _i, _action, _reward, _success: None,
) -> list[Outcome]:
    """Play the episodes `keys` together, at most `env.num_envs`, each with a session of its own.

    `agent.act_batch` is asked for all sessions that have no rows of a chunk left: `agent` is a
    `RemoteAgent` and `sessions` come from its `sessions(n)`; or it is an initialized policy in this
    process and they are copies of it. An episode that is over stays idle until all are.

    A policy error ends its own episode alone, as in `run_episode`. Where that would raise what is not
    the policy's doing, such as `PolicyUnavailable`, the error stands in place of the result; but
    `EnvFailed` is raised, for it ends all episodes.
    """
    if not len(keys) == len(sessions) <= env.num_envs or not keys:
        raise ConfigError(
            f"got {len(keys)} episodes and {len(sessions)} sessions for {env.num_envs} environments; "
            f"want one session an episode, and an environment for each"
        )
    players = [_Player(i, sessions[i], Tally(key), execute) for i, key in enumerate(keys)]
    _begin(env, players, reset_options, policy_options, watch, record)
    steps = 0
    while playing := [player for player in players if player.outcome is None]:
        watch("policy act", steps)
        _ask(agent, [player for player in playing if not player.rows], env)
        playing = [player for player in playing if player.outcome is None]
        if not playing:
            break
        watch("env step", steps)
        _step(env, players, record, executed)
        steps += 1
    return [player.outcome for player in players if player.outcome is not None]


class _Player:
    """One of the episodes."""

    def __init__(self, number: int, session: Agent, tally: Tally, execute: int | None) -> None:
        self.number = number
        self.session = session
        self.tally = tally
        self.obs = Obs()
        self.rows: deque[np.ndarray] = deque()  # of the last chunk, still to be executed
        self.outcome: Outcome | None = None  # once it is over
        self._execute = execute
        self._last = False  # the policy said that the episode ends with these rows

    def failed(self, error: VLAgentsError) -> None:
        """`error` ended the episode."""
        if isinstance(error, PolicyFailed) and not isinstance(error, CheckpointFailed):
            self.outcome = self.tally.result(transport_of(self.session), error)
        else:
            self.outcome = error

    def answered(self, answer: Act | Exception, env: BatchEnv, milliseconds: float) -> None:
        """The policy's answer to `obs`."""
        try:
            with policy_side("act"):
                if isinstance(answer, Exception):
                    raise answer
            self.tally.acted(answer, milliseconds)
            self.rows.extend(Act(check_action(answer.action, env.contract)).rows()[: self._execute])
            self._last = answer.done
        except VLAgentsError as error:
            self.failed(error)

    def stepped(self, reward: float, terminated: bool, truncated: bool, info: Mapping[str, Any], limit: int) -> None:
        """The env executed the first of `rows`."""
        over = self.tally.stepped(self.rows.popleft(), reward, terminated, truncated, info, limit)
        if not over and self._last and not self.rows:
            self.tally.ending, over = "policy_done", True
        if over:
            self.outcome = self.tally.result(transport_of(self.session))


def _begin(
    env: BatchEnv,
    players: Sequence[_Player],
    reset_options: Mapping[str, Any] | None,
    policy_options: Mapping[str, Any] | None,
    watch: Watch,
    record: Record,
) -> None:
    watch("env reset", 0)
    begun = perf_counter()
    keys = [player.tally.key for player in players]
    with env_side("reset"):
        seen = env.reset(
            seeds=[key.seed for key in keys], options=[env_options(env, key, reset_options) for key in keys]
        )
        instructions = env.instructions
    took_ms = 1e3 * (perf_counter() - begun)
    watch("policy reset", 0)
    for player, obs, instruction in zip(players, seen, instructions, strict=True):
        player.obs, player.tally.instruction, player.tally.reset_ms = obs, instruction, took_ms
        record(player.number, obs)
        given = {**(policy_options or {}), **policy_arguments(env.contract, player.session, player.tally.key)}
        try:
            with policy_side("reset"):
                player.tally.began(player.session.reset(for_policy(obs), instruction, **given))
        except VLAgentsError as error:
            player.failed(error)


def _ask(agent: Agent, players: Sequence[_Player], env: BatchEnv) -> None:
    if not players:
        return
    begun = perf_counter()
    try:
        with policy_side("act"):
            answers = agent.act_batch([for_policy(player.obs) for player in players], [one.session for one in players])
    except VLAgentsError as error:
        answers = [error] * len(players)
    took_ms = 1e3 * (perf_counter() - begun)
    for player, answer in zip(players, answers, strict=True):
        player.answered(answer, env, took_ms)


def _step(env: BatchEnv, players: Sequence[_Player], record: Record, executed: Executed) -> None:
    acts = [Act(player.rows[0]) if player.outcome is None else None for player in players]
    begun = perf_counter()
    with env_side("step"):
        rows = zip(players, *env.step(acts), strict=True)
    took_ms = 1e3 * (perf_counter() - begun)
    for player, obs, reward, terminated, truncated, info in rows:
        if player.outcome is None:
            player.obs = obs
            player.tally.step_ms.append(took_ms)
            record(player.number, obs)
            action = player.rows[0]
            player.stepped(reward, terminated, truncated, info, env.max_steps)
            executed(player.number, action, float(reward), player.tally.success)
