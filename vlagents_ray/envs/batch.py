"""Several environments that step together, so that a policy is asked once for all of them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import BatchEnv, EvalEnv, Options, Steps, env_arguments, one_row
from vlagents_ray.envs.rendering.graphics import Renderer
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Act, Obs

__all__ = ["BatchEnv", "Options", "SequentialBatch", "Steps", "episodes_of", "images_in_rows", "make_batch"]


def make_batch(name: str, num_envs: int, **options: Any) -> BatchEnv:
    """Make several environments by name, in one simulator if the suite supports that with these options.

    Args:
        name: The name of the env, as for `make_env`.
        num_envs: The number of environments.
        options: The options of the env's constructor.

    Returns:
        The environments, which the caller closes.

    Raises:
        ConfigError: `num_envs` is below 1, or an option is wrong; other errors are those of `make_env`.
    """
    if num_envs < 1:
        raise ConfigError(f"env {name!r}: num_envs is {num_envs}, want at least 1")
    cls, arguments = env_arguments(name, options)
    together = cls.batched(num_envs, **arguments)
    if together is not None:
        return together
    with ExitStack() as made:
        envs = [made.enter_context(cls(**arguments)) for _ in range(num_envs)]
        made.pop_all()
        return SequentialBatch(envs)


class SequentialBatch(BatchEnv):
    """Environments that are stepped one after another, while one call of the policy serves all of them."""

    restarts = True

    def __init__(self, envs: Sequence[EvalEnv]) -> None:
        """Combine environments of one task, which are closed together with this object."""
        self.several_tasks = envs[0].several_tasks
        self._envs = list(envs)
        self._playing = 0  # the first so many have an episode
        self._seen: list[Obs] = []  # the last observation of each
        first = self._envs[0]
        self.num_envs, self.max_steps, self.init_states = len(self._envs), first.max_steps, first.init_states

    @property
    def contract(self) -> Contract:
        return self._envs[0].contract

    @property
    def instructions(self) -> list[str]:
        return [env.instruction for env in self._envs[: self._playing]]

    def reset(self, *, seeds: Sequence[int], options: Sequence[Options | None] | None = None) -> list[Obs]:
        self._playing = episodes_of(seeds, self.num_envs)
        given = zip(self._envs, seeds, options or [None] * self._playing, strict=False)
        self._seen = self._stacked([_begun(*each) for each in given], range(self._playing))
        return self._seen

    def restart(self, index: int, *, seed: int, options: Options | None = None) -> Obs:
        self._seen[index] = _begun(self._envs[index], seed, options)
        return self._seen[index]

    def step(self, acts: Sequence[Act | None]) -> Steps:
        n = len(acts)
        if n != self._playing:
            raise ConfigError(f"step: got {n} actions, want {self._playing}, one for each episode or None")
        moving = {i: act for i, act in enumerate(acts) if act is not None}
        if n > 1:  # a single environment checks its action itself
            for act in moving.values():
                one_row(act, self.contract)
        seen, rewards, terminated, truncated = list(self._seen), [0.0] * n, [False] * n, [False] * n
        infos: list[dict[str, Any]] = [{}] * n
        for i, act in moving.items():
            self._envs[i].looked_at = self.looked_at
            answer: Any = self._envs[i].step(act)
            if not isinstance(answer, tuple) or len(answer) != 5:
                want = "(Obs, reward, terminated, truncated, info)"
                raise EnvFailed(f"env step: got {_kind(answer)}, want {want}; see EvalEnv.step")
            seen[i], rewards[i], terminated[i], truncated[i], infos[i] = answer
        self._seen = self._stacked(seen, moving)
        return self._seen, rewards, terminated, truncated, infos

    def renderer(self) -> Renderer | None:
        return self._envs[0].renderer()

    def describe(self) -> dict[str, Any]:
        several = {} if self.num_envs == 1 else {"num_envs": self.num_envs}
        return {**self._envs[0].describe(), **several}

    def close(self) -> None:
        with ExitStack() as closing:
            for env in self._envs:
                closing.callback(env.close)

    def _stacked(self, seen: list[Obs], moved: Collection[int]) -> list[Obs]:
        """The observations with the images of each camera as rows of one array, if anybody looks at them.

        An idle environment may have left its images out when it last moved; those of one that moved stand for them.
        """
        if len(seen) == 1 or not moved or not self.looked_at:
            return seen
        shown = seen[min(moved)].cameras
        if not shown:
            return seen
        return images_in_rows(
            [obs if i in moved else replace(obs, cameras={**shown, **obs.cameras}) for i, obs in enumerate(seen)]
        )


def images_in_rows(seen: Sequence[Obs]) -> list[Obs]:
    """Return observations with the images of each camera, which all of them have, as rows of one array."""
    images = {name: np.stack([obs.cameras[name] for obs in seen]) for name in seen[0].cameras}
    return [replace(obs, cameras={name: rows[i] for name, rows in images.items()}) for i, obs in enumerate(seen)]


def _begun(env: EvalEnv, seed: int, options: Options | None) -> Obs:
    answer: Any = env.reset(seed=seed, options=options)
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise EnvFailed(f"env reset: got {_kind(answer)}, want (Obs, info); see EvalEnv.reset")
    obs: Obs = answer[0]
    return obs


def episodes_of(seeds: Sequence[int], num_envs: int) -> int:
    """Return the number of episodes that `seeds` begin; raises `ConfigError` if there are too many or none."""
    if not 1 <= len(seeds) <= num_envs:
        raise ConfigError(
            f"reset: got {len(seeds)} seeds, want 1 to {num_envs}, one for each environment that is to play"
        )
    return len(seeds)


def _kind(answer: object) -> str:
    return f"a tuple of {len(answer)}" if isinstance(answer, tuple) else type(answer).__name__
