"""One environment of Gymnasium behind the interface of `EvalEnv`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import BatchEnv, EvalEnv
from vlagents_ray.envs.gymnasium.making import known, make, only_vectors
from vlagents_ray.envs.gymnasium.vector import GymnasiumBatch, VectorRows
from vlagents_ray.envs.gymnasium.view import SUCCESS_KEYS, Mapped, View, plain
from vlagents_ray.envs.rendering.graphics import prepare_rendering
from vlagents_ray.envs.simulator import record_size_of
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, NotReset, UnknownEnv, VLAgentsError
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import require


class Gymnasium(EvalEnv):
    """A Gymnasium environment with a continuous action vector, Box (D,).

    Actions are clipped to the Box. Success is `info["is_success"]` or `info["success"]` where the
    environment gives one; without it, and without the option `success`, no episode succeeds and
    only the returns say something.
    """

    suite: str = "gymnasium"
    """The registered name, for messages."""

    rows: int = 1
    """How many rows the VectorEnv has, if it is one; those of more than one are for a `GymnasiumBatch`."""

    def __init__(
        self,
        task: str | None = None,
        *,
        module: str | None = None,
        kwargs: Mapping[str, Any] | None = None,
        vectorization: str | None = None,
        cameras: Mapping[str, str] | None = None,
        state: Mapping[str, str] | None = None,
        gripper: str | None = None,
        gripper_range: tuple[float, float] = (0.0, 1.0),
        success: str | None = None,
        instruction: str | None = None,
        control_hz: float | None = None,
        unit_actions: bool = False,
        width: int | None = None,
        height: int | None = None,
        max_steps: int | None = None,
        remake: bool = False,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment, and check one observation of it.

        Args:
            task: The Gymnasium id.
            module: The module that registers the id; by default the id's namespace.
            kwargs: Arguments of `gymnasium.make`; `render_mode` is "rgb_array" by default.
            vectorization: How `gymnasium.make_vec` makes a VectorEnv: "sync", "async" (a process for each row), or
                "vector_entry_point"; None makes none, unless the id is registered with a vector entry point alone.
            cameras: name -> path of an (H, W, 3) uint8 image in the observation, or "render".
            state: name -> path of a vector, optionally with a range: "robot/qpos[0:7]"; see `Pick`.
            gripper: The path of a number in the observation.
            gripper_range: The values of that number (closed, open).
            success: The path of a bool in the step's info, or "terminated".
            instruction: The task in words.
            control_hz: The rate of the steps, Hz.
            unit_actions: Whether actions are in [-1, 1], and scaled here to the Box.
            width: The width to which every image is stretched, pixels.
            height: The height to which every image is stretched, pixels.
            max_steps: The step limit, instead of the registered one.
            remake: Whether each reset makes the simulator again, for one whose own reset keeps some state.
            record_size: Height and width of further copies of the images, for recordings only.

        Raises:
            UnknownEnv: There is no such id.
            ConfigError: An option does not fit the environment.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator cannot be made.
        """
        if task is None:
            raise UnknownEnv("gymnasium: got no id, want one, as in 'gymnasium/Pendulum-v1'")
        prepare_rendering()
        defaults = known(task)
        self._id, self._name = task, f"{self.suite}/{task}"
        self._module = module if module is not None else defaults.module
        self._vectorization = vectorization
        self._kwargs = {**defaults.kwargs, **(kwargs or {})}
        self._protocol = defaults.protocol
        self._success = success
        self._unit_actions = unit_actions
        self._remake = remake
        self._ready = False
        self._steps = 0
        self._env = self._make(max_steps)
        try:
            self._instruction = instruction if instruction is not None else defaults.instruction or self._stated_task()
            self.max_steps = self._step_limit(max_steps)
            self._action_space = str(self._env.action_space)
            mapped = Mapped(
                cameras=cameras if cameras is not None else defaults.cameras,
                state=state,
                gripper=gripper,
                gripper_range=gripper_range,
                success=success,
                unit_actions=unit_actions,
                size=(height, width),
                record_size=record_size_of(record_size, self._name),
            )
            self._view = View(self._name, self._env, mapped)
            self._check_vectorized()
            first, _ = self._call("reset", seed=0)
            self._contract = self._view.contract(
                self._observe(first),
                instruction=bool(self._instruction),
                control_hz=control_hz or defaults.control_hz,
            )
        except BaseException:
            self.close()
            raise

    @classmethod
    def missing(cls) -> str | None:
        try:
            require("gymnasium")
        except MissingDependency as error:
            return str(error)
        return None

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    def describe(self) -> dict[str, Any]:
        played = {"max_steps": self.max_steps, "control_hz": self._contract.control_hz}
        return {
            "id": self._id,
            "gymnasium": require("gymnasium").__version__,
            "kwargs": plain(self._kwargs),
            "action_space": self._action_space,
            "unit_actions": self._unit_actions,
            **({"autoreset": self._env.autoreset} if isinstance(self._env, VectorRows) else {}),
            "success": self._success or f"info: {' or '.join(SUCCESS_KEYS)}",
            "protocol": self._protocol.describe(**played) if self._protocol is not None else played,
        }

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        if seed < 0:
            raise ConfigError(f"{self._name}: seed is {seed}, want 0 or more")
        if self._env is None:
            raise NotReset(f"{self._name}: is closed; make it again")
        if self._remake:
            self._call("close")
            self._env = self._make(self.max_steps)
        nested, info = self._call("reset", seed=seed, options=dict(options) if options else None)
        self._ready, self._steps = True, 0
        return self._observe(nested), plain(info)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        if not self._ready:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        nested, reward, terminated, truncated, info = self._call("step", self._view.command(act, self._contract))
        self._steps += 1
        success = self._view.succeeded(info, bool(terminated))
        stopped = bool(truncated) or self._steps >= self.max_steps
        # Unused images are rendered as well: rendering changes the state of some envs (the target of the Fetch tasks).
        return self._observe(nested), float(reward), bool(terminated), stopped, {**plain(info), "success": success}

    def close(self) -> None:
        self._ready = False
        if self._env is not None:
            env, self._env = self._env, None
            env.close()

    @classmethod
    def batched(cls, num_envs: int, **options: Any) -> BatchEnv | None:
        """Make the rows of one VectorEnv, if these options make one."""
        if not cls._makes_vectors(options):
            return None
        several: type[Gymnasium] = type(cls.__name__, (cls,), {"rows": num_envs})
        return several(**options)._as_batch()

    @classmethod
    def _makes_vectors(cls, options: Mapping[str, Any]) -> bool:
        """Whether the constructor makes a VectorEnv of its options."""
        task, module = options.get("task"), options.get("module")
        return options.get("vectorization") is not None or (task is not None and only_vectors(task, module))

    def _make(self, max_steps: int | None) -> Any:
        """Make the environment: a `gymnasium.Env`, or `VectorRows` with `rows` of them."""
        return make(
            self._name,
            self._id,
            module=self._module,
            kwargs=self._kwargs,
            vectorization=self._vectorization,
            rows=self.rows,
            max_steps=max_steps,
        )

    def _as_batch(self) -> GymnasiumBatch:
        return GymnasiumBatch(
            self._name,
            self._env,
            self._view,
            self._contract,
            max_steps=self.max_steps,
            instruction=self._instruction,
            described=self.describe(),
        )

    def _check_vectorized(self) -> None:
        if not isinstance(self._env, VectorRows):
            return
        if self._remake:
            raise ConfigError(f"{self._name}: remake is for environments that are no VectorEnv; leave it out")
        if self._view.renders and self._env.autoreset == "SAME_STEP":
            raise ConfigError(
                f"{self._name}: its VectorEnv resets a row in the step that ends an episode (SAME_STEP), so that the "
                f"last picture of its renderer is the next episode's; choose `cameras` in the observation, or another "
                f"autoreset mode"
            )

    def _stated_task(self) -> str:
        """Return the task in words that the rows of a VectorEnv state as those of LeRobot do; "" if there is none."""
        if not isinstance(self._env, VectorRows):
            return ""
        words = self._env.stated("task_description") or self._env.stated("task")
        return words if isinstance(words, str) else ""

    def _step_limit(self, wanted: int | None) -> int:
        spec = self._env.spec
        limit = wanted or (spec.max_episode_steps if spec is not None else None)
        if limit is None and isinstance(self._env, VectorRows):
            limit = self._env.stated("_max_episode_steps")  # as LeRobot's environments have it
        if limit is None or limit < 1:
            raise ConfigError(f"{self._name}: its step limit is {limit}; set `max_steps` to 1 or more")
        return int(limit)

    def _call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        try:
            return getattr(self._env, method)(*args, **kwargs)
        except VLAgentsError:
            raise
        except Exception as error:
            raise EnvFailed(f"{self._name}: {method} raised {type(error).__name__}: {error}") from error

    def _observe(self, nested: Any) -> Obs:
        return self._view.observe(nested, lambda: self._call("render"))
