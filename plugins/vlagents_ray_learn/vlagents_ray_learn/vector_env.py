"""Environments as a `gymnasium.vector.VectorEnv`, for learners that step the environments
themselves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import ERROR, BatchEnv, make_batch
from vlagents_ray.errors import ConfigError, InvalidAction, InvalidInput, NotReset
from vlagents_ray.evaluate.episode.episode import options_of_reset
from vlagents_ray.evaluate.episode.failures import checked_obs, checked_step, env_side
from vlagents_ray.interface import Act, Obs
from vlagents_ray_learn.optional import optional

gymnasium: Any = optional("gymnasium")
vector: Any = optional("gymnasium.vector")

Observation = Literal["all", "state"]
Autoreset = Literal["same_step", "next_step", "disabled"]
_RESET_MASK = "reset_mask"  # Gymnasium's name of the option


def action_space(contract: Contract) -> Any:
    """Return the action space of one environment, a Box (D,) of float32 within the contract's
    bounds.

    Raises:
        ConfigError: The contract does not define D.
    """
    spec = contract.action
    low = -np.inf if spec.low is None else spec.low
    high = np.inf if spec.high is None else spec.high
    dim = _size(spec.dim, "action.dim")
    return gymnasium.spaces.Box(low, high, (dim,), np.float32)


def observation_space(contract: Contract, observation: Observation) -> Any:
    """Return the space of the results of `observed`.

    Args:
        contract: The contract of the environment.
        observation: "all" or "state", as for `observed`.

    Raises:
        ConfigError: The contract does not define a size, or "state" would be empty.
    """
    spaces = gymnasium.spaces
    state = {}
    for name, spec in sorted((contract.state or {}).items()):
        dim = _size(spec.dim, f"state {name!r}: dim")
        state[f"state/{name}"] = spaces.Box(-np.inf, np.inf, (dim,), np.float32)
    if contract.gripper:
        state["gripper"] = spaces.Box(0.0, 1.0, (1,), np.float32)

    if observation == "all":
        cameras = {}
        for name, camera in sorted((contract.cameras or {}).items()):
            height = _size(camera.height, f"{name}: height")
            width = _size(camera.width, f"{name}: width")
            cameras[f"cameras/{name}"] = spaces.Box(0, 255, (height, width, 3), np.uint8)
        return spaces.Dict(cameras | state)

    if not state:
        raise ConfigError(
            "observation: expected 'all', as the env's contract has neither a state nor a gripper, "
            "got 'state'"
        )
    low = np.concatenate([space.low for space in state.values()])
    high = np.concatenate([space.high for space in state.values()])
    return spaces.Box(low, high, dtype=np.float32)


def observed(obs: Obs, observation: Observation) -> Any:
    """Return an observation as a member of its space, in new arrays.

    Args:
        obs: The observation of the environment.
        observation: "all" is a dict of `cameras/NAME`, `state/NAME` and, with a gripper, `gripper`,
            (1,). "state" is one vector: the values of the state sorted by name, then the gripper.
    """
    state = {}
    for name, values in sorted(obs.state.items()):
        state[f"state/{name}"] = np.array(values, np.float32)
    if obs.gripper is not None:
        state["gripper"] = np.array([obs.gripper], np.float32)
    if observation == "state":
        return np.concatenate(list(state.values()))
    cameras = {f"cameras/{name}": np.array(image) for name, image in sorted(obs.cameras.items())}
    return cameras | state


def _size(size: int | None, field: str) -> int:
    """Return a size from the contract; raises `ConfigError` if the contract does not define it."""
    if size is None:
        raise ConfigError(
            f"{field}: expected it in the env's contract, as Gymnasium needs it, got none; add it "
            "there"
        )
    return size


def as_vector_env(
    env: str,
    num_envs: int = 1,
    *,
    observation: Observation = "all",
    autoreset: Autoreset = "same_step",
    env_options: Mapping[str, Any] | None = None,
    reset_options: Mapping[str, Any] | None = None,
) -> BatchVectorEnv:
    """Make vector environments for learners that use Gymnasium.

    A simulator with many environments, such as ManiSkill on a GPU, steps all of them at once. Other
    environments are stepped one after another in this process.

    Args:
        env: The name of the env, as for `make_env`.
        num_envs: The number of environments, N.
        observation: "all" is a dict of `cameras/NAME` (N, H, W, 3) uint8, `state/NAME` (N, D)
            float32 and `gripper` (N, 1) float32. "state" has no images, and is one array (N, D)
            float32: the values of the state sorted by name, then the gripper.
        autoreset: Gymnasium's mode of resets after the end of an episode
            (https://farama.org/Vector-Autoreset-Mode). With "same_step", the returned observation
            is already the first of the next episode, and `infos["final_obs"]` contains the last
            observation of the old episode.
        env_options: The options of the env's constructor.
        reset_options: The options of each reset of an environment.

    Returns:
        The environments, which the caller closes.

    Raises:
        ConfigError: An option is wrong, or the env's contract does not define a size.
        MissingDependency: Gymnasium or the simulator is not installed.
        UnknownEnv: The name or the task is unknown.
    """
    _require_choice("observation", observation, get_args(Observation))
    _require_choice("autoreset", autoreset, get_args(Autoreset))
    batch = make_batch(env, num_envs, **(env_options or {}))
    try:
        autoreset_mode = vector.AutoresetMode[autoreset.upper()]
        return BatchVectorEnv(batch, observation, autoreset_mode, reset_options)
    except BaseException:
        batch.close()
        raise


def _require_choice(name: str, choice: str, choices: Sequence[str]) -> None:
    """Raise `ConfigError` unless an option has one of its values."""
    if choice not in choices:
        raise ConfigError(f"{name}: expected one of {list(choices)}, got {choice!r}")


class BatchVectorEnv(vector.VectorEnv):  # type: ignore[misc]
    """The environments of a `BatchEnv` with Gymnasium's interface.

    `reset(seed=S)` begins episodes 0 to N - 1. Episode i has the seed S + i, as in an evaluation,
    and each new episode has the next number. A reset without a seed continues with the next
    numbers. If the first reset has no seed, S is drawn at random.

    `infos["success"]` contains whether the task is solved. `infos["instruction"]` and
    `infos["episode_seed"]` are set whenever an episode begins. If the episodes have several tasks,
    `infos["instruction"]` is also set after each step. The environment's step limit truncates an
    episode.
    """

    def __init__(
        self,
        batch: BatchEnv,
        observation: Observation = "all",
        autoreset: Any = vector.AutoresetMode.SAME_STEP,
        reset_options: Mapping[str, Any] | None = None,
    ) -> None:
        """Wrap environments, which `close` closes.

        Args:
            batch: The environments.
            observation: The form of the observations, as for `as_vector_env`.
            autoreset: A `gymnasium.vector.AutoresetMode`.
            reset_options: The options of each reset of an environment.

        Raises:
            ConfigError: The environments' contract does not define a size.
        """
        self._batch = batch
        self._observation = observation
        self._reset_options = dict(reset_options or {})
        self._contract = batch.contract

        # The attributes of Gymnasium's interface.
        self.autoreset_mode = autoreset
        self.num_envs = batch.num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": autoreset}
        self.single_observation_space = observation_space(self._contract, observation)
        self.single_action_space = action_space(self._contract)
        batch_space = vector.utils.batch_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

        self._seed: int | None = None  # seed of episode 0
        self._begun = 0  # number of episodes up to now
        self._over = np.zeros(self.num_envs, np.bool_)  # whether the episode is over
        self._steps = np.zeros(self.num_envs, np.int64)  # number of steps in the episode
        # The current observation of each environment; empty before the first reset.
        self._obs: list[Obs] = []

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each environment.

        Args:
            seed: The seed S of episode 0; None continues with the next numbers. As in Gymnasium, a
                list contains a seed for each environment's episode. Later episodes continue after
                the largest of these seeds.
            options: Options of the environments' resets. With Gymnasium's option `reset_mask`,
                (N,) bool, only these environments begin an episode.

        Returns:
            The observations, and the infos.

        Raises:
            ConfigError: The mask is wrong, or the simulator resets all environments together.
            InvalidInput: A seed is missing or negative.
            NotReset: A mask is given in the first reset.
        """
        env_options = dict(options or {})
        mask = self._checked_mask(env_options.pop(_RESET_MASK, None))
        seeds: list[int] | None = None
        if seed is None or isinstance(seed, int):
            super().reset(seed=seed)
        else:
            seeds = _masked_seeds(seed, mask)
            super().reset(seed=seeds[0])

        if seeds is not None:
            # The seed of the next episode, number len(seeds), is the largest seed plus 1.
            self._seed, self._begun = max(seeds) + 1 - len(seeds), 0
        elif isinstance(seed, int):
            self._seed, self._begun = seed, 0
        elif self._seed is None:
            self._seed = int(self.np_random.integers(2**31))

        infos: dict[str, Any] = {}
        self._begin(mask, infos, env_options, seeds)
        return self._observations(), infos

    def _checked_mask(self, mask: Any) -> np.ndarray:
        """Return the environments in which a reset begins an episode, (N,) bool.

        Raises:
            ConfigError: The option is neither None nor a mask that selects at least one
                environment.
        """
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        shape = (self.num_envs,)
        is_mask = isinstance(mask, np.ndarray) and mask.dtype == np.bool_ and mask.shape == shape
        if not is_mask or not mask.any():
            raise ConfigError(
                f"{_RESET_MASK}: expected a bool array of shape {shape}, true somewhere, got "
                f"{mask!r}"
            )
        selected: np.ndarray = mask
        return selected

    def step(
        self, actions: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Execute an action in each environment.

        Args:
            actions: One action for each environment, (N, D) float32.

        Returns:
            The observations, rewards (N,) float64, terminated (N,) bool, truncated (N,) bool, and
            the infos.

        Raises:
            NotReset: There was no reset, or an episode is over and autoreset is disabled.
            InvalidAction: The actions have a wrong shape, or one of them is not valid.
            VLAgentsError: An environment failed.
        """
        if not self._obs:
            raise NotReset("step was called before reset; call reset(seed=...) first")
        if self._over.any() and self.autoreset_mode == vector.AutoresetMode.DISABLED:
            raise NotReset(
                f"environments {np.flatnonzero(self._over).tolist()} are over, and autoreset is "
                "disabled; call reset(options={'reset_mask': ...})"
            )
        rows = np.asarray(actions, np.float32)
        if rows.shape != self.action_space.shape:
            raise InvalidAction(
                f"actions: expected shape {self.action_space.shape}, a row for each environment, "
                f"got {rows.shape}"
            )

        rewards = np.zeros(self.num_envs)
        terminated = np.zeros(self.num_envs, np.bool_)
        truncated = np.zeros(self.num_envs, np.bool_)
        infos: dict[str, Any] = {}

        restarted = self._over.copy()  # episodes can be over only in mode "next_step"
        moving = ~restarted
        if restarted.any():
            self._begin(restarted, infos)

        resets_at_once = self.autoreset_mode == vector.AutoresetMode.SAME_STEP
        for i, step, info in self._step_moving(rows, moving):
            self._obs[i] = step.obs
            rewards[i] = step.reward
            terminated[i] = step.terminated
            out_of_steps = self._steps[i] >= self._batch.max_steps
            truncated[i] = not step.terminated and (step.truncated or out_of_steps)
            self._over[i] = terminated[i] or truncated[i]
            if self._batch.several_tasks:
                info["instruction"] = self._batch.instructions[i]
            if self._over[i] and resets_at_once:
                final = {"final_obs": observed(step.obs, self._observation), "final_info": info}
                self._add_info(infos, final, i)
            else:
                self._add_info(infos, info, i)
        if resets_at_once and self._over.any():
            self._begin(self._over.copy(), infos)
        return self._observations(), rewards, terminated, truncated, infos

    def close_extras(self, **_kwargs: Any) -> None:
        self._batch.close()

    def _step_moving(
        self, rows: np.ndarray, moving: np.ndarray
    ) -> list[tuple[int, Any, dict[str, Any]]]:
        """Step some environments.

        Args:
            rows: The actions, (N, D).
            moving: Whether to step each environment, (N,) bool.

        Returns:
            The index, the checked step and the info of each stepped environment.
        """
        if not moving.any():
            return []
        images = self._observation == "all"
        self._batch.looked_at = images
        with env_side("step"):
            acts = [Act(row) if moves else None for row, moves in zip(rows, moving, strict=True)]
            obs, rewards, terminated, truncated, infos = self._batch.step(acts)
            for info in infos:
                if ERROR in info:
                    raise info[ERROR]
        self._steps += moving
        moved = []
        for i in np.flatnonzero(moving).tolist():
            step = checked_step(
                obs[i],
                rewards[i],
                terminated[i],
                truncated[i],
                infos[i],
                self._contract,
                images=images,
            )
            moved.append((i, step, dict(infos[i])))
        return moved

    def _begin(
        self,
        mask: np.ndarray,
        infos: dict[str, Any],
        env_options: Mapping[str, Any] | None = None,
        chosen_seeds: Sequence[int] | None = None,
    ) -> None:
        """Begin an episode in some environments.

        Args:
            mask: The environments in which an episode begins, (N,) bool.
            infos: The infos, to which the instructions and the seeds are added.
            env_options: Options of the resets, in addition to `reset_options`.
            chosen_seeds: The seeds of the episodes; None continues with the next numbers.
        """
        assert self._seed is not None  # noqa: S101 - `reset` has set it
        indices = np.flatnonzero(mask).tolist()
        if not mask.all() and not self._batch.restarts:
            raise ConfigError(
                f"{len(indices)} of {self.num_envs} episodes are over, and this simulator resets "
                "all its environments together; use one whose episodes end together, as those of "
                "a step limit do, or num_envs=1"
            )
        if not mask.all() and not self._obs:
            raise NotReset(
                f"reset: expected a reset of all before the first {_RESET_MASK}, got none; call "
                "reset(seed=...)"
            )

        numbers = range(self._begun, self._begun + len(indices))
        seeds = chosen_seeds or [self._seed + number for number in numbers]
        merged = {**self._reset_options, **(env_options or {})}
        options = [options_of_reset(self._batch, number, merged) for number in numbers]
        with env_side("reset"):
            if mask.all():
                self._obs = list(self._batch.reset(seeds=seeds, options=options))
            else:
                for i, seed, option in zip(indices, seeds, options, strict=True):
                    self._obs[i] = self._batch.restart(i, seed=seed, options=option)
            instructions = self._batch.instructions

        self._begun += len(indices)
        self._over[mask] = False
        self._steps[mask] = 0
        for i, seed in zip(indices, seeds, strict=True):
            checked_obs(self._obs[i], self._contract, "reset")
            self._add_info(infos, {"instruction": instructions[i], "episode_seed": seed}, i)

    def _observations(self) -> Any:
        """Return the current observations of all environments as a member of the observation
        space.
        """
        rows = [observed(obs, self._observation) for obs in self._obs]
        if self._observation == "state":
            return np.stack(rows)
        observations = {}
        for name in self.single_observation_space:
            observations[name] = np.stack([row[name] for row in rows])
        return observations


def _masked_seeds(seeds: Sequence[int | None], mask: np.ndarray) -> list[int]:
    """Return the seeds of the environments that begin an episode.

    Args:
        seeds: N seeds, one for each environment. The seeds of the other environments may be None.
        mask: Whether each environment begins an episode, (N,) bool.

    Raises:
        InvalidInput: The number of seeds is wrong, or a seed is missing or negative.
    """
    if len(seeds) != mask.size:
        raise InvalidInput(
            f"seed: expected {mask.size} seeds, one for each environment, got {len(seeds)}"
        )
    masked_seeds = []
    for i in np.flatnonzero(mask).tolist():
        seed = seeds[i]
        if not isinstance(seed, (int, np.integer)) or seed < 0:
            raise InvalidInput(
                "seed: expected a whole number for each environment that begins an episode, got "
                f"{list(seeds)}"
            )
        masked_seeds.append(int(seed))
    return masked_seeds
