"""RCS, the Robot Control Stack, in MuJoCo, and DuoBench, a benchmark for two arms that uses it.

Both need a separate Python environment, which `vlagents-ray venv create rcs` creates: their
packages conflict with the simulators of this package's extras, and the licence of RCS is AGPL-3.
See docs/benchmarks/other.md.
"""

from __future__ import annotations

import copy
import importlib.util
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, Rotation, StateSpec
from vlagents_ray.envs.base import require_cameras, require_known
from vlagents_ray.envs.gymnasium import plain
from vlagents_ray.envs.simulator import BenchmarkProtocol, SimulatorEnv
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require

ControlMode = Literal["joints", "xyzrpy", "tquat"]


@dataclass(frozen=True, slots=True)
class RcsTask:
    """The settings that turn a scene registered by RCS with Gymnasium into a task."""

    id: str  # Gymnasium's id of the scene
    module: str | None  # the module that registers the scene; None selects the id's namespace
    protocol: BenchmarkProtocol | None = None  # step limit; None if the user has to set `max_steps`
    control_mode: ControlMode = "joints"  # the default control mode of actions
    control_hz: float = 30.0
    instruction: str = ""  # instruction that is used if the simulator's info has none
    # Adds the task to the config of a scene without a task; None if the scene has a task.
    add_task: Callable[[Any], None] | None = None


def _add_pick_task(config: Any) -> None:
    first_robot = next(iter(config.robot_cfgs))
    config.task_cfg = require("rcs.envs.tasks").PickTaskConfig(robot_name=first_robot)


RCS_TASKS = {
    "pick": RcsTask(
        id="rcs/fr3",
        module="rcs.envs.configs",
        protocol=BenchmarkProtocol(
            name="RCS pick",
            source="rcs-core 0.7.3, rcs/envs/tasks.py, for the task; it states neither rate nor "
            "step limit: ours",
            max_steps=300,
            control_hz=30.0,
            control="tquat",
            success="the cuboid's middle is 7.8 cm or more above the robot's base, and the gripper "
            "is neither open nor closed",
            metric="success_once",
            begins="the seed draws the cuboid's position in a square of 20 cm, 50 cm in front of "
            "the robot, and the cuboid's rotation",
            ends_on_success=True,
        ),
        control_mode="tquat",
        instruction="pick up the green cuboid",
        add_task=_add_pick_task,
    )
}

_DUOBENCH = BenchmarkProtocol(
    name="DuoBench",
    source="DuoBench 0.1.2, README, 'Evaluation Environment' (arXiv 2606.11901); it states no step "
    "limit: ours",
    max_steps=900,
    control_hz=30.0,
    control="joints",
    success="the task's last stage has been reached; stages are not lost again",
    metric="success_once",
    begins="the seed draws the positions of the objects",
    ends_on_success=True,
)
_DUOBENCH_NAMES = (
    "ball_maze",
    "bin_sort",
    "block_balance",
    "carry_pot",
    "hinge_chest",
    "join_blocks",
    "pour_marbles",
    "spring_door",
    "transfer_cube",
    "transfer_gate",
    "transfer_reorient",
)
DUOBENCH_TASKS = {
    name: RcsTask(id=f"duobench/{name}", module=f"duobench.tasks.{name}", protocol=_DUOBENCH)
    for name in _DUOBENCH_NAMES
}


# If this file is missing, `import rcs` and `import duobench` download all assets (rcs-core 0.7.3,
# rcs/__init__.py).
_REQUIRED = Path("assets/scenes/empty_world/scene.xml")


@dataclass(frozen=True, slots=True)
class _Assets:
    """The folder from which a package reads its assets."""

    variable: str  # the environment variable that names the folder
    home_folder: str  # the folder in the home folder that is used if the variable is not set
    further_steps: str = ""  # instruction for completing a download that `import` has begun


_ASSETS = {
    "rcs": _Assets("RCS_PREFIX", ".rcs"),
    "duobench": _Assets(
        "DUOBENCH_PREFIX",
        ".duobench",
        f", then make {_REQUIRED} there as an empty file: DuoBench 0.1.2 does not contain it, and "
        f"each import would download all assets again",
    ),
}


def missing_packages(*packages: str) -> str | None:
    """Return the reason why packages cannot be imported here without a download; None if they can.

    Args:
        packages: Names of packages, "rcs" or "duobench".

    Returns:
        A sentence with the cure, or None.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            return (
                f"{package} is not installed; make an environment, `vlagents-ray venv create rcs`, "
                "and have the workers run in it: runtime_env: {py_executable: "
                "/path/to/.venv-rcs/bin/python}"
            )
        assets = _ASSETS[package]
        default_folder = Path.home() / assets.home_folder
        prefix = Path(os.environ.get(assets.variable) or default_folder).expanduser()
        if not (prefix / _REQUIRED).is_file():
            return (
                f"{package}'s assets are not in {prefix}: {_REQUIRED} is missing; set "
                f"{assets.variable} to the folder that holds its `assets`, or fetch them once by "
                f"`python -c 'import {package}'`{assets.further_steps}"
            )
    return None


def scene_creator(task: RcsTask, name: str) -> Any:
    """Return RCS's factory of a scene, an `RCSEnvCreator`.

    Args:
        task: Defines the scene, and the module that registers it.
        name: The name of the environment, for errors.

    Raises:
        MissingDependency: RCS is not installed, or would download assets.
        UnknownEnv: Nothing registers the scene.
        ConfigError: The id is not a scene of RCS.
    """
    namespace = task.id.partition("/")[0]
    packages = ["rcs", "duobench"] if namespace == "duobench" else ["rcs"]
    reason = missing_packages(*packages)
    if reason is not None:
        raise MissingDependency(f"{name}: {reason}")

    require(task.module or namespace)
    rcs = require("rcs")
    # On import, DuoBench registers another scene under this name. Episodes must not depend on
    # whether it was imported.
    rcs.SCENE_PATHS["empty_world"] = str(Path(rcs.RCS_PREFIX) / _REQUIRED)

    gymnasium = require("gymnasium")
    if task.id not in gymnasium.registry:
        raise UnknownEnv(
            f"{name}: Gymnasium knows no {task.id!r}; set `module` to the module that registers it"
        )
    entry_point = gymnasium.registry[task.id].entry_point
    if not hasattr(entry_point, "create_env"):
        raise ConfigError(
            f"{name}: expected a scene of RCS, whose entry point is an RCSEnvCreator, got "
            f"{task.id!r}"
        )
    return entry_point


# The units of an arm's state. RCS's angles are roll, pitch and yaw about fixed axes, R = Rz Ry Rx,
# and the last component of its quaternions is w.
_UNITS = {"joints": "rad", "tquat": "m+quat_xyzw", "xyzrpy": "m+rad"}
# Control mode -> its name in RCS's `ControlMode`.
_MODES = {"joints": "JOINTS", "tquat": "CARTESIAN_TQuat", "xyzrpy": "CARTESIAN_TRPY"}
# Control mode -> the space and the rotation of an action in the contract.
_COMMANDS: dict[ControlMode, tuple[str, Rotation]] = {
    "joints": ("joint", "none"),
    "tquat": ("ee_pose", "quat_xyzw"),
    "xyzrpy": ("ee_pose", "euler_xyz"),
}


class Rcs(SimulatorEnv):
    """One environment of one task: "pick", or the id of any scene with a task registered by RCS.

    Observation: the scene's cameras; for each arm `joints`, rad, and `tquat` and `xyzrpy`, the
    tool's pose in the frame that all arms share; and the gripper, 1 = open. `Arms` describes the
    names for several arms. `info["objects"]` is for scripted experts only. It maps the joint of
    each loose body to the body's pose in the world frame, (7,) float64, m and quaternion wxyz.

    Action: for each arm, its command in `control_mode` and then its gripper, which closes at 0.5
    and below.

    The simulator reports success, which ends the episode. The seed determines the positions of the
    objects.
    """

    suite = "rcs"
    known: ClassVar[Mapping[str, RcsTask]] = RCS_TASKS
    packages: ClassVar[tuple[str, ...]] = ("rcs",)
    distributions: ClassVar[tuple[str, ...]] = ("rcs-core", "mujoco")

    def __init__(
        self,
        task: str | None = None,
        *,
        module: str | None = None,
        control_mode: ControlMode | None = None,
        delta: bool = False,
        control_hz: float | None = None,
        binary_gripper: bool = True,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
    ) -> None:
        """Make the environment; raises the errors of `make_env`. Other options are described in
        `SimulatorEnv`.

        Args:
            task: One of `tasks()`, or Gymnasium's id of a scene, such as "lab/shelf"; None selects
                the first of `tasks()`.
            module: The module that registers the scene, which is imported first; None selects the
                id's namespace.
            control_mode: "joints", "tquat" or "xyzrpy"; None selects the mode of the protocol.
            delta: Whether commands are relative to the arm's current position.
            control_hz: Steps per second; None selects the rate of the protocol.
            binary_gripper: Whether the gripper only opens or closes; if not, the command is its
                opening.
            cameras: The cameras of the scene to return; None selects all of them.
        """
        task = self.tasks()[0] if task is None else task
        if task not in self.known:
            self.require_task(task)
        self._task = self.known.get(task) or RcsTask(id=task, module=None)
        if module is not None:
            self._task = replace(self._task, module=module)

        protocol = self._task.protocol
        if max_steps is None and protocol is not None:
            max_steps = protocol.max_steps
        if max_steps is None:
            raise ConfigError(f"{self.suite}/{task} has no step limit of its own; set max_steps")
        super().__init__(task, width=width, height=height, max_steps=max_steps)
        self.max_steps = max_steps
        self._mode = control_mode or self._task.control_mode
        self._user_instruction = instruction
        control_hz = control_hz or self._task.control_hz

        creator = scene_creator(self._task, self._name)
        config = creator.config()
        if self._task.add_task is not None:
            self._task.add_task(config)
        rcs_base = require("rcs.envs.base")
        config.control_mode = getattr(rcs_base.ControlMode, _MODES[self._mode])
        config.relative_to = getattr(rcs_base.RelativeTo, "LAST_STEP" if delta else "NONE")
        config.wrapper_cfg.binary_gripper = binary_gripper
        # RCS would limit relative commands to 0.5 m, 90 degrees, and 5 degrees for each joint.
        config.max_relative_movement = None
        # Simulate without a window, and as fast as possible.
        config.headless = True
        config.sim_cfg.realtime = False
        config.sim_cfg.frequency = control_hz
        # A step lasts 1 / control_hz, whether or not the arms have reached their targets.
        config.sim_cfg.async_control = True
        self._select_cameras(config, cameras, height, width)

        with self._making():
            self._env = creator.create_env(config)
            self._resources.callback(self._env.close)
            self._sim = self._env.get_wrapper_attr("sim")
            self._loose = _free_joints(self._sim.model)
            self._arms = Arms(self._env.action_space, self._env.observation_space, self._mode)

        self._contract = Contract(
            cameras=dict.fromkeys(config.camera_cfgs or (), CameraSpec(height, width)),
            state=self._arms.state,
            gripper=self._arms.has_gripper,
            instruction=True,
            action=self._arms.action_spec(delta=delta),
            control_hz=control_hz,
        )

    def _select_cameras(
        self, config: Any, cameras: Sequence[str] | None, height: int, width: int
    ) -> None:
        """Leave only these cameras in the config of a scene (all if None), with images of this
        size.

        The configs of the cameras are copied, so that the scene's own configs keep their size.
        """
        scene_cameras = config.camera_cfgs or {}
        require_cameras(self._name, cameras or (), scene_cameras)
        selected = {}
        for name in scene_cameras if cameras is None else cameras:
            camera = copy.copy(scene_cameras[name])
            camera.resolution_height, camera.resolution_width = height, width
            selected[name] = camera

        config.camera_cfgs = selected or None
        if config.camera_adds is not None:
            config.camera_adds = {
                name: camera for name, camera in config.camera_adds.items() if name in selected
            }

    @property
    def instruction(self) -> str:
        return self._user_instruction or self._instruction or self._task.instruction

    @classmethod
    def require_task(cls, task: str | None) -> None:
        if "/" not in (task or ""):
            require_known(cls.suite, task, cls.tasks(), ", or an id, as in 'lab/shelf'")

    @classmethod
    def not_installed(cls) -> str | None:
        return missing_packages(*cls.packages)

    def describe(self) -> dict[str, Any]:
        control = f"{self._mode}, delta" if self._contract.action.delta else self._mode
        settings = {
            "max_steps": self.max_steps,
            "control_hz": self._contract.control_hz,
            "control": control,
        }
        protocol = self._task.protocol
        robots = self._alive().get_wrapper_attr("robot")
        return super().describe() | {
            "simulator": "rcs",
            "task": self._task.id,
            "robots": {name: robot.get_config().robot_type.id for name, robot in robots.items()},
            "protocol": settings if protocol is None else protocol.describe(**settings),
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        raw, info = self._env.reset(seed=seed)
        self._instruction = str(info.get("instruction", ""))
        if not self.instruction:
            raise ConfigError(f"{self._name} has no instruction; set the option `instruction`")
        # A task need not report success before its first step; each step must.
        outcome = {"success": bool(info["success"])} if "success" in info else {}
        return self._observe(raw), outcome

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        raw, reward, terminated, _, info = self._env.step(self._arms.command(action))
        if "success" not in info:
            raise ConfigError(
                f"expected a task that reports success, got none from {self._name}: "
                "name a scene that has a task"
            )
        # The entries of arms are keyed by the names of the arms; the other entries belong to the
        # task.
        task_info = {key: value for key, value in info.items() if key not in self._arms.names}
        outcome = {**plain(task_info), "success": bool(info["success"])}
        return self._observe(raw), float(reward), bool(terminated), outcome

    def _observe(self, raw: Mapping[str, Any]) -> Obs:
        """Convert an observation of RCS."""
        state, gripper = self._arms.read(raw)
        cameras = {}
        for name, frame in raw.get("frames", {}).items():
            cameras[name] = np.ascontiguousarray(frame["rgb"]["data"])
        objects = {joint: np.array(self._sim.data.joint(joint).qpos) for joint in self._loose}
        return Obs(cameras=cameras, gripper=gripper, state=state, info={"objects": objects})


def _free_joints(model: Any) -> list[str]:
    """List the free joints of a `mujoco.MjModel`, which are the joints of its loose bodies."""
    free_type = int(require("mujoco").mjtJoint.mjJNT_FREE)
    return [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] == free_type]


class DuoBench(Rcs):
    """DuoBench's eleven tasks of two FR3 arms, "left" and "right", whose names omit "duobench/".

    Action: (16,). The first eight values are the left arm's seven joints, rad, and its gripper, and
    the last eight are those of the right arm. The reward is the fraction of the task's stages that
    have been reached. The info of a step contains `stage` and `max_stage`.
    """

    suite = "duobench"
    known: ClassVar[Mapping[str, RcsTask]] = DUOBENCH_TASKS
    packages, distributions = ("rcs", "duobench"), ("rcs-core", "duobench", "mujoco")


class Arms:
    """Translates between RCS's dicts, keyed by robot, and the observations and actions of policies.

    The state of a single arm has plain names, such as `joints`. With several arms, each name begins
    with the name of the arm, as in `left/joints`, and the state also contains the gripper, (1,). An
    action contains the command and then the gripper, 1 = open, of one arm after the other.
    """

    def __init__(
        self, actions: Mapping[str, Any], observations: Mapping[str, Any], mode: ControlMode
    ) -> None:
        """Read RCS's spaces.

        Args:
            actions: Robot -> name of a command -> Box (D,).
            observations: Robot -> name of a reading -> Box (D,).
            mode: The control mode of the actions.
        """
        self.names = tuple(actions)
        self.single = len(self.names) == 1
        self._mode = mode
        self._sizes = {name: int(actions[name][mode].shape[0]) for name in self.names}
        self._grippers = {name for name in self.names if "gripper" in actions[name].spaces}

        self.state = {}
        for name in self.names:
            for reading, unit in _UNITS.items():
                dim = int(observations[name][reading].shape[0])
                self.state[self._key(name, reading)] = StateSpec(dim, unit)
        if not self.single:
            for name in self.names:
                if name in self._grippers:
                    self.state[self._key(name, "gripper")] = StateSpec(1)
        # Whether `Obs.gripper` can contain the gripper.
        self.has_gripper = self.single and bool(self._grippers)

    def action_spec(self, *, delta: bool) -> ActionSpec:
        """Return the contract's description of an action; if `delta`, it is relative to the arm's
        pose.
        """
        space, rotation = _COMMANDS[self._mode]
        return ActionSpec(
            dim=sum(self._sizes.values()) + len(self._grippers),
            space=space,
            delta=delta,
            rotation=rotation,
            frame=None if self._mode == "joints" else "base",
            gripper_open=1.0 if self._grippers else None,
            gripper_closed=0.0 if self._grippers else None,
            arms=None if self.single else self.names,
        )

    def command(self, action: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        """Convert an action, (D,), to RCS's commands: robot -> name of a command -> values."""
        commands: dict[str, dict[str, np.ndarray]] = {}
        remaining = action.astype(np.float64)
        for name in self.names:
            target, remaining = np.split(remaining, [self._sizes[name]])
            commands[name] = {self._mode: target}
            if name in self._grippers:
                commands[name]["gripper"], remaining = np.split(remaining, [1])
        return commands

    def read(self, observation: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], float | None]:
        """Convert an observation of RCS.

        Args:
            observation: Robot -> name of a reading -> values.

        Returns:
            The state, whose values are (D,) float32, and the gripper of a single arm in [0, 1], 1 =
            open. The gripper is None if there are several arms, or if the arm has no gripper.
        """
        state = {}
        for name in self.names:
            for reading in _UNITS:
                values = np.array(observation[name][reading], dtype=np.float32)
                state[self._key(name, reading)] = values

        openings = {}
        for name in self._grippers:
            opening = np.array(observation[name]["gripper"], np.float32)
            openings[name] = np.clip(opening, 0, 1)

        if self.single:
            return state, float(openings[self.names[0]][0]) if openings else None
        for name, opening in openings.items():
            state[self._key(name, "gripper")] = opening
        return state, None

    def _key(self, name: str, reading: str) -> str:
        """Return the name of an arm's reading in the state."""
        return reading if self.single else f"{name}/{reading}"
