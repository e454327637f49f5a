"""Our environments as a `gymnasium.vector.VectorEnv`, for learners that step environments themselves."""

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
    """Return Box (D,) float32 within the contract's bounds; raises `ConfigError` if the contract lacks D."""
    spec = contract.action
    low, high = (-np.inf if spec.low is None else spec.low), (np.inf if spec.high is None else spec.high)
    return gymnasium.spaces.Box(low, high, (_stated(spec.dim, "action.dim"),), np.float32)


def observation_space(contract: Contract, observation: Observation) -> Any:
    """Return the space of `observed`; raises `ConfigError` if the contract does not state a size."""
    spaces = gymnasium.spaces
    state = {
        f"state/{name}": spaces.Box(-np.inf, np.inf, (_stated(spec.dim, f"state {name!r}: dim"),), np.float32)
        for name, spec in sorted((contract.state or {}).items())
    }
    if contract.gripper:
        state["gripper"] = spaces.Box(0.0, 1.0, (1,), np.float32)
    if observation == "all":
        cameras = {
            f"cameras/{name}": spaces.Box(
                0, 255, (_stated(one.height, f"{name}: height"), _stated(one.width, f"{name}: width"), 3), np.uint8
            )
            for name, one in sorted((contract.cameras or {}).items())
        }
        return spaces.Dict(cameras | state)
    if not state:
        raise ConfigError("observation: got 'state', but the env's contract has none and no gripper; want 'all'")
    low, high = (np.concatenate([getattr(part, bound) for part in state.values()]) for bound in ("low", "high"))
    return spaces.Box(low, high, dtype=np.float32)


def observed(obs: Obs, observation: Observation) -> Any:
    """Return an observation as a member of its space, in new arrays.

    Args:
        obs: The observation of the environment.
        observation: "all" is a dict of `cameras/NAME`, `state/NAME` and, with a gripper, `gripper`, (1,). "state" is
            one vector: the parts of the state by name, then the gripper.
    """
    state = {f"state/{name}": np.array(part, np.float32) for name, part in sorted(obs.state.items())}
    if obs.gripper is not None:
        state["gripper"] = np.array([obs.gripper], np.float32)
    if observation == "state":
        return np.concatenate(list(state.values()))
    return {f"cameras/{name}": np.array(image) for name, image in sorted(obs.cameras.items())} | state


def _stated(size: int | None, what: str) -> int:
    if size is None:
        raise ConfigError(f"{what}: the env's contract does not state it, but Gymnasium wants to know; state it there")
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

    A simulator with many environments, such as ManiSkill on a GPU, steps them at once; other environments are stepped
    one after another in this process.

    Args:
        env: The name of the env, as for `make_env`.
        num_envs: The number of environments, N.
        observation: "all" is a dict of `cameras/NAME` (N, H, W, 3) uint8, `state/NAME` (N, D) float32 and `gripper`
            (N, 1) float32. "state" is all but the images, as one array (N, D) float32: the parts of the state by name,
            then the gripper.
        autoreset: What follows the end of an episode (https://farama.org/Vector-Autoreset-Mode). With "same_step", the
            observation is already that of the next episode, and `infos["final_obs"]` has the last one of the old
            episode.
        env_options: The options of the env's constructor.
        reset_options: The options of each reset of an environment.

    Returns:
        The environments, which the caller closes.

    Raises:
        ConfigError: An option is wrong, or the env's contract does not state a size.
        MissingDependency: Gymnasium or the simulator is not installed.
        UnknownEnv: The name or the task is unknown.
    """
    for name, got, known in (("observation", observation, Observation), ("autoreset", autoreset, Autoreset)):
        if got not in get_args(known):
            raise ConfigError(f"{name}: got {got!r}, want one of {list(get_args(known))}")
    batch = make_batch(env, num_envs, **(env_options or {}))
    try:
        return BatchVectorEnv(batch, observation, vector.AutoresetMode[autoreset.upper()], reset_options)
    except BaseException:
        batch.close()
        raise


class BatchVectorEnv(vector.VectorEnv):  # type: ignore[misc]
    """The environments of a `BatchEnv` with Gymnasium's interface.

    `reset(seed=S)` begins episodes 0 to N - 1. Episode i has the seed S + i, as in an evaluation; each new episode has
    the next number. Without a seed, numbers continue; the first S is drawn at random.

    `infos["success"]` states whether the task is solved. `infos["instruction"]` and `infos["episode_seed"]` are set
    whenever an episode begins, the former also after each step if the episodes have several tasks. A step limit of the
    environment truncates an episode.
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
            ConfigError: The environments' contract does not state a size.
        """
        self._batch, self._observation, self._reset_options = batch, observation, dict(reset_options or {})
        self.autoreset_mode = autoreset
        self._contract = batch.contract
        self.num_envs = batch.num_envs
        self.metadata = {"render_modes": [], "autoreset_mode": autoreset}
        self.single_observation_space = observation_space(self._contract, observation)
        self.single_action_space = action_space(self._contract)
        self.observation_space = vector.utils.batch_space(self.single_observation_space, self.num_envs)
        self.action_space = vector.utils.batch_space(self.single_action_space, self.num_envs)
        self._seed: int | None = None  # of episode 0
        self._begun = 0  # episodes
        self._over = np.zeros(self.num_envs, np.bool_)
        self._steps = np.zeros(self.num_envs, np.int64)
        self._seen: list[Obs] = []  # the current observation of each; none before the first reset

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begin an episode in each environment.

        Args:
            seed: The seed S of episode 0; None continues with the next numbers. Or, as in Gymnasium, a seed for each
                environment's episode; later episodes continue after the largest.
            options: Options of the environments' resets. `reset_mask`, (N,) bool, is Gymnasium's: only these
                environments begin one.

        Returns:
            The observations, and the infos.
        """
        given = dict(options or {})
        which, n = given.pop(_RESET_MASK, None), self.num_envs
        which = np.ones(n, np.bool_) if which is None else which
        if not isinstance(which, np.ndarray) or which.dtype != np.bool_ or which.shape != (n,) or not which.any():
            raise ConfigError(f"{_RESET_MASK}: got {which!r}, want a bool array of shape ({n},), true somewhere")
        stated = None if seed is None or isinstance(seed, int) else _seeds(seed, which)
        super().reset(seed=seed if stated is None else stated[0])
        if stated is not None:
            self._seed, self._begun = max(stated) + 1 - len(stated), 0
        elif isinstance(seed, int):
            self._seed, self._begun = seed, 0
        elif self._seed is None:
            self._seed = int(self.np_random.integers(2**31))
        infos: dict[str, Any] = {}
        self._begin(which, infos, given, stated)
        return self._observations(), infos

    def step(self, actions: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Execute an action in each environment.

        Args:
            actions: One action for each environment, (N, D) float32.

        Returns:
            The observations, rewards (N,) float64, terminated (N,) bool, truncated (N,) bool, and the infos.
        """
        if not self._seen:
            raise NotReset("step before reset; call reset(seed=...) first")
        if self._over.any() and self.autoreset_mode == vector.AutoresetMode.DISABLED:
            raise NotReset(
                f"environments {np.flatnonzero(self._over).tolist()} are over, and autoreset is disabled; call "
                f"reset(options={{'reset_mask': ...}})"
            )
        rows = np.asarray(actions, np.float32)
        if rows.shape != self.action_space.shape:
            raise InvalidAction(f"actions: got {rows.shape}, want {self.action_space.shape}, a row an environment")
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, np.bool_), np.zeros(self.num_envs, np.bool_)
        infos: dict[str, Any] = {}
        restarted, moving = self._over.copy(), ~self._over  # episodes can be over only in mode "next_step"
        if restarted.any():
            self._begin(restarted, infos)
        for i, step, info in self._moved(rows, moving):
            rewards[i], terminated[i], self._seen[i] = step.reward, step.terminated, step.obs
            truncated[i] = not step.terminated and (step.truncated or self._steps[i] >= self._batch.max_steps)
            self._over[i] = terminated[i] or truncated[i]
            if self._batch.several_tasks:
                info["instruction"] = self._batch.instructions[i]
            last = self._over[i] and self.autoreset_mode == vector.AutoresetMode.SAME_STEP
            said = {"final_obs": observed(step.obs, self._observation), "final_info": info} if last else info
            self._add_info(infos, said, i)
        if self._over.any() and self.autoreset_mode == vector.AutoresetMode.SAME_STEP:
            self._begin(self._over.copy(), infos)
        return self._observations(), rewards, terminated, truncated, infos

    def close_extras(self, **_kwargs: Any) -> None:
        self._batch.close()

    def _moved(self, rows: np.ndarray, moving: np.ndarray) -> list[tuple[int, Any, dict[str, Any]]]:
        """Step the environments that are `moving`; return the number, the outputs and the info of each."""
        if not moving.any():
            return []
        self._batch.looked_at = images = self._observation == "all"
        with env_side("step"):
            acts = [Act(row) if moves else None for row, moves in zip(rows, moving, strict=True)]
            seen, rewards, terminated, truncated, infos = self._batch.step(acts)
            for error in (info[ERROR] for info in infos if ERROR in info):
                raise error
        self._steps += moving
        outputs = [*zip(seen, rewards, terminated, truncated, infos, strict=True)]
        return [
            (i, checked_step(*outputs[i], self._contract, images=images), dict(infos[i]))
            for i in np.flatnonzero(moving).tolist()
        ]

    def _begin(
        self,
        which: np.ndarray,
        infos: dict[str, Any],
        given: Mapping[str, Any] | None = None,
        stated: Sequence[int] | None = None,
    ) -> None:
        """Begin an episode in these environments, and add its infos."""
        assert self._seed is not None  # noqa: S101 - `reset` has set it
        chosen = np.flatnonzero(which).tolist()
        if not which.all() and not self._batch.restarts:
            raise ConfigError(
                f"{len(chosen)} of {self.num_envs} episodes are over, and this simulator resets all its environments "
                f"together; want one whose episodes end together, as those of a step limit do, or num_envs=1"
            )
        if not which.all() and not self._seen:
            raise NotReset(f"reset: got a {_RESET_MASK} before the first reset; call reset(seed=...) for all first")
        numbers = range(self._begun, self._begun + len(chosen))
        seeds = stated or [self._seed + number for number in numbers]
        merged = {**self._reset_options, **(given or {})}
        options = [options_of_reset(self._batch, number, merged) for number in numbers]
        with env_side("reset"):
            if which.all():
                self._seen = [*self._batch.reset(seeds=seeds, options=options)]
            else:
                for i, seed, option in zip(chosen, seeds, options, strict=True):
                    self._seen[i] = self._batch.restart(i, seed=seed, options=option)
            instructions = self._batch.instructions
        self._begun += len(chosen)
        self._over[which], self._steps[which] = False, 0
        for i, seed in zip(chosen, seeds, strict=True):
            checked_obs(self._seen[i], self._contract, "reset")
            self._add_info(infos, {"instruction": instructions[i], "episode_seed": seed}, i)

    def _observations(self) -> Any:
        rows = [observed(obs, self._observation) for obs in self._seen]
        if self._observation == "state":
            return np.stack(rows)
        return {name: np.stack([row[name] for row in rows]) for name in self.single_observation_space}


def _seeds(seeds: Sequence[int | None], which: np.ndarray) -> list[int]:
    """Return the seeds of the environments that begin an episode, from a list for all environments."""
    if len(seeds) != which.size:
        raise InvalidInput(f"seed: got {len(seeds)} seeds, want {which.size}, one for each environment")
    found = [seeds[i] for i in np.flatnonzero(which).tolist()]
    if not found or not all(isinstance(one, (int, np.integer)) and one >= 0 for one in found):
        raise InvalidInput(f"seed: got {list(seeds)}, want a whole number for each environment that begins an episode")
    return [int(one) for one in found if one is not None]
