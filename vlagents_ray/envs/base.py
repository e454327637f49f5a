"""The interfaces of a single environment, and of several environments that step together."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs.graphics import Renderer, opengl_renderer
from vlagents_ray.errors import ConfigError, EnvFailed, InvalidAction, UnknownEnv
from vlagents_ray.interface import Act, Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import env_class, env_task
from vlagents_ray.settings import require_arguments
from vlagents_ray.validation import check_action

if TYPE_CHECKING:
    from typing_extensions import Self

Options = Mapping[str, Any]
# When success counts: after any step of an episode, or only after the last step.
Metric = Literal["success_once", "success_at_end"]
# Observations, rewards, terminated, truncated and infos of one step in several environments.
Steps = tuple[list[Obs], list[float], list[bool], list[bool], list[dict[str, Any]]]


class Environment(ABC):
    """The common interface of a single environment and a batch of them."""

    max_steps: int
    """The task's step limit; `step` reports `truncated` when it is reached."""

    init_states: int | None = None
    """The number of initial states that the benchmark fixes for the task; None if the seed alone
    determines the state.

    Episode i of an evaluation begins in state i modulo this number, passed to `reset` as
    `options["init_state"]`.
    """

    looked_at: bool = True
    """Whether the images of the next observation are used; if not, an env may omit them.

    Unless videos are recorded, images between the rows of a chunk and images of the last step are
    not used. Only the images may depend on this attribute.
    """

    several_tasks: bool = False
    """Whether an episode is a sequence of tasks, as in CALVIN, so that a step may change the
    instruction.

    An evaluation then resets the policy with the new instruction and the observation of this step,
    which has images even if `looked_at` is False. The remaining rows of the chunk are dropped.
    """

    @property
    @abstractmethod
    def contract(self) -> Contract:
        """The observations (cameras, state, gripper, rate) and the actions of each environment."""

    def renderer(self) -> Renderer | None:
        """Return the device that renders the images; None before the device is chosen.

        By default, it is the device of this thread's OpenGL context.
        """
        return opengl_renderer()

    def describe(self) -> dict[str, Any]:
        """Return a description that readers of results need: versions, control mode, render
        backend.
        """
        return {}

    @abstractmethod
    def close(self) -> None:
        """Free the simulator; safe to call twice."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


class EvalEnv(Environment):
    """The interface of an environment, which a worker creates once and resets for each episode.

    An episode is a pure function of its seed and options: two resets with the same seed and options
    return the same first observation, in any process and after any other episodes.
    """

    known: ClassVar[Collection[str]] = ()  # the names of the tasks, for `tasks`

    @property
    @abstractmethod
    def instruction(self) -> str:
        """The task of the current episode in words; with `several_tasks`, the current task."""

    @abstractmethod
    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: The seed of the episode.
            options: The options of the episode, e.g. `init_state` (int); each env defines the
                options that it accepts.

        Returns:
            The first observation, and information about the episode, whose values can be sent in a
            message.

        Raises:
            ConfigError: An option is unknown or has a wrong value.
            EnvFailed: The simulator failed.
        """

    @abstractmethod
    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute an action.

        Args:
            act: A single action, (D,) float32, in the units of the contract; its array must not be
                changed.

        Returns:
            `(obs, reward, terminated, truncated, info)`, with the same meaning as in Gymnasium's
            `Env.step`. `info["success"]` is a bool: whether the task is solved in this state. An
            env may continue after success; `terminated` only reports that the env cannot continue,
            and `truncated` reports that `max_steps` is reached.

        Raises:
            InvalidAction: The action has a wrong shape or is not finite.
            EnvFailed: The simulator failed.
        """

    @classmethod
    def tasks(cls) -> list[str]:
        """Return the names of the known tasks; empty if the simulator accepts any name."""
        return list(cls.known)

    @classmethod
    def require_task(cls, task: str | None) -> None:
        """Check that a task exists, as far as that is possible without the simulator.

        Args:
            task: The part of the env's name after the first slash; None if the name has no slash,
                which is valid if the constructor has a default task.

        Raises:
            UnknownEnv: The task does not exist.
        """

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract | None:  # noqa: ARG003
        """Return the contract of an environment before the environment is created.

        An evaluation can then report a mismatch with a policy before any process starts.

        Args:
            arguments: All arguments of the constructor by name, including defaults.

        Returns:
            The contract; None if only the simulator knows it.
        """
        return None

    @classmethod
    def not_installed(cls) -> str | None:
        """Return which package of the simulator this Python lacks, with the cure; None if it has
        all. This is fast, as it neither imports nor starts the simulator.
        """
        return None

    @classmethod
    def missing(cls) -> str | None:
        """Return the reason why the simulator cannot run here, with the cure; None if it can
        run.
        """
        return cls.not_installed()

    @classmethod
    def batched(cls, num_envs: int, **options: Any) -> BatchEnv | None:  # noqa: ARG003
        """Create several environments that one simulator runs together.

        Args:
            num_envs: The number of environments.
            options: The constructor's options.

        Returns:
            The environments; None if the simulator cannot run several environments with these
            options.
        """
        return None


class BatchEnv(Environment):
    """Several environments of one task, which differ only in their episodes.

    The environments begin and step together. An environment whose episode is over is idle, and its
    rows have no meaning, until all episodes are over and `reset` begins the next episodes. Row i of
    every argument and result belongs to environment i. An episode is a pure function of its seed
    and options, as in `EvalEnv`, and does not depend on the other environments.

    The images of a camera in one step are the rows of one array, (num_envs, height, width, 3)
    uint8.
    """

    num_envs: int
    """The number of environments."""

    # Whether `restart` can begin an episode in one environment while the other episodes continue.
    restarts: bool = False

    @property
    @abstractmethod
    def instructions(self) -> list[str]:
        """The tasks of the current episodes in words; with `several_tasks`, the current tasks."""

    @abstractmethod
    def reset(
        self, *, seeds: Sequence[int], options: Sequence[Options | None] | None = None
    ) -> list[Obs]:
        """Begin an episode for each seed.

        Args:
            seeds: The seeds, 1 to `num_envs`; if there are fewer, the remaining environments are
                idle.
            options: The options of each episode; None for no options.

        Returns:
            The first observation of each episode.
        """

    def restart(self, index: int, *, seed: int, options: Options | None = None) -> Obs:
        """Begin the next episode in one environment while the other episodes continue.

        Args:
            index: The number of the environment.
            seed: The seed of the episode.
            options: The options of the episode; None for no options.

        Returns:
            The first observation.

        Raises:
            ConfigError: `restarts` is False.
        """
        raise ConfigError(
            f"env {index}: {type(self).__name__} resets its environments together; use `reset`"
        )

    @abstractmethod
    def step(self, acts: Sequence[Act | None]) -> Steps:
        """Execute an action in each episode.

        Args:
            acts: A single action, (D,) float32, for each environment; None for an idle environment.

        Returns:
            `(obs, rewards, terminated, truncated, infos)`, each with one item for each environment
            (see `EvalEnv.step`).

        Raises:
            InvalidAction: An action is not valid; no action was executed.
            EnvFailed: The simulator failed, which ends all episodes.
        """


def make_env(name: str, **options: Any) -> EvalEnv:
    """Create an environment from its name, e.g. `make_env("maniskill/PushCube-v1", width=224)`.

    Args:
        name: A registered name, with the task after a slash, or "module:Class".
        options: The options of the env's constructor.

    Returns:
        The environment, which the caller closes.

    Raises:
        UnknownEnv: The name or the task is unknown.
        ConfigError: An option is unknown, or its value is wrong.
        MissingDependency: The simulator is not installed.
        EnvFailed: The simulator or its assets cannot be loaded.
    """
    cls, arguments = env_arguments(name, options)
    return cls(**arguments)


def env_arguments(name: str, options: Mapping[str, Any]) -> tuple[type[EvalEnv], dict[str, Any]]:
    """Return the class of the env `name`, and the arguments of its constructor.

    Raises:
        VLAgentsError: The errors of `make_env` that can be detected without the simulator.
    """
    cls = env_class(name)
    if not issubclass(cls, EvalEnv):
        raise UnknownEnv(
            f"env {name!r}: expected an EvalEnv, got another class; name an environment of "
            "Gymnasium gymnasium/MODULE:ID"
        )
    task = env_task(name)
    arguments = {"task": task, **options} if task is not None else dict(options)
    require_arguments(f"env {name!r}", cls, arguments)
    cls.require_task(arguments.get("task"))
    return cls, arguments


def known_contract(name: str, options: Mapping[str, Any]) -> Contract | None:
    """Return the contract of the env `name` without creating the env.

    Returns:
        The contract; None if only the running simulator knows it.

    Raises:
        VLAgentsError: The errors of `env_arguments`.
    """
    cls, arguments = env_arguments(name, options)
    bound = inspect.signature(cls).bind(**arguments)
    bound.apply_defaults()
    return cls.known_contract(bound.arguments)


DELTA_POSE = ActionSpec(
    dim=7,
    space="ee_pose",
    delta=True,
    rotation="axis_angle",
    frame="base",
    gripper_open=-1.0,
    gripper_closed=1.0,
    low=-1.0,
    high=1.0,
)
"""The description of robosuite's actions: a change of the end effector's pose, and the gripper.

Environments with other actions replace a few fields.
"""


def require_cameras(env: str, names: Collection[str], have: Collection[str]) -> None:
    """Raise `ConfigError` unless an env has the cameras with these names."""
    unknown = sorted(set(names) - set(have))
    if unknown:
        raise ConfigError(f"{env}: expected cameras of {sorted(have)}, got {unknown}")


def require_known(suite: str, task: str | None, known: Sequence[str], also: str = "") -> None:
    """Raise `UnknownEnv` unless a task is known; `also` describes further allowed tasks."""
    if task not in known:
        hint = did_you_mean(str(task), known)
        raise UnknownEnv(f"{suite}: expected a task of {list(known)}{also}, got {task!r}{hint}")


def one_row(act: Act, contract: Contract) -> np.ndarray:
    """Return the action of a step, (D,) float32.

    Raises:
        InvalidAction: There is no Act, its action is a chunk, or it is not valid.
    """
    if not isinstance(act, Act):
        raise InvalidAction(
            f"action: expected an Act, got {type(act).__name__}; pass env.step(Act(row))"
        )
    action = check_action(act.action, contract)
    if action.ndim != 1:
        dim = contract.action.dim
        raise InvalidAction(
            f"action: expected shape ({dim},), got {action.shape}; step through a chunk row by row "
            "with `for row in act.rows(): env.step(Act(row))`"
        )
    return action


def make_batch(name: str, num_envs: int, **options: Any) -> BatchEnv:
    """Create several environments like `make_env`.

    They share one simulator if the suite supports this with the given options.

    Args:
        name: As in `make_env`.
        num_envs: The number of environments.
        options: As in `make_env`.

    Returns:
        The environments, which the caller closes.

    Raises:
        ConfigError: `num_envs` is below 1, or an option is wrong; also raises the other errors of
            `make_env`.
    """
    if num_envs < 1:
        raise ConfigError(
            f"env {name!r}: num_envs: expected a number of at least 1, got {num_envs}"
        )
    cls, arguments = env_arguments(name, options)
    batch = cls.batched(num_envs, **arguments)
    if batch is not None:
        return batch

    # If an environment cannot be created, close the environments created before.
    with ExitStack() as closing:
        envs = [closing.enter_context(cls(**arguments)) for _ in range(num_envs)]
        closing.pop_all()
        return SequentialBatch(envs)


# Key, in the info of an environment whose step failed, of the exception; other environments may
# have succeeded.
ERROR = "error"


class SequentialBatch(BatchEnv):
    """Environments that are stepped one after another, with one call of the policy for all of them.

    If one of several environments raises an exception in its step, such as `InvalidAction`, its
    info contains the exception under the key `ERROR`, and the other environments are still stepped:
    an episode does not depend on the episodes of other environments.
    """

    restarts = True

    def __init__(self, envs: Sequence[EvalEnv]) -> None:
        """Combine environments of one task; closing this object closes them."""
        self.several_tasks = envs[0].several_tasks
        self._envs = list(envs)
        self._playing = 0  # number of environments with an episode; these are the first ones
        self._last_obs: list[Obs] = []  # the last observation of each environment
        self.num_envs = len(self._envs)
        self.max_steps = self._envs[0].max_steps
        self.init_states = self._envs[0].init_states

    @property
    def contract(self) -> Contract:
        return self._envs[0].contract

    @property
    def instructions(self) -> list[str]:
        return [env.instruction for env in self._envs[: self._playing]]

    def reset(
        self, *, seeds: Sequence[int], options: Sequence[Options | None] | None = None
    ) -> list[Obs]:
        """Begin the episodes one after another; see `BatchEnv.reset`."""
        self._playing = episodes_of(seeds, self.num_envs)
        if not options:
            options = [None] * self._playing
        observations = []
        for env, seed, env_options in zip(self._envs, seeds, options, strict=False):
            observations.append(_first_obs(env, seed, env_options))
        self._last_obs = self._stacked(observations, range(self._playing))
        return self._last_obs

    def restart(self, index: int, *, seed: int, options: Options | None = None) -> Obs:
        self._last_obs[index] = _first_obs(self._envs[index], seed, options)
        return self._last_obs[index]

    def step(self, acts: Sequence[Act | None]) -> Steps:
        """Step the environments one after another; see `BatchEnv.step`."""
        count = len(acts)
        if count != self._playing:
            raise ConfigError(
                f"step: expected {self._playing} actions (None for an episode that has ended), "
                f"got {count}"
            )
        moving = {i: act for i, act in enumerate(acts) if act is not None}
        if count > 1:  # A single environment checks its own action.
            for act in moving.values():
                one_row(act, self.contract)

        moved = set(moving)
        observations = list(self._last_obs)
        rewards, terminated, truncated = [0.0] * count, [False] * count, [False] * count
        infos: list[dict[str, Any]] = [{}] * count
        for i, act in moving.items():
            try:
                result = self._step_env(i, act)
            except (Exception, SystemExit) as error:
                if count == 1:
                    raise
                infos[i] = {ERROR: error}
                moved.discard(i)
            else:
                observations[i], rewards[i], terminated[i], truncated[i], infos[i] = result

        self._last_obs = self._stacked(observations, moved)
        return self._last_obs, rewards, terminated, truncated, infos

    def _step_env(self, index: int, act: Act) -> tuple[Any, ...]:
        env = self._envs[index]
        env.looked_at = self.looked_at
        answer: Any = env.step(act)
        if not isinstance(answer, tuple) or len(answer) != 5:
            want = "(Obs, reward, terminated, truncated, info)"
            raise EnvFailed(f"env step: expected {want}, got {kind_of(answer)}; see EvalEnv.step")
        return answer

    def renderer(self) -> Renderer | None:
        return self._envs[0].renderer()

    def describe(self) -> dict[str, Any]:
        facts = self._envs[0].describe()
        return facts if self.num_envs == 1 else {**facts, "num_envs": self.num_envs}

    def close(self) -> None:
        """Close all environments, even if one of them raises an exception."""
        with ExitStack() as closing:
            for env in self._envs:
                closing.callback(env.close)

    def _stacked(self, observations: list[Obs], moved: Collection[int]) -> list[Obs]:
        """Return the observations with the images of each camera as rows of one array.

        If images are not used, or if no environment was stepped, the observations are returned
        unchanged. An idle environment may have omitted the images of its last step; images of a
        stepped environment then replace them.
        """
        if len(observations) == 1 or not moved or not self.looked_at:
            return observations
        substitutes = observations[min(moved)].cameras
        if not substitutes:
            return observations

        cameras = []
        for i, obs in enumerate(observations):
            cameras.append(obs.cameras if i in moved else {**substitutes, **obs.cameras})
        images = {}
        for name in cameras[0]:
            images[name] = np.stack([env_images[name] for env_images in cameras])

        stacked = []
        for i, obs in enumerate(observations):
            rows = {name: array[i] for name, array in images.items()}
            stacked.append(replace(obs, cameras=rows))
        return stacked


def _first_obs(env: EvalEnv, seed: int, options: Options | None) -> Obs:
    """Begin an episode, and return its first observation."""
    answer: Any = env.reset(seed=seed, options=options)
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise EnvFailed(
            f"env reset: expected (Obs, info), got {kind_of(answer)}; see EvalEnv.reset"
        )
    obs: Obs = answer[0]
    return obs


def episodes_of(seeds: Sequence[int], num_envs: int) -> int:
    """Return the number of episodes that `seeds` begin.

    Raises:
        ConfigError: There are more seeds than environments, or no seeds.
    """
    if not 1 <= len(seeds) <= num_envs:
        raise ConfigError(
            f"reset: expected 1 to {num_envs} seeds, one for each environment that runs an "
            f"episode, got {len(seeds)}"
        )
    return len(seeds)


def kind_of(answer: object) -> str:
    """Return a description of an environment's result, for an error message."""
    return f"a tuple of {len(answer)}" if isinstance(answer, tuple) else type(answer).__name__
