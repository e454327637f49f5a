"""Executes the recorded actions of an episode in its environment again, without a policy, and
compares the result with the recording.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.envs.base import BatchEnv, make_batch
from vlagents_ray.errors import EnvFailed, VLAgentsError
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.evaluate.episode.episode import Diverged, run_episodes
from vlagents_ray.evaluate.episode.failures import env_side
from vlagents_ray.evaluate.episode.records import Ending, EpisodeObserver, EpisodeResult
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.results.reader import CaseResults, Episode
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


@dataclass(frozen=True, slots=True)
class Replayed:
    """The result of executing recorded actions in an environment here, compared with the recording
    step by step.
    """

    success: list[bool]  # success after each step
    ending: Ending
    instruction: str  # the instructions; several are joined with semicolons
    # The largest difference of a number, for each step that differs; step 0 is the reset.
    differences: dict[int, float]
    described: Mapping[str, Any]  # the description of the environment here


def replay_actions(case: CaseResults, episode: Episode, trajectory: Trajectory) -> Replayed:
    """Execute the actions of `trajectory` in the environment of `case`, beginning with the
    episode's seed.

    State, gripper, rewards and success are compared bit by bit; images are neither rendered nor
    compared.

    Raises:
        ConfigError: The environment rejects these options, or is unknown here; also
            `MissingDependency`.
        EnvFailed: The simulator failed or diverged, or the episode ended before its last action.
    """
    with env_side("make"):
        env = make_batch(case.env, 1, **(case.settings.get("env_options") or {}))
    try:
        comparison = _Comparison(trajectory)
        result = _execute(
            env,
            episode.result.key,
            list(trajectory.actions),
            comparison,
            reset_options=case.settings.get("reset_options"),
        )
        with env_side("describe"):
            described = env.describe()
        return Replayed(
            comparison.success,
            result.ending,
            result.instruction,
            comparison.differences,
            described,
        )
    finally:
        with env_side("close"):
            env.close()


def _execute(
    env: BatchEnv,
    key: EpisodeKey,
    actions: Sequence[np.ndarray],
    observer: EpisodeObserver,
    *,
    reset_options: Mapping[str, Any] | None,
) -> EpisodeResult:
    """Begin an episode again in the first of these environments, and execute its actions without
    rendering.

    Args:
        env: The environments.
        key: The key of the episode.
        actions: Its actions, (D,) each; at least one.
        observer: Receives the observations and the outcome of each action.
        reset_options: The options of each reset of its suite.

    Returns:
        The result of the episode, in which all actions were executed.

    Raises:
        EnvFailed: The simulator failed or diverged, or the episode ended before its last action.
    """
    agent = _RecordedActions(actions)
    [outcome] = run_episodes(
        env,
        agent,
        [agent],
        [key],
        reset_options=reset_options,
        observers=[observer],
        images="none",
    )
    if isinstance(outcome, Diverged):
        raise outcome.error
    if isinstance(outcome, VLAgentsError):
        raise outcome
    if outcome.status != "done":
        raise EnvFailed(f"the actions cannot be executed again: {outcome.error}")
    if outcome.steps != len(actions):
        raise EnvFailed(f"the episode ended after {outcome.steps} of {len(actions)} actions")
    return outcome


class _Comparison(EpisodeObserver):
    """Compares an episode with its recording, step by step."""

    def __init__(self, recorded: Trajectory) -> None:
        self.success: list[bool] = []  # success after each step
        # The largest difference of a number, for each step that differs; step 0 is the reset.
        self.differences: dict[int, float] = {}
        self._recorded = recorded
        self._obs: Obs | None = None  # the newest observation

    def add_observation(self, obs: Obs) -> None:
        """Compare the observation of the reset; the observation of a step is compared together with
        the step's outcome.
        """
        if self._obs is None:
            self._note(0, _difference(self._recorded, 0, obs, None))
        self._obs = obs

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Compare a step: its observation and its outcome."""
        self.success.append(success)
        number = len(self.success)
        if self._obs is not None:
            outcome = (reward, success)
            self._note(number, _difference(self._recorded, number, self._obs, outcome))

    def _note(self, number: int, difference: float | None) -> None:
        if difference is not None:
            self.differences[number] = difference


def _difference(
    recorded: Trajectory, number: int, obs: Obs, outcome: tuple[float, bool] | None
) -> float | None:
    """Return the largest difference of the numbers of a step or the reset; None if they are
    bit-identical.

    The difference is infinite if names or shapes differ, and 0 if only the success differs.

    Args:
        recorded: The recording.
        number: The number of steps so far; 0 for the reset.
        obs: The observation after these steps.
        outcome: Reward and success of the last step; None for the reset.
    """
    if obs.state.keys() != recorded.state.keys():
        return float("inf")
    if (obs.gripper is None) != (recorded.gripper is None):
        return float("inf")

    pairs = []
    for name, values in obs.state.items():
        pairs.append((recorded.state[name][number], np.asarray(values, np.float32)))
    if recorded.gripper is not None:
        pairs.append((recorded.gripper[number], np.asarray(obs.gripper, np.float32)))
    if outcome is not None:
        pairs.append((recorded.rewards[number - 1], np.asarray(outcome[0], np.float64)))

    differences = []
    for recorded_values, replayed_values in pairs:
        if recorded_values.shape != replayed_values.shape:
            differences.append(float("inf"))
        elif recorded_values.tobytes() != replayed_values.tobytes():
            change = np.asarray(replayed_values, np.float64) - np.asarray(
                recorded_values, np.float64
            )
            differences.append(float(np.max(np.abs(change))))
    if outcome is not None and bool(recorded.success[number - 1]) != outcome[1]:
        differences.append(0.0)
    return max(differences, default=None)
