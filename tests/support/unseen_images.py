"""An env's episode with all images, and once more with those alone that the policy gets."""

from __future__ import annotations

from typing import Any

import numpy as np
from in_process_episode import run_episode

from vlagents_ray.envs import EvalEnv
from vlagents_ray.envs.base import SequentialBatch
from vlagents_ray.evaluate.episode.episode import options_of_reset
from vlagents_ray.evaluate.episode.second_pass import PlayedEpisode
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs

_CHUNK = 3
_KEY = EpisodeKey("env", episode=0, seed=3, settings="")


def require_same_without_unseen_images(env: EvalEnv) -> None:
    """Require what an evaluation promises of an env that leaves out images which nobody looks at.

    Actions, rewards, successes, everything but the images of every step, and the images that the policy gets are equal
    to the bit; between two requests, and after the last step, there are none. A second pass renders them as they were.
    """
    steps = env.max_steps
    everything, sparing = _played(env, images=True), _played(env, images=False)
    assert sparing.told == everything.told
    assert sparing.asked == everything.asked
    assert everything.rendered == [True] * (steps + 1)
    assert sparing.rendered == [i % _CHUNK == 0 for i in range(steps)] + [False]
    again: list[list[Any]] = []
    options = options_of_reset(env, _KEY.episode, None)
    assert sparing.episode.lacks_images
    assert (
        sparing.episode.play_again(
            SequentialBatch([env]), _KEY.seed, options, lambda *_: None, lambda obs: again.append(_images(obs))
        )
        is None
    )
    assert again == everything.images


class _Chunks(Agent):
    """Answers with random chunks, and keeps the observations it got, as bytes."""

    def __init__(self, dim: int) -> None:
        self._rng = np.random.default_rng(5)
        self._dim = dim
        self.asked: list[list[Any]] = []

    def act(self, obs: Obs) -> Act:
        self.asked.append(_images(obs) + _values(obs))
        return Act(self._rng.uniform(-0.3, 0.3, (_CHUNK, self._dim)).astype(np.float32))


class _Played:
    """The outputs of an env in one episode."""

    def __init__(self) -> None:
        self.told: list[Any] = []  # of the state and of what each step gave
        self.rendered: list[bool] = []
        self.images: list[list[Any]] = []
        self.episode = PlayedEpisode()
        self.asked: list[list[Any]] = []


def _played(env: EvalEnv, *, images: bool) -> _Played:
    played, agent = _Played(), _Chunks(env.contract.action.dim or 0)

    def record(obs: Obs) -> None:
        played.told.append(_values(obs))
        played.rendered.append(bool(obs.cameras))
        played.images.append(_images(obs))
        played.episode.add_observation(obs)

    def executed(action: np.ndarray, reward: float, success: bool) -> None:
        played.told.append((action.tobytes(), reward, success))
        played.episode.add_action(action, reward, success)

    result = run_episode(
        env,
        agent,
        _KEY,
        images=images,
        record=record,
        executed=executed,
    )
    played.told.append((result.steps, result.episode_return, result.success_at_end, result.ending))
    played.asked = agent.asked
    return played


def _images(obs: Obs) -> list[Any]:
    return [_plain(dict(sorted(obs.cameras.items())))]


def _values(obs: Obs) -> list[Any]:
    """Everything but the images."""
    return [(name, part.tobytes()) for name, part in sorted(obs.state.items())] + [obs.gripper, _plain(dict(obs.info))]


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    return value.tobytes() if isinstance(value, np.ndarray) else value
