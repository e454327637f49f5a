"""robosuite's tasks of the robomimic study: Panda arms at a table in MuJoCo."""

from __future__ import annotations

import functools
import logging
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import DELTA_POSE
from vlagents_ray.envs.graphics import EGL_CURE, EGL_DEVICE, GPUS
from vlagents_ray.envs.simulator import BenchmarkProtocol, SimulatorEnv
from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.interface import Obs
from vlagents_ray.ray_tools.session import variables
from vlagents_ray.registry import require

_OPEN_M = 0.04  # travel of a finger from closed to open


class RobosuiteEnv(SimulatorEnv):
    """One environment of robosuite; a subclass makes the simulator and passes it to `_use`.

    `info["sim_state"]` is for scripted experts only. It contains the positions, m, and the
    quaternions xyzw of objects.
    """

    # robosuite's names by the names in the contract's state, where the names differ.
    _raw: Mapping[str, str] = {}

    def _use(self, simulator: Any) -> None:
        """Step this simulator, and close it together with the environment."""
        self._env, self._renderer = simulator, CameraRenderer(simulator)
        self._resources.callback(simulator.close)
        self._resources.callback(self._renderer.make_current)

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        with seeded(seed):
            # The components of robosuite 1.5 share a generator of the simulator.
            if hasattr(self._env, "rng"):
                seeded_generator = np.random.default_rng(seed)
                self._env.rng.bit_generator.state = seeded_generator.bit_generator.state
            # A reset frees the rendering resources of the previous episode, in the current context.
            self._renderer.make_current()
            self._renderer.open = True
            raw = self._env.reset()
        return self._observe(raw), {}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        """Execute an action; the reward is 1 if the task is solved, else 0."""
        self._renderer.open = self.looked_at
        raw, *_ = self._env.step(self._command(action.astype(np.float64)))
        success = bool(self._env._check_success())
        return self._observe(raw, look=self.looked_at), float(success), *self._solved(success)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"control_mode": "OSC_POSE"}

    def _command(self, action: np.ndarray) -> np.ndarray:
        """Convert an action of a policy, (D,) float64, to an action of the simulator."""
        return action

    def _sim_state(self, raw: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return the positions and quaternions of objects in an observation of robosuite."""
        poses = {}
        for name, value in raw.items():
            is_pose = name.endswith(("_pos", "_quat"))
            # Names with "to" are relative poses, for example of the cube to the hand.
            is_object = not {"robot0", "robot1", "to"} & set(name.split("_"))
            if is_pose and is_object:
                poses[name] = np.asarray(value, np.float64)
        return poses

    def _observe(self, raw: Mapping[str, Any], *, look: bool = True) -> Obs:
        """Convert an observation of robosuite; without `look` it has no images."""
        contract = self.contract
        cameras = list(contract.cameras or {}) if look else []
        state = {}
        for name in contract.state or {}:
            raw_name = self._raw.get(name, name)
            state[name] = np.asarray(raw[raw_name], np.float32)
        return Obs(
            # OpenGL's first row is the lowest one.
            cameras={name: np.ascontiguousarray(raw[f"{name}_image"][::-1]) for name in cameras},
            gripper=gripper_opening(raw) if contract.gripper else None,
            state=state,
            info={"sim_state": self._sim_state(raw)},
        )


def gripper_opening(raw: Mapping[str, Any]) -> float:
    """Return the opening of the Panda's gripper in robosuite's observation, 0 closed to 1 open."""
    return min(max(float(raw["robot0_gripper_qpos"][0]) / _OPEN_M, 0.0), 1.0)


class CameraRenderer:
    """Renders the cameras while `open` is set; otherwise they return black images and cost nothing.

    robosuite renders each camera for every observation: 14 times between the beginning of a reset
    and the policy's first observation. In a step it samples the observation, including the images,
    after the first 2 of 50 ms.
    """

    def __init__(self, domain: Any) -> None:
        """Replace the sensors that `domain`, an environment of robosuite, creates for cameras."""
        self.open = True
        self._domain = domain
        self._create_sensors = domain._create_camera_sensors
        # robosuite calls this function again in each reset.
        domain._create_camera_sensors = self._sensors

    def make_current(self) -> None:
        """Activate this simulator's OpenGL context; the process may have other contexts."""
        sim = self._domain.sim
        # There is no context after a failed reset.
        if sim is not None and sim._render_context_offscreen is not None:
            sim._render_context_offscreen.gl_ctx.make_current()

    def _sensors(
        self, cam_name: str, cam_w: int, cam_h: int, **options: Any
    ) -> tuple[list[Any], list[str]]:
        """Create the sensor of a camera as robosuite does, and let it render only while `open` is
        set.
        """
        [sensor], names = self._create_sensors(cam_name, cam_w=cam_w, cam_h=cam_h, **options)

        @functools.wraps(sensor)  # keeps robosuite's attributes
        def render_if_open(cache: Any) -> Any:
            if not self.open:
                return np.zeros((cam_h, cam_w, 3), np.uint8)
            self.make_current()
            return sensor(cache)

        return [render_if_open], names


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed numpy's global generator in the block, and restore its state afterwards.

    robosuite 1.4 and LIBERO draw from that generator.
    """
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


@contextmanager
def importing_robosuite(env: str) -> Iterator[None]:
    """Guard the first import of robosuite: select the EGL device, and suppress its log and advice.

    When it is imported, robosuite reads the number of the EGL device as a CUDA number, and rejects
    numbers that CUDA_VISIBLE_DEVICES does not list. While it is imported, CUDA_VISIBLE_DEVICES
    therefore contains the number of the chosen EGL device. Without a chosen EGL device, robosuite
    renders on the device with the CUDA number, and fails if CUDA_VISIBLE_DEVICES is empty. The
    worker finds out later which device was used.

    robosuite's log file is suppressed because its path is the same for all users of the machine.

    Args:
        env: The name of the environment, for errors.

    Raises:
        EnvFailed: No EGL device renders in software, and the process has no GPU.
    """
    egl_device, visible_gpus = os.environ.get(EGL_DEVICE), os.environ.get(GPUS)
    if visible_gpus == "" and egl_device is None and os.environ.get("MUJOCO_GL") == "egl":
        raise EnvFailed(
            f"{env} finds no EGL device that renders in software, and has no GPU; {EGL_CURE}"
        )
    replaced: dict[str, str] = {}
    if egl_device is not None and visible_gpus:
        replaced[GPUS] = egl_device

    log = logging.getLogger("robosuite_logs")
    file_handler, level = logging.FileHandler, log.level
    logging.FileHandler = _no_log_file  # type: ignore[assignment,misc]
    log.setLevel(logging.ERROR)
    try:
        with variables(replaced):
            yield
    finally:
        logging.FileHandler = file_handler  # type: ignore[misc]
        log.setLevel(level)


def _no_log_file(_path: str) -> logging.Handler:
    return logging.NullHandler()


CONTROL_HZ = 20.0


@dataclass(frozen=True, slots=True)
class RobosuiteTask:
    """A task of robosuite, with robomimic's observations and step limit."""

    instruction: str
    max_steps: int = 400  # robomimic's horizon for demonstrations of proficient humans, in steps
    cameras: tuple[str, ...] = ("agentview", "robot0_eye_in_hand")
    size: int = 84  # px, of each image
    arms: tuple[str, ...] = ("robot0",)

    @property
    def protocol(self) -> BenchmarkProtocol:
        """The settings of the robomimic study for this task."""
        return BenchmarkProtocol(
            name="robomimic",
            source="Mandlekar et al. 2021, arXiv 2108.03298; robomimic 0.3.0, dataset registry and "
            "base_config.py",
            max_steps=self.max_steps,
            control_hz=CONTROL_HZ,
            control="pose of the hand, delta, by OSC_POSE: 0.05 m and 0.5 rad a unit",
            success="robosuite's own check of the task holds after a step",
            metric="success_once",
            begins="the seed draws the positions of the objects, and noise on the arm's joints",
            ends_on_success=True,
            episodes=50,
        )


TASKS: Mapping[str, RobosuiteTask] = {
    "Lift": RobosuiteTask("lift the red cube"),
    "PickPlaceCan": RobosuiteTask("pick up the can and place it in its bin"),
    "NutAssemblySquare": RobosuiteTask("put the square nut onto the square peg"),
    "ToolHang": RobosuiteTask(
        "assemble the frame and hang the tool on it",
        700,
        ("sideview", "robot0_eye_in_hand"),
        size=240,
    ),
    "TwoArmTransport": RobosuiteTask(
        "move the hammer from its bin into the other one, and the trash out of that",
        700,
        ("shouldercamera0", "shouldercamera1", "robot0_eye_in_hand", "robot1_eye_in_hand"),
        arms=("robot0", "robot1"),
    ),
}


class Robosuite(RobosuiteEnv):
    """One environment of one of robosuite's tasks, e.g. "Lift".

    Observation: the cameras have robosuite's names, and their images are upright. `state` has
    robomimic's names. For each arm it contains:

    - `robot0_eef_pos` (3,) m and `robot0_eef_quat` (4,) xyzw: the hand's pose in the world frame.
    - `robot0_gripper_qpos` (2,) m: the positions of the fingers.
    - `robot0_joint_pos` (7,) rad.

    `info["sim_state"]` is for scripted experts only. It contains the positions, m, and quaternions
    xyzw of objects, and `target_pos`, the position to which an object is to be moved.

    Action: (7,) in [-1, 1] for each arm. The hand's target moves by 0.05 m per unit along the
    base's axes, and turns by 0.5 rad per unit about them (axis-angle). The last value is the
    gripper: -1 opens it, 1 closes it, and only the sign has an effect.
    """

    suite = title = "robosuite"
    known = tuple(TASKS)
    packages, distributions = ("robosuite", "mujoco"), ("robosuite", "mujoco")
    cure = "run `vlagents-ray venv create robosuite` and give the evaluation's workers that Python"

    def __init__(
        self,
        task: str = "Lift",
        *,
        width: int | None = None,
        height: int | None = None,
        cameras: Sequence[str] | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
        ends_on_success: bool = True,
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are described in
        `SimulatorEnv`.

        Args:
            task: robosuite's name of the task, one of `tasks()`.
            cameras: MuJoCo's names of the cameras; None selects robomimic's cameras for the task.
        """
        super().__init__(task, width=width, height=height, max_steps=max_steps)
        self._task = TASKS[task]
        self._protocol, self._ends_on_success = self._task.protocol, ends_on_success
        self.max_steps = max_steps or self._task.protocol.max_steps
        self._contract = self.known_contract(
            {"task": task, "width": width, "height": height, "cameras": cameras}
        )
        self._instruction = instruction or self._task.instruction

        with importing_robosuite("robosuite"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Suppress warnings of upstream code.
            simulator = require("robosuite")
        if task not in simulator.ALL_ENVIRONMENTS:
            raise ConfigError(
                f"{self._name}: robosuite {simulator.__version__} has no such task, but 1.5 has; "
                f"{self.cure}"
            )

        images = self._contract.cameras or {}
        with self._making(), seeded(0):
            env = simulator.make(
                task,
                robots=["Panda"] * len(self._task.arms),
                controller_configs=_controllers(simulator),
                control_freq=CONTROL_HZ,
                ignore_done=True,
                has_renderer=False,
                has_offscreen_renderer=bool(images),
                # After a reset, robosuite 1.5 leaves the renderer to garbage collection.
                renderer="mujoco",
                use_camera_obs=bool(images),
                camera_names=list(images) or "agentview",
                camera_heights=[spec.height for spec in images.values()] or 1,
                camera_widths=[spec.width for spec in images.values()] or 1,
            )
            # robosuite omits the joints, which are part of robomimic's observations.
            for arm in self._task.arms:
                env.modify_observable(f"{arm}_joint_pos", "active", modifier=True)
            self._use(env)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        """Return the contract; names and units of the state are those of robomimic's data."""
        task = TASKS[arguments["task"]]
        cameras = task.cameras if arguments["cameras"] is None else arguments["cameras"]
        image = CameraSpec(arguments["height"] or task.size, arguments["width"] or task.size)

        state = {}
        for arm in task.arms:
            state[f"{arm}_eef_pos"] = StateSpec(3, "m")
            state[f"{arm}_eef_quat"] = StateSpec(4, "quat_xyzw")
            state[f"{arm}_gripper_qpos"] = StateSpec(2, "m")
            state[f"{arm}_joint_pos"] = StateSpec(7, "rad")

        one_arm = len(task.arms) == 1
        return Contract(
            cameras=dict.fromkeys(cameras, image),
            state=state,
            gripper=one_arm,
            instruction=True,
            action=replace(DELTA_POSE, dim=7 * len(task.arms), arms=None if one_arm else task.arms),
            control_hz=CONTROL_HZ,
        )

    def _sim_state(self, raw: Mapping[str, Any]) -> dict[str, np.ndarray]:
        env, poses = self._env, super()._sim_state(raw)
        if hasattr(env, "target_bin_placements"):
            poses["target_pos"] = np.array(env.target_bin_placements[env.object_id], np.float64)
        elif hasattr(env, "peg1_body_id"):
            poses["target_pos"] = np.array(env.sim.data.body_xpos[env.peg1_body_id], np.float64)
        return poses


def _controllers(simulator: Any) -> Any:
    """Return robosuite's own settings of its controller OSC_POSE, which robomimic also uses."""
    if hasattr(simulator, "load_composite_controller_config"):  # 1.5
        return simulator.load_composite_controller_config(robot="Panda")
    return simulator.load_controller_config(default_controller="OSC_POSE")
