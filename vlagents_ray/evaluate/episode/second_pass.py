"""A second pass over an episode by its actions, which renders the images that the first pass
left out.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.envs.base import BatchEnv, Options
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.episode.episode import Watch
from vlagents_ray.evaluate.episode.failures import EnvStep, checked_obs, checked_step, env_side
from vlagents_ray.evaluate.episode.records import EpisodeObserver
from vlagents_ray.interface import Act, Obs


def play_actions(
    env: BatchEnv,
    seed: int,
    options: Options | None,
    actions: Iterable[np.ndarray],
    *,
    images: bool,
    watch: Watch = lambda _phase, _steps: None,
) -> Iterator[tuple[Obs, EnvStep | None]]:
    """Begin an episode in the first of these environments, and execute actions, each (D,).

    Yields:
        The observation of the reset with None, then that of each step with all its outputs.

    Raises:
        EnvFailed: The simulator failed, or its episode ended earlier.
    """
    env.looked_at = images
    watch("env reset", 0)
    with env_side("reset"):
        contract = env.contract
        [first] = env.reset(seeds=[seed], options=[options])
        obs = checked_obs(first, contract, "reset", images=images)
    yield obs, None

    for number, action in enumerate(actions):
        watch("env step", number)
        with env_side("step"):
            [obs], [reward], [terminated], [truncated], [info] = env.step([Act(action)])
            step = checked_step(obs, reward, terminated, truncated, info, contract, images=images)
        yield step.obs, step


class PlayedEpisode(EpisodeObserver):
    """The actions and outcomes of an episode, with digests in place of images."""

    def __init__(self) -> None:
        self._observations: list[_Digests] = []
        self._actions: list[np.ndarray] = []  # (D,) each
        self._outcomes: list[tuple[float, bool]] = []  # (reward, success) of each action

    @property
    def lacks_images(self) -> bool:
        """Whether an observation lacks images that the first one has."""
        if not self._observations:
            return False
        names = self._observations[0].images.keys()
        return any(digests.images.keys() != names for digests in self._observations)

    def add_observation(self, obs: Obs) -> None:
        """Keep the digests of an observation."""
        self._observations.append(_Digests.from_obs(obs))

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        """Keep an action and its outcome."""
        self._actions.append(np.array(action))
        self._outcomes.append((reward, success))

    def play_again(
        self,
        env: BatchEnv,
        seed: int,
        options: Options | None,
        watch: Watch,
        record: Callable[[Obs], None],
    ) -> str | None:
        """Begin the episode in the first environment again, execute its actions, and render each
        observation.

        State, gripper, reward and success of every step, and the images of the first pass, must be
        equal to the bit, so that the new images show this episode.

        Returns:
            The first difference, which ends the pass; None if there is none.
        """
        played = play_actions(env, seed, options, self._actions, images=True, watch=watch)
        try:
            for number, (obs, step) in enumerate(played):
                record(obs)
                difference = self._observations[number].difference(_Digests.from_obs(obs))
                if step is not None:
                    outcome = (step.reward, step.success)
                    if outcome != self._outcomes[number - 1]:
                        difference = "reward or success"

                if difference is not None:
                    is_last = number == len(self._actions)
                    steps = "the last step" if is_last else f"{number} steps"
                    return f"after {steps}, {difference} differs"
        except VLAgentsError as error:  # such as an earlier end of the episode
            return str(error)
        return None


# `play_again` with the environment.
SecondPass = Callable[[PlayedEpisode, Callable[[Obs], None]], str | None]


@dataclass(frozen=True, slots=True)
class _Digests:
    """The numbers of an observation, and the checksums of its images, by names for a message."""

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
        """Return the first name whose value `other` does not have; None if there is none."""
        for name, number in self.numbers.items():
            if other.numbers.get(name) != number:
                return name
        for name, checksum in self.images.items():
            if other.images.get(name) != checksum:
                return name
        return None
