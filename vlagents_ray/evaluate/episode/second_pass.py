"""A second pass over an episode, which repeats its actions and renders the images that the first
pass left out.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.envs.base import BatchEnv
from vlagents_ray.errors import EnvFailed, VLAgentsError
from vlagents_ray.evaluate.episode.episode import Diverged, Images, Watch, run_episodes
from vlagents_ray.evaluate.episode.records import EpisodeObserver, EpisodeResult
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs


class RecordedActions(Agent):
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


def play_actions(
    env: BatchEnv,
    key: EpisodeKey,
    actions: Sequence[np.ndarray],
    observer: EpisodeObserver,
    *,
    reset_options: Mapping[str, Any] | None,
    images: Images,
    watch: Watch = lambda _phase, _steps: None,
) -> EpisodeResult:
    """Begin an episode again in the first of these environments, and execute its actions.

    Args:
        env: The environments.
        key: The key of the episode.
        actions: Its actions, (D,) each; at least one.
        observer: Receives the observations and the outcome of each action.
        reset_options: The options of each reset of its suite.
        images: The observations whose images are used: "all" or "none".
        watch: As in `run_episodes`.

    Returns:
        The result of the episode, in which all actions were executed.

    Raises:
        EnvFailed: The simulator failed or diverged, or the episode ended before its last action.
    """
    agent = RecordedActions(actions)
    [outcome] = run_episodes(
        env,
        agent,
        [agent],
        [key],
        reset_options=reset_options,
        observers=[observer],
        watch=watch,
        images=images,
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


class PlayedEpisode(EpisodeObserver):
    """The actions and outcomes of an episode, with digests in place of images."""

    def __init__(self) -> None:
        self._observations: list[_Digests] = []
        self._actions: list[np.ndarray] = []  # (D,) each
        self._outcomes: list[tuple[float, bool]] = []  # (reward, success) of each action

    @property
    def lacks_images(self) -> bool:
        """Whether an observation lacks images that the first observation has."""
        if not self._observations:
            return False
        names = self._observations[0].images.keys()
        return any(digests.images.keys() != names for digests in self._observations)

    def add_observation(self, obs: Obs) -> None:
        """Store the digests of an observation."""
        self._observations.append(_Digests.from_obs(obs))

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Store an action and its outcome."""
        self._actions.append(np.array(action))
        self._outcomes.append((reward, success))

    def play_again(
        self,
        env: BatchEnv,
        key: EpisodeKey,
        reset_options: Mapping[str, Any] | None,
        watch: Watch,
        record: Callable[[Obs], None],
    ) -> str | None:
        """Repeat the episode in the first environment: reset it, execute the actions, and render
        each observation.

        State, gripper, reward and success of every step, and all images of the first pass, must be
        bit-identical, so that the new images certainly show this episode.

        Args:
            env: The environments.
            key: The key of the episode.
            reset_options: The options of each reset of its suite.
            watch: As in `run_episodes`.
            record: Called with each observation.

        Returns:
            The first difference, which ends the pass; None if there is none.
        """
        comparison = _Comparison(self._observations, self._outcomes, record)
        try:
            play_actions(
                env,
                key,
                self._actions,
                comparison,
                reset_options=reset_options,
                images="all",
                watch=watch,
            )
        except (VLAgentsError, _DifferenceFound) as error:
            return str(error)
        return None


class _DifferenceFound(Exception):
    """Ends a second pass; the message is the first difference."""


class _Comparison(EpisodeObserver):
    """Compares an episode with its first pass, step by step."""

    def __init__(
        self,
        observations: Sequence[_Digests],
        outcomes: Sequence[tuple[float, bool]],
        record: Callable[[Obs], None],
    ) -> None:
        self._observations = observations
        self._outcomes = outcomes
        self._record = record
        self._steps = -1  # -1 before the reset
        self._difference: str | None = None  # difference of the newest observation

    def add_observation(self, obs: Obs) -> None:
        """Record an observation; raise `_DifferenceFound` if the observation of the reset has
        changed.
        """
        self._steps += 1
        self._record(obs)
        first_pass = self._observations[self._steps]
        self._difference = first_pass.difference(_Digests.from_obs(obs))
        if self._steps == 0:
            self._require_none(self._difference)

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Raise `_DifferenceFound` if the observation or the outcome of an action has changed."""
        is_same = (reward, success) == self._outcomes[self._steps - 1]
        self._require_none(self._difference if is_same else "reward or success")

    def _require_none(self, difference: str | None) -> None:
        if difference is None:
            return
        is_last = self._steps == len(self._outcomes)
        steps = "the last step" if is_last else f"{self._steps} steps"
        raise _DifferenceFound(f"after {steps}, {difference} differs")


# A function that calls `play_again` with the environment.
SecondPass = Callable[[PlayedEpisode, Callable[[Obs], None]], str | None]


@dataclass(frozen=True, slots=True)
class _Digests:
    """The numbers of an observation, and the checksums of its images, by the names that a message
    uses.
    """

    numbers: dict[str, Any]
    images: dict[str, int]

    @classmethod
    def from_obs(cls, obs: Obs) -> _Digests:
        """Return the digests of an observation."""
        numbers: dict[str, Any] = {}
        for name, values in obs.state.items():
            numbers[f"state {name!r}"] = values.tobytes()
        numbers["the gripper"] = obs.gripper

        images = {}
        for name, image in obs.cameras.items():
            images[f"image {name!r}"] = zlib.crc32(image.tobytes())
        return cls(numbers, images)

    def difference(self, other: _Digests) -> str | None:
        """Return the first name whose value differs in `other`; None if all values are equal."""
        for name, number in self.numbers.items():
            if other.numbers.get(name) != number:
                return name
        for name, checksum in self.images.items():
            if other.images.get(name) != checksum:
                return name
        return None
