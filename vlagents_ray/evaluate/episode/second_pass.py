"""A second pass over an episode, by its actions: it renders the images that the first pass left out."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from vlagents_ray.envs.base import BatchEnv, Options
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.evaluate.episode.episode import EpisodeObserver, Watch
from vlagents_ray.evaluate.episode.failures import checked_obs, checked_step, env_side
from vlagents_ray.interface import Act, Obs


class PlayedEpisode(EpisodeObserver):
    """The actions of an episode and what came of them, with digests in place of images."""

    def __init__(self) -> None:
        self._seen: list[tuple[dict[str, Any], dict[str, Any]]] = []  # numbers and images of each observation, by name
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
        self, env: BatchEnv, seed: int, options: Options | None, watch: Watch, record: Callable[[Obs], None]
    ) -> str | None:
        """Begin the episode in the first environment again, execute its actions, and render each observation.

        State, gripper, reward and success of every step, and the images that were rendered before, must be the same to
        the bit. The images between them then show this episode.

        Returns:
            What differs, upon which nothing more is executed; None if nothing does.
        """
        contract, env.looked_at = env.contract, True
        try:
            watch("env reset", 0)
            with env_side("reset"):
                [first] = env.reset(seeds=[seed], options=[options])
                obs = checked_obs(first, contract, "reset")
            record(obs)
            differs = self._difference(0, obs)
            for number, (action, reward, success) in enumerate(self._done, start=1):
                if differs is not None:
                    return f"after {number - 1} steps, {differs} differs"
                watch("env step", number - 1)
                with env_side("step"):
                    [seen], [gained], [terminated], [truncated], [info] = env.step([Act(action)])
                    step = checked_step(seen, gained, terminated, truncated, info, contract)
                record(step.obs)
                same = (step.reward, step.success) == (reward, success)
                differs = self._difference(number, step.obs) if same else "reward or success"
        except VLAgentsError as error:  # as of an environment that is over sooner
            return str(error)
        return differs and f"after the last step, {differs} differs"

    def _difference(self, number: int, obs: Obs) -> str | None:
        """Return the part of observation `number` that is not in `obs`, or None."""
        then, now = self._seen[number], _digests(obs)
        parts = [(kind, name) for kind in (0, 1) for name in then[kind]]
        return next((name for kind, name in parts if then[kind][name] != now[kind].get(name)), None)


SecondPass = Callable[[PlayedEpisode, Callable[[Obs], None]], str | None]  # `play_again` with the environment


def _digests(obs: Obs) -> tuple[dict[str, Any], dict[str, Any]]:
    numbers: dict[str, Any] = {f"state {name!r}": part.tobytes() for name, part in obs.state.items()}
    images = {f"image {name!r}": zlib.crc32(one.tobytes()) for name, one in obs.cameras.items()}
    return numbers | {"the gripper": obs.gripper}, images
