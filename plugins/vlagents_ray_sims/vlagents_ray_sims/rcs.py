"""RCS, the Robot Control Stack, in MuJoCo, and DuoBench, the benchmark for two arms that is built
on it.

Both need a separate Python environment, `vlagents-ray env make rcs`: their packages conflict with
the simulators of this package's extras, and RCS is AGPL-3. See docs/benchmarks/other.md.
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
    module: str | None  # the module that registers it; None if the user names it
    protocol: BenchmarkProtocol | None = None  # None: the user sets `max_steps`
    control_mode: ControlMode = "joints"  # of an action; absolute by default
    control_hz: float = 30.0
    instruction: str = ""  # used if the simulator's info has none
    prepare: Callable[[Any], None] = lambda _config: None  # adds the task to a scene without one


def _pick(config: Any) -> None:
    config.task_cfg = require("rcs.envs.tasks").PickTaskConfig(
        robot_name=next(iter(config.robot_cfgs))
    )


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
            "is neither open "
            "nor closed",
            metric="success_once",
            begins="the cuboid's place in a square of 20 cm, 50 cm in front of the robot, and its "
            "turn: the seed's",
            ends_on_success=True,
        ),
        control_mode="tquat",
        instruction="pick up the green cuboid",
        prepare=_pick,
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
    begins="where the objects are: the seed's",
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


# Without this file, `import rcs` and `import duobench` download all assets (rcs-core 0.7.3,
# rcs/__init__.py).
_REQUIRED = Path("assets/scenes/empty_world/scene.xml")


# By package: the environment variable that names the folder of its assets, the folder in the home
# folder that counts if it is not set, and further steps of the download beside `import`.
_ASSETS = {
    "rcs": ("RCS_PREFIX", ".rcs", ""),
    "duobench": (
        "DUOBENCH_PREFIX",
        ".duobench",
        (
            f", then make {_REQUIRED} there, empty: DuoBench 0.1.2 has none, and each import would "
            "fetch all again"
        ),
    ),
}


def missing_packages(*packages: str) -> str | None:
    """Return why the packages, "rcs" or "duobench", cannot be imported here without a download;
    None if they can.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            return (
                f"{package} is not installed; make an environment, `vlagents-ray env make rcs`, "
                "and have the workers run in it: runtime_env: {py_executable: "
                "/path/to/.venv-rcs/bin/python}"
            )
        variable, folder, further = _ASSETS[package]
        prefix = Path(os.environ.get(variable) or Path.home() / folder).expanduser()
        if not (prefix / _REQUIRED).is_file():
            return (
                f"{package}'s assets are not in {prefix}: there is no {_REQUIRED}; set {variable} "
                "to the folder that holds its `assets`, or fetch them once by `python -c 'import "
                f"{package}'`{further}"
            )
    return None


def creator(task: RcsTask, name: str) -> Any:
    """Return RCS's factory of a scene; raises `MissingDependency` if RCS would download."""
    reason = missing_packages("rcs", *({"duobench"} & {task.id.partition("/")[0]}))
    if reason is not None:
        raise MissingDependency(f"{name}: {reason}")
    require(task.module or task.id.partition("/")[0])
    rcs = require("rcs")
    # DuoBench registers another scene under this name on import, and episodes must not depend on
    # that
    rcs.SCENE_PATHS["empty_world"] = str(Path(rcs.RCS_PREFIX) / _REQUIRED)
    gymnasium = require("gymnasium")
    if task.id not in gymnasium.registry:
        raise UnknownEnv(
            f"{name}: Gymnasium knows no {task.id!r}; set `module` to what registers it"
        )
    made = gymnasium.registry[task.id].entry_point
    if not hasattr(made, "create_env"):
        raise ConfigError(
            f"{name}: {task.id!r} is no scene of RCS: want one whose entry point is an "
            "RCSEnvCreator"
        )
    return made


# RCS's angles are roll, pitch, yaw about fixed axes, R = Rz Ry Rx; its quaternions end with w.
_UNITS = {"joints": "rad", "tquat": "m+quat_xyzw", "xyzrpy": "m+rad"}
_MODES = {"joints": "JOINTS", "tquat": "CARTESIAN_TQuat", "xyzrpy": "CARTESIAN_TRPY"}
_COMMANDS: dict[ControlMode, tuple[str, Rotation]] = {
    "joints": ("joint", "none"),
    "tquat": ("ee_pose", "quat_xyzw"),
    "xyzrpy": ("ee_pose", "euler_xyz"),
}


class Rcs(SimulatorEnv):
    """One environment of one task: "pick", or the id of any scene with a task that RCS has
    registered.

    Observation: the scene's cameras; for each arm `joints` rad, `tquat` and `xyzrpy`, the tool's
    pose in the frame that all arms share; the gripper, 1 = open. `Arms` describes the names for
    several arms. `info["objects"]` is {joint: (7,) float64}, the pose of each loose body in the
    world frame, metres and quaternion wxyz: for scripted experts only.

    Action: for each arm its command in `control_mode`, then its gripper, which closes at 0.5 and
    below.

    The simulator reports success, which ends the episode. The seed places the objects.
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
            task: One of `tasks()`, or Gymnasium's id of a scene, "lab/shelf"; None is the first of
                `tasks()`.
            module: The module that registers the id, imported first; by default the id's namespace.
            control_mode: "joints", "tquat" or "xyzrpy"; None selects the protocol's.
            delta: Whether commands are relative to the arm's current position.
            control_hz: Steps per second; None selects the protocol's.
            binary_gripper: Whether the gripper only opens or closes; if not, the command is its
                opening.
            cameras: Cameras of the scene to return; None selects all.
        """
        task = self.tasks()[0] if task is None else task
        if task not in self.known:
            self.require_task(task)
        found = self.known.get(task) or RcsTask(id=task, module=None)
        self._task = found if module is None else replace(found, module=module)
        protocol = self._task.protocol
        limit = protocol.max_steps if max_steps is None and protocol is not None else max_steps
        if limit is None:
            raise ConfigError(f"{self.suite}/{task} has no step limit of its own; set max_steps")
        super().__init__(task, width=width, height=height, max_steps=limit)
        self.max_steps = limit
        self._mode = control_mode or self._task.control_mode
        self._given_instruction = instruction
        hz = control_hz or self._task.control_hz
        maker = creator(self._task, self._name)
        config = maker.config()
        self._task.prepare(config)
        config.sim_cfg.frequency = hz
        config.relative_to = getattr(
            require("rcs.envs.base").RelativeTo, "LAST_STEP" if delta else "NONE"
        )
        config.wrapper_cfg.binary_gripper = binary_gripper
        # Without a window, as fast as it can, with images of this size.
        config.headless = True
        config.sim_cfg.realtime = False
        # A step takes its time, whether or not the arms have reached their targets.
        config.sim_cfg.async_control = True
        config.control_mode = getattr(require("rcs.envs.base").ControlMode, _MODES[self._mode])
        # RCS's default: none for absolute; 0.5 m, 90 degrees, 5 degrees a joint.
        config.max_relative_movement = None
        have = config.camera_cfgs or {}
        require_cameras(self._name, cameras or (), have)
        chosen = {name: copy.copy(have[name]) for name in (have if cameras is None else cameras)}
        for camera in chosen.values():
            camera.resolution_height, camera.resolution_width = height, width
        config.camera_cfgs = chosen or None
        if config.camera_adds is not None:
            config.camera_adds = {
                name: added for name, added in config.camera_adds.items() if name in chosen
            }
        with self._making():
            self._env = maker.create_env(config)
            self._resources.callback(self._env.close)
            self._sim = self._env.get_wrapper_attr("sim")
            model, free = self._sim.model, int(require("mujoco").mjtJoint.mjJNT_FREE)
            self._loose = [
                model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] == free
            ]
            self._arms = Arms(self._env.action_space, self._env.observation_space, self._mode)
        self._contract = Contract(
            cameras=dict.fromkeys(config.camera_cfgs or (), CameraSpec(height, width)),
            state=self._arms.state,
            gripper=self._arms.has_gripper,
            instruction=True,
            action=self._arms.action_spec(delta=delta),
            control_hz=hz,
        )

    @property
    def instruction(self) -> str:
        return self._given_instruction or self._instruction or self._task.instruction

    @classmethod
    def require_task(cls, task: str | None) -> None:
        if "/" not in (task or ""):
            require_known(cls.suite, task, cls.tasks(), ", or an id, as in 'lab/shelf'")

    @classmethod
    def missing(cls) -> str | None:
        return missing_packages(*cls.packages)

    def describe(self) -> dict[str, Any]:
        control = f"{self._mode}, delta" if self._contract.action.delta else self._mode
        played = {
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
            "protocol": protocol.describe(**played) if protocol is not None else played,
        }

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        raw, info = self._env.reset(seed=seed)
        self._instruction = str(info.get("instruction", ""))
        if not self.instruction:
            raise ConfigError(f"{self._name} states no instruction; set the option `instruction`")
        return self._observe(raw), {"success": bool(info.get("success", False))}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        raw, reward, terminated, _, info = self._env.step(self._arms.command(action))
        if "success" not in info:
            raise ConfigError(
                f"{self._name} does not say what success is: want a scene with a task"
            )
        # Drops entries of arms.
        task_info = {key: value for key, value in info.items() if key not in self._arms.names}
        outcome = {**plain(task_info), "success": bool(info["success"])}
        return self._observe(raw), float(reward), bool(terminated), outcome

    def _observe(self, raw: Mapping[str, Any]) -> Obs:
        state, gripper = self._arms.read(raw)
        frames = raw.get("frames", {})
        return Obs(
            cameras={
                name: np.ascontiguousarray(frame["rgb"]["data"]) for name, frame in frames.items()
            },
            gripper=gripper,
            state=state,
            info={
                "objects": {name: np.array(self._sim.data.joint(name).qpos) for name in self._loose}
            },
        )


class DuoBench(Rcs):
    """DuoBench's eleven tasks of two FR3 arms, "left" and "right", named without "duobench/".

    An action has 16 numbers: the left arm's seven joints, rad, and its gripper, then those of the
    right arm. The reward is the share of the task's stages reached; a step's info has `stage` and
    `max_stage`.
    """

    suite = "duobench"
    known: ClassVar[Mapping[str, RcsTask]] = DUOBENCH_TASKS
    packages, distributions = ("rcs", "duobench"), ("rcs-core", "duobench", "mujoco")


class Arms:
    """Translates between RCS's dicts, keyed by robot, and the observations and actions of policies.

    The parts of a single arm's state have plain names, `joints`. With several arms, names begin
    with that of the arm, `left/joints`, and the gripper is also a part of the state, (1,). A row of
    the action has the command and then the gripper, 1 = open, of each arm in turn.
    """

    def __init__(
        self, actions: Mapping[str, Any], observations: Mapping[str, Any], mode: ControlMode
    ) -> None:
        """Read RCS's spaces: `actions` and `observations` map robot -> part -> Box (D,)."""
        self.names = tuple(actions)
        self.single = len(self.names) == 1
        self._mode = mode
        self._sizes = {name: int(actions[name][mode].shape[0]) for name in self.names}
        self._grippers = {name for name in self.names if "gripper" in actions[name].spaces}
        self.state = {
            self._key(name, part): StateSpec(int(observations[name][part].shape[0]), unit)
            for name in self.names
            for part, unit in _UNITS.items()
        }
        if not self.single:
            self.state |= {
                self._key(name, "gripper"): StateSpec(1)
                for name in self.names
                if name in self._grippers
            }
        # Whether `Obs.gripper` can report it.
        self.has_gripper = self.single and bool(self._grippers)

    def action_spec(self, *, delta: bool) -> ActionSpec:
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

    def command(self, row: np.ndarray) -> dict[str, dict[str, np.ndarray]]:
        commands: dict[str, dict[str, np.ndarray]] = {}
        rest = row.astype(np.float64)
        for name in self.names:
            pose, rest = np.split(rest, [self._sizes[name]])
            commands[name] = {self._mode: pose}
            if name in self._grippers:
                commands[name]["gripper"], rest = np.split(rest, [1])
        return commands

    def read(self, observation: Mapping[str, Any]) -> tuple[dict[str, np.ndarray], float | None]:
        """Return the state, each part (D,) float32, and a single arm's gripper in [0, 1], 1 =
        open.
        """
        state = {
            self._key(name, part): np.array(observation[name][part], dtype=np.float32)
            for name in self.names
            for part in _UNITS
        }
        openings = {
            name: np.clip(np.array(observation[name]["gripper"], np.float32), 0, 1)
            for name in self._grippers
        }
        if self.single:
            return state, float(openings[self.names[0]][0]) if openings else None
        return state | {
            self._key(name, "gripper"): opening for name, opening in openings.items()
        }, None

    def _key(self, name: str, part: str) -> str:
        return part if self.single else f"{name}/{part}"
