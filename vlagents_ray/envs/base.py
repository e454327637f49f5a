"""What an environment looks like to an evaluation, whatever simulates it."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from vlagents_ray.contract import Contract, check_action
from vlagents_ray.envs.graphics import Renderer, opengl_renderer
from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import env_class, env_task

if TYPE_CHECKING:
    from typing_extensions import Self

    from vlagents_ray.envs.batch import BatchEnv


class EvalEnv(ABC):
    """One environment instance: made once by a worker, reset for each of its episodes.

    An episode is a pure function of its seed and options: two resets with the same ones give the
    same first observation, whatever happened before, in whichever process.
    """

    max_steps: int
    """The task's step limit; `step` reports `truncated` when it is reached."""

    init_states: int | None = None
    """How many initial states the benchmark has fixed for the task; None if seeds alone draw them.

    Episode i of an evaluation begins in state i modulo this, handed to `reset` as `options["init_state"]`.
    """

    looked_at: bool = True
    """Will anybody see what the next `step` returns? If not, an env may leave the images out, and save rendering them.

    Nobody does between two rows of a chunk, unless videos are made. Nothing else may depend on it.
    """

    @property
    @abstractmethod
    def contract(self) -> Contract:
        """What the env gives (cameras, state, gripper, rate) and takes (actions)."""

    @property
    @abstractmethod
    def instruction(self) -> str:
        """The task in words, for the episode that the last `reset` began."""

    @abstractmethod
    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode that `seed` and `options` determine."""

    @abstractmethod
    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute one action, (D,) float32: `(obs, reward, terminated, truncated, info)`.

        `info["success"]` is a bool: is the task solved in this state? The env may go on after
        success; `terminated` only says that it cannot. Raises `InvalidAction` for an action of the
        wrong shape and `EnvFailed` when the simulator breaks.
        """

    @classmethod
    def tasks(cls) -> list[str]:
        """The tasks known by name, `[]` if any name is handed to the simulator."""
        return []

    @classmethod
    def missing(cls) -> str | None:
        """What keeps this simulator from running here, with the cure; None if nothing does."""
        return None

    @classmethod
    def batched(cls, num_envs: int, **options: Any) -> BatchEnv | None:  # noqa: ARG003 - for those that override it
        """`num_envs` environments in one simulator, made with the constructor's options; None if that cannot be."""
        return None

    def renderer(self) -> Renderer | None:
        """What draws its images, once it is made; None if that is no device. Here: this thread's OpenGL context."""
        return opengl_renderer()

    def describe(self) -> dict[str, Any]:
        """What a reader of the results must know: versions, control mode, render backend."""
        return {}

    @abstractmethod
    def close(self) -> None:
        """Free the simulator; safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def make_env(name: str, **options: Any) -> EvalEnv:
    """An environment by name, e.g. `make_env("maniskill/PushCube-v1", width=224, height=224)`.

    Raises `UnknownEnv` for an unknown name and `ConfigError` for an option that the env does not take.
    """
    cls, arguments = env_arguments(name, options)
    env: EvalEnv = cls(**arguments)
    return env


def env_arguments(name: str, options: Mapping[str, Any]) -> tuple[type[EvalEnv], dict[str, Any]]:
    """The class of the env `name` and what its constructor is given; raises as `make_env`."""
    cls = env_class(name)
    task = env_task(name)
    arguments = {"task": task, **options} if task is not None else dict(options)
    try:
        inspect.signature(cls).bind(**arguments)
    except TypeError as error:
        takes = sorted(set(inspect.signature(cls).parameters) - {"self"})
        raise ConfigError(f"env {name!r}: {error}; it takes {takes}") from error
    return cls, arguments


def one_row(act: Act, contract: Contract) -> np.ndarray:
    """The action as (D,) float32, for `step`; `InvalidAction` if it is anything else."""
    action = check_action(act.action, contract)
    if action.ndim != 1:
        dim = contract.action.dim
        raise InvalidAction(f"action: got {action.shape}, want ({dim},); step through a chunk row by row")
    return action
