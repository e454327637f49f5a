"""A second pass over an episode by its actions, which renders the images that the first pass
left out.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Iterator
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
            [seen], [reward], [terminated], [truncated], [info] = env.step([Act(action)])
            step = checked_step(seen, reward, terminated, truncated, info, contract, images=images)
        yield step.obs, step


class PlayedEpisode(EpisodeObserver):
    """The actions and outcomes of an episode, with digests in place of images."""

    def __init__(self) -> None:
        # Numbers and images of each observation, by name.
        self._seen: list[tuple[dict[str, Any], dict[str, Any]]] = []
        self._done: list[tuple[np.ndarray, float, bool]] = []  # (D,) action, reward, success

    @property
    def lacks_images(self) -> bool:
        """Whether an observation lacks images that the first one has."""
        return any(images.keys() != self._seen[0][1].keys() for _, images in self._seen)

    def add_observation(self, obs: Obs) -> None:
        self._seen.append(_digests(obs))

    def add_action(self, action: np.ndarray, reward: float, success: bool) -> None:
        self._done.append((np.array(action), reward, success))

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
        played = play_actions(
            env, seed, options, (action for action, _, _ in self._done), images=True, watch=watch
        )
        try:
            for number, (obs, step) in enumerate(played):
                record(obs)
                then, now = self._seen[number], _digests(obs)
                parts = [(kind, name) for kind in (0, 1) for name in then[kind]]
                differs = next(
                    (name for kind, name in parts if then[kind][name] != now[kind].get(name)), None
                )
                if step is not None and (step.reward, step.success) != self._done[number - 1][1:]:
                    differs = "reward or success"
                if differs is not None:
                    steps = "the last step" if number == len(self._done) else f"{number} steps"
                    return f"after {steps}, {differs} differs"
        except VLAgentsError as error:  # such as an earlier end of the episode
            return str(error)
        return None


# `play_again` with the environment.
SecondPass = Callable[[PlayedEpisode, Callable[[Obs], None]], str | None]


def _digests(obs: Obs) -> tuple[dict[str, Any], dict[str, Any]]:
    numbers: dict[str, Any] = {
        f"state {name!r}": part.tobytes() for name, part in obs.state.items()
    }
    images = {f"image {name!r}": zlib.crc32(one.tobytes()) for name, one in obs.cameras.items()}
    return numbers | {"the gripper": obs.gripper}, images
