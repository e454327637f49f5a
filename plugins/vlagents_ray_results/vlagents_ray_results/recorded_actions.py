"""Executes the recorded actions of an episode in its environment again, without a policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.envs.base import BatchEnv
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.episode.episode import Diverged, run_episodes
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs


class _RecordedActions(Agent):
    """An agent that returns the actions of an earlier episode, independently of the
    observations.
    """

    def __init__(self, actions: Sequence[np.ndarray]) -> None:
        """Begin with the first action.

        Args:
            actions: The actions of the episode, (D,) each; at least one.
        """
        self._actions = actions
        self._acts = 0

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Continue with the next action: a further task of an episode resets its policy."""
        return {}

    def act(self, obs: Obs) -> Act:
        """Return the next action."""
        action = self._actions[self._acts]
        self._acts += 1
        return Act(action, done=self._acts == len(self._actions))


def execute_actions(
    env: BatchEnv,
    key: EpisodeKey,
    actions: Sequence[np.ndarray],
    *,
    reset_options: Mapping[str, Any] | None,
) -> EpisodeResult:
    """Begin an episode again in the first of these environments, and execute its actions without
    rendering.

    Args:
        env: The environments.
        key: The key of the episode.
        actions: Its actions, (D,) each; at least one.
        reset_options: The options of each reset of its suite.

    Returns:
        The result. Its ending is "policy_done" if the environment did not end the episode at the
        last action; it has fewer steps if the environment ended the episode earlier. Its status is
        "policy_error" if an action cannot be executed.

    Raises:
        EnvFailed: The simulator failed or diverged. Other errors of an environment are also raised
            (see `run_episodes`).
    """
    agent = _RecordedActions(actions)
    [outcome] = run_episodes(env, agent, [agent], [key], reset_options=reset_options, images="none")
    if isinstance(outcome, Diverged):
        raise outcome.error
    if isinstance(outcome, VLAgentsError):
        raise outcome
    return outcome
