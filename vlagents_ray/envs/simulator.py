"""The base class of simulator environments, cameras for MuJoCo, and the protocols of benchmarks."""

from __future__ import annotations

import importlib.util
import os
from abc import abstractmethod
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import EvalEnv, Metric, Options, one_row, require_cameras, require_known
from vlagents_ray.envs.graphics import EGL_CURE, egl_probe, prepare_rendering, vulkan_cure
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset, VLAgentsError
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import require

Size = tuple[int, int]  # height, width in pixels


@dataclass(frozen=True, slots=True)
class BenchmarkProtocol:
    """The common settings of the published results of a benchmark, and their source.

    `describe()["protocol"]` of an environment contains them.
    """

    name: str
    source: str  # the publication or code with these settings
    max_steps: int
    control_hz: float
    control: str  # the quantity that an action commands
    success: str  # the condition under which an episode counts as solved
    metric: Metric  # whether the condition must hold after any step, or after the last step
    begins: str  # the effect of an episode's seed and initial state
    ends_on_success: bool
    episodes: int | None = None  # episodes per task in published tables; None if they differ

    def describe(self, **settings: Any) -> dict[str, Any]:
        """Return the protocol as plain values.

        Args:
            settings: Fields of the protocol, with the values in use.

        Returns:
            The fields of the protocol by name, and `deviations`, a sentence for each setting that
            differs from the protocol.
        """
        deviations = []
        for name, value in settings.items():
            expected = getattr(self, name)
            if value != expected:
                deviations.append(f"{name}: {value}, the protocol says {expected}")
        return asdict(self) | {"deviations": deviations}


class SimulatorEnv(EvalEnv):
    """One environment of a simulator in this process.

        with RoboCasa("NavigateKitchen") as env:
            obs, _ = env.reset(seed=0)
            act = Act(action=np.zeros(12, np.float32))
            obs, reward, terminated, truncated, info = env.step(act)

    A subclass sets the class variables below, creates its simulator in the constructor within the
    context `_making`, and registers the clean-up with `_resources`. The method `_begin` begins an
    episode, and `_advance` executes a step. Both are called only while the simulator is open, and
    their errors are converted to `EnvFailed`.

    Most constructors have the following options; None selects the default of the task or the
    protocol: `width` and `height` of each image, pixels; `instruction`, the task in words;
    `max_steps`, the step limit; `ends_on_success`, whether success ends the episode (if False,
    success at the end can also be measured).
    """

    suite: ClassVar[str]
    title: ClassVar[str]  # the name as used in sentences
    packages: ClassVar[tuple[str, ...]]  # the modules that the subclass imports
    # The packages whose versions are recorded in results.
    distributions: ClassVar[tuple[str, ...]] = ("mujoco",)
    cure: ClassVar[str]  # the command that installs the packages

    _contract: Contract
    _instruction: str = ""
    _protocol: BenchmarkProtocol | None = None
    _ends_on_success: bool = True
    _env: Any = None  # the simulator; None before it is created and after `close`
    _steps: int | None = None  # steps of the current episode; None before the first reset

    def __init__(self, task: str, **sizes: int | None) -> None:
        """Check the arguments, and set the environment variables that drivers read.

        Args:
            task: The name of the task.
            sizes: Options of the constructor; each must be None or at least 1.

        Raises:
            UnknownEnv: The task is not known.
            ConfigError: A size is below 1.
        """
        self.require_task(task)
        self._name = f"{self.suite}/{task}"
        require_sizes(self._name, **sizes)
        self._resources = ExitStack()  # clean-up, which `close` calls in reverse order
        prepare_rendering()

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    @classmethod
    def require_task(cls, task: str | None) -> None:
        known = cls.tasks()
        if task is not None and known:  # The constructor has a default task.
            require_known(cls.suite, task, known)

    @classmethod
    def not_installed(cls) -> str | None:
        return without(cls.packages, cls.cure)

    @classmethod
    def missing(cls) -> str | None:
        """Return the reason why the simulator cannot run here; None if it can run.

        The first call in a process renders one frame in a child process.
        """
        missing = cls.not_installed()
        if missing is not None:
            return missing
        try:
            cls._require_assets()
        except EnvFailed as error:
            return str(error)

        probe = egl_probe()
        if probe.ok:
            return None
        return f"{cls.title} cannot render without a display ({probe.error}); {probe.cure}"

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32.

        If the task has fixed initial states, the episode begins in the state
        `options["init_state"]`, or else in a state that the seed selects. There are no other
        options.
        """
        self._alive()
        options = options or {}
        has_states = self.init_states is not None
        unknown = sorted(set(options) - ({"init_state"} if has_states else set()))
        if unknown:
            allowed = "init_state or none" if has_states else "none"
            raise ConfigError(
                f"{self._name}: expected reset options of {allowed}, got {unknown}; leave these out"
            )

        count = self.init_states or 1
        state = options.get("init_state", seed % count)
        if type(state) is not int or not 0 <= state < count:
            raise ConfigError(
                f"{self._name}: init_state: expected a number from 0 to {count - 1}, got {state!r}"
            )

        with failing(self._name, "reset"):
            obs, begin_info = self._begin(seed % 2**32, state)
        self._steps = 0
        info: dict[str, Any] = {"success": False}
        if has_states:
            info["init_state"] = state
        return obs, info | begin_info

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute an action, (D,); see `EvalEnv.step`."""
        self._alive()
        if self._steps is None:
            raise NotReset(
                f"{self._name}: step was called before reset; call reset(seed=...) first"
            )

        action = one_row(act, self._contract)
        with failing(self._name, "step"):
            obs, reward, ended, info = self._advance(action)
        self._steps += 1
        return obs, reward, ended, self._steps >= self.max_steps, info

    def describe(self) -> dict[str, Any]:
        """Return the suite, the task, the versions, the render backend and the protocol."""
        facts: dict[str, Any] = {
            "simulator": self.suite,
            "task": self._name.partition("/")[2],
            **{name: version(name) for name in self.distributions},
            "render_backend": os.environ.get("MUJOCO_GL", "glfw"),
        }
        if self._protocol is not None:
            facts["protocol"] = self._protocol.describe(
                max_steps=self.max_steps, ends_on_success=self._ends_on_success
            )
        return facts

    def close(self) -> None:
        self._env, self._steps = None, None
        self._resources.close()

    @abstractmethod
    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: The seed, 0 to 2^32 - 1.
            state: The number of the initial state; 0 if the task has no fixed initial states.

        Returns:
            The first observation, and entries of `info`. `init_state` and `success` (False) are
            added if they are missing.
        """

    @abstractmethod
    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        """Execute an action.

        Args:
            action: (D,) float32.

        Returns:
            `(obs, reward, terminated, info)`, as in `EvalEnv.step`.
        """

    @classmethod
    def _require_assets(cls) -> None:
        """Raise `EnvFailed`, with the cure, if files of the simulator are missing."""

    def _solved(self, success: bool) -> tuple[bool, dict[str, Any]]:
        """Return `terminated` and `info` for a step, given whether the task is solved after the
        step.
        """
        return success and self._ends_on_success, {"success": success}

    def _alive(self) -> Any:
        """Return the simulator; raises `EnvFailed` after `close`."""
        if self._env is None:
            raise EnvFailed(f"{self._name} is closed; create a new environment")
        return self._env

    @contextmanager
    def _making(self) -> Iterator[None]:
        """Convert errors while the simulator is created within the context.

        An error is converted to `EnvFailed`, and resources that were already created are freed.
        """
        try:
            with failing(self._name, "make"):
                yield
        except BaseException:
            self.close()
            raise


class MujocoCameras:
    """Cameras of a MuJoCo model."""

    def __init__(
        self,
        env: str,
        model: Any,
        cameras: Sequence[str],
        size: Size,
        *,
        upside_down: Collection[str] = (),
        shadows: bool = True,
    ) -> None:
        """Create the renderer, and enlarge the model's frame buffer if necessary.

        Args:
            env: The name of the environment, for errors.
            model: A `mujoco.MjModel`.
            cameras: The names of the cameras to render.
            size: Height and width of the images, px.
            upside_down: The cameras whose images must be rotated by 180 degrees.
            shadows: Whether to render shadows, reflections and smooth edges. Without them,
                rendering an image in software takes a tenth of the time.

        Raises:
            ConfigError: The model has no such camera.
        """
        require_cameras(env, cameras, camera_names(model))
        self._cameras, self._upside_down = list(cameras), upside_down
        height, width = size
        buffer = model.vis.global_
        buffer.offheight = max(buffer.offheight, height)
        buffer.offwidth = max(buffer.offwidth, width)

        mujoco = require("mujoco")
        if not shadows:
            model.vis.quality.offsamples = 0
        self._renderer: Any = mujoco.Renderer(model, height, width)
        if not shadows:
            flags = self._renderer.scene.flags
            flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
            flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0

    def render(self, data: Any) -> dict[str, np.ndarray]:
        """Return the images of a `mujoco.MjData` by camera, (H, W, 3) uint8."""
        images = {}
        for camera in self._cameras:
            self._renderer.update_scene(data, camera=camera)
            image: np.ndarray = self._renderer.render()
            if camera in self._upside_down:
                image = np.ascontiguousarray(image[::-1, ::-1])
            images[camera] = image
        return images

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def require_sizes(env: str, **sizes: int | None) -> None:
    """Raise `ConfigError` unless each option is at least 1, or None."""
    for option, value in sizes.items():
        if value is not None and value < 1:
            raise ConfigError(f"{env}: {option}: expected a number of at least 1, got {value}")


def camera_names(model: Any) -> list[str]:
    """List the cameras of a `mujoco.MjModel`."""
    return [model.camera(i).name for i in range(model.ncam)]


def without(modules: Sequence[str], cure: str) -> str | None:
    """Return the first of these modules that is not installed, with the cure; None if all are
    installed.
    """
    missing = next((module for module in modules if importlib.util.find_spec(module) is None), None)
    return None if missing is None else f"{missing} is not installed; {cure}"


@contextmanager
def failing(env: str, doing: str) -> Iterator[None]:
    """Convert errors of a simulator within the context to `EnvFailed`.

    The message for driver errors contains a cure. Errors of this package are raised unchanged.

    Args:
        env: The name of the environment.
        doing: The action of the simulator within the context, as a verb.
    """
    try:
        yield
    except VLAgentsError:
        raise
    except Exception as error:
        cure = ""
        if any(word in str(error) for word in ("EGL", "OpenGL", "GLContext", "mjr_makeContext")):
            cure = f"; {EGL_CURE}"
        elif any(word in str(error) for word in ("vk::", "rendering device", "Vulkan")):
            cure = f"; {vulkan_cure()}"
        raise EnvFailed(
            f"{env} failed to {doing}: {type(error).__name__}: {error}{cure}"
        ) from error
