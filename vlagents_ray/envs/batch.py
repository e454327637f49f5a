"""Several environments that step together, so that a policy is asked once for all of them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import EvalEnv, env_arguments, one_row
from vlagents_ray.envs.graphics import Renderer, opengl_renderer
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Obs

if TYPE_CHECKING:
    from typing_extensions import Self

Options = Mapping[str, Any]
Steps = tuple[list[Obs], list[float], list[bool], list[bool], list[dict[str, Any]]]


class BatchEnv(ABC):
    """`num_envs` environments of one task, alike but for their episodes.

    They begin together and go on together: an environment whose episode is over is idle, its rows
    meaningless, until all are and `reset` begins the next. Row i of whatever is given and returned
    belongs to environment i. Its episode is a pure function of its own seed and options, as an
    `EvalEnv`'s is, wherever it stands and whoever its neighbours are.

    All images that a camera took at one time are rows of one array, (num_envs, height, width, 3).
    """

    num_envs: int
    """How many there are."""

    max_steps: int
    """The task's step limit, as an `EvalEnv`'s."""

    init_states: int | None = None
    """As an `EvalEnv`'s."""

    @property
    @abstractmethod
    def contract(self) -> Contract:
        """What each environment gives and takes."""

    @property
    @abstractmethod
    def instructions(self) -> list[str]:
        """The tasks in words, for the episodes that the last `reset` began."""

    @abstractmethod
    def reset(self, *, seeds: Sequence[int], options: Sequence[Options | None] | None = None) -> list[Obs]:
        """Begin as many episodes as there are seeds, each with its own options.

        Of fewer than `num_envs`, the environments left over are idle; nothing is returned for them.
        """

    @abstractmethod
    def step(self, acts: Sequence[Act | None]) -> Steps:
        """Execute one action, (D,) float32, in each episode: `(obs, rewards, terminated, truncated, infos)`.

        None is for an idle environment. Raises `InvalidAction` before anything has moved, and
        `EnvFailed` when the simulator breaks, which ends all episodes.
        """

    def renderer(self) -> Renderer | None:
        """As `EvalEnv.renderer`."""
        return opengl_renderer()

    def describe(self) -> dict[str, Any]:
        """What a reader of the results must know, as `EvalEnv.describe`."""
        return {}

    @abstractmethod
    def close(self) -> None:
        """Free the simulator; safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def make_batch(name: str, num_envs: int, **options: Any) -> BatchEnv:
    """`num_envs` environments by name, in one simulator where the suite can do that with these options.

    Raises as `make_env`, and `ConfigError` for less than one environment.
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
        return InTurn(envs)


class InTurn(BatchEnv):
    """Environments that are stepped one after another; what is saved is asking the policy for each."""

    def __init__(self, envs: Sequence[EvalEnv]) -> None:
        """`envs` are of one task, and closed with this."""
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
        given = options or [None] * self._playing
        self._seen = [
            env.reset(seed=seed, options=option)[0]
            for env, seed, option in zip(self._envs[: self._playing], seeds, given, strict=True)
        ]
        self._seen = self._together(self._seen)
        return list(self._seen)

    def step(self, acts: Sequence[Act | None]) -> Steps:
        for act in acts:
            if act is not None:
                one_row(act, self.contract)
        rewards, terminated, truncated = ([0.0] * len(acts), [False] * len(acts), [False] * len(acts))
        infos: list[dict[str, Any]] = [{} for _ in acts]
        for i, (env, act) in enumerate(zip(self._envs[: self._playing], acts, strict=True)):
            if act is not None:
                self._seen[i], rewards[i], terminated[i], truncated[i], infos[i] = env.step(act)
        self._seen = self._together(self._seen)
        return list(self._seen), rewards, terminated, truncated, infos

    def renderer(self) -> Renderer | None:
        return self._envs[0].renderer()

    def describe(self) -> dict[str, Any]:
        return {**self._envs[0].describe(), "num_envs": self.num_envs}

    def close(self) -> None:
        with ExitStack() as closing:
            for env in self._envs:
                closing.callback(env.close)

    def _together(self, seen: Sequence[Obs]) -> list[Obs]:
        names = seen[0].cameras
        images = {name: np.stack([obs.cameras[name] for obs in seen]) for name in names}
        return [replace(obs, cameras={name: images[name][i] for name in names}) for i, obs in enumerate(seen)]


def episodes_of(seeds: Sequence[int], num_envs: int) -> int:
    """How many episodes `seeds` begin; `ConfigError` unless there is room for them."""
    if not 1 <= len(seeds) <= num_envs:
        raise ConfigError(
            f"reset: got {len(seeds)} seeds, want 1 to {num_envs}, one for each environment that is to play"
        )
    return len(seeds)
