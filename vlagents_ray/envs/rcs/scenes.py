"""The tasks of RCS and DuoBench with their protocols; their scenes, which are found without ever downloading."""

from __future__ import annotations

import copy
import importlib.util
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from vlagents_ray.envs.simulator import BenchmarkProtocol, Size, require_cameras
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv
from vlagents_ray.registry import require

ControlMode = Literal["joints", "xyzrpy", "tquat"]


@dataclass(frozen=True, slots=True)
class RcsTask:
    """The settings that make a task of a scene which RCS has registered with Gymnasium."""

    id: str  # Gymnasium's id of the scene
    module: str | None  # module that registers it; None if the user names it
    protocol: BenchmarkProtocol | None = None  # None: the user sets `max_steps`
    control_mode: ControlMode = "joints"  # of an action, absolute by default
    control_hz: float = 30.0
    instruction: str = ""  # used if the simulator's info has none
    prepare: Callable[[Any], None] = lambda _config: None  # puts the task into RCS's configuration of a scene without


def _pick(config: Any) -> None:
    config.task_cfg = require("rcs.envs.tasks").PickTaskConfig(robot_name=next(iter(config.robot_cfgs)))


RCS_TASKS = {
    "pick": RcsTask(
        id="rcs/fr3",
        module="rcs.envs.configs",
        protocol=BenchmarkProtocol(
            name="RCS pick",
            source="rcs-core 0.7.3, rcs/envs/tasks.py, for the task; it states neither rate nor step limit: ours",
            max_steps=300,
            control_hz=30.0,
            control="tquat",
            success="the cuboid's middle is 7.8 cm or more above the robot's base, and the gripper is neither open "
            "nor closed",
            begins="the cuboid's place in a square of 20 cm, 50 cm in front of the robot, and its turn: the seed's",
            ends_on_success=True,
        ),
        control_mode="tquat",
        instruction="pick up the green cuboid",
        prepare=_pick,
    )
}

_DUOBENCH = BenchmarkProtocol(
    name="DuoBench",
    source="DuoBench 0.1.2, README, 'Evaluation Environment' (arXiv 2606.11901); it states no step limit: ours",
    max_steps=900,
    control_hz=30.0,
    control="joints",
    success="the task's last stage has been reached; stages are not lost again",
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


RECORD = "record/"  # before a camera's name: its view for the record

# Where this one is not, `import rcs` and `import duobench` download all assets (rcs-core 0.7.3, rcs/__init__.py).
_REQUIRED = Path("assets/scenes/empty_world/scene.xml")


@dataclass(frozen=True, slots=True)
class _Assets:
    """The location of a package's assets, and their download."""

    variable: str  # variable that names their folder
    folder: str  # in the home folder, if the variable is not set
    cure: str = ""  # further steps beside `import`


_ASSETS = {
    "rcs": _Assets("RCS_PREFIX", ".rcs"),
    "duobench": _Assets(
        "DUOBENCH_PREFIX",
        ".duobench",
        f", then make {_REQUIRED} there, empty: DuoBench 0.1.2 has none, and each import would fetch all again",
    ),
}


def missing(*packages: str) -> str | None:
    """Say why the packages, "rcs" or "duobench", cannot be imported here without a download; None if they can."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            return (
                f"{package} is not installed; make an environment, `vlagents-ray env make requirements/rcs.txt`, and "
                f"have the workers run in it: runtime_env: {{py_executable: /path/to/.venv-rcs/bin/python}}"
            )
        assets = _ASSETS[package]
        prefix = Path(os.environ.get(assets.variable) or Path.home() / assets.folder).expanduser()
        if not (prefix / _REQUIRED).is_file():
            return (
                f"{package}'s assets are not in {prefix}: there is no {_REQUIRED}; set {assets.variable} to the folder "
                f"that holds its `assets`, or fetch them once by `python -c 'import {package}'`{assets.cure}"
            )
    return None


def creator(task: RcsTask, name: str) -> Any:
    """RCS's maker of the scene that `task` names; `name` is the env's own, for messages.

    Raises `MissingDependency` where RCS would download, and `UnknownEnv` or `ConfigError` for an id of something else.
    """
    reason = missing("rcs", *({"duobench"} & {task.id.partition("/")[0]}))
    if reason is not None:
        raise MissingDependency(f"{name}: {reason}")
    require(task.module or task.id.partition("/")[0])
    rcs = require("rcs")
    # DuoBench registers another scene under this name when it is imported; no episode may depend on that
    rcs.SCENE_PATHS["empty_world"] = str(Path(rcs.RCS_PREFIX) / _REQUIRED)
    gymnasium = require("gymnasium")
    if task.id not in gymnasium.registry:
        raise UnknownEnv(f"{name}: Gymnasium knows no {task.id!r}; set `module` to what registers it")
    made = gymnasium.registry[task.id].entry_point
    if not hasattr(made, "create_env"):
        raise ConfigError(f"{name}: {task.id!r} is no scene of RCS: want one whose entry point is an RCSEnvCreator")
    return made


def configure(
    config: Any,
    *,
    env: str,
    control_mode: ControlMode,
    delta: bool,
    control_hz: float,
    binary_gripper: bool,
    size: Size,
    cameras: Sequence[str] | None,
    record_size: Size | None,
) -> None:
    """Set up a scene's configuration for an evaluation; sizes are (height, width) in pixels.

    `env` is the env's name, for messages. The simulation runs without a window, as fast as it can, and for
    1 / `control_hz` s a step, whether or not the arms have arrived.
    """
    base = require("rcs.envs.base")
    config.headless = True
    config.sim_cfg.realtime = False
    config.sim_cfg.async_control = True
    config.sim_cfg.frequency = control_hz
    config.control_mode = {
        "joints": base.ControlMode.JOINTS,
        "xyzrpy": base.ControlMode.CARTESIAN_TRPY,
        "tquat": base.ControlMode.CARTESIAN_TQuat,
    }[control_mode]
    config.relative_to = base.RelativeTo.LAST_STEP if delta else base.RelativeTo.NONE
    config.max_relative_movement = None  # RCS's own: none for absolute commands; 0.5 m, 90 degrees, 5 degrees a joint
    config.wrapper_cfg.binary_gripper = binary_gripper
    have = config.camera_cfgs or {}
    require_cameras(env, cameras or (), have)
    chosen = {name: have[name] for name in (have if cameras is None else cameras)}
    views = {name: _sized(camera, size) for name, camera in chosen.items()}
    if record_size is not None:
        views |= {RECORD + name: _sized(camera, record_size) for name, camera in chosen.items()}
    config.camera_cfgs = views or None
    if config.camera_adds is not None:
        config.camera_adds = {name: added for name, added in config.camera_adds.items() if name in chosen}


def _sized(camera: Any, size: Size) -> Any:
    camera = copy.copy(camera)
    camera.resolution_height, camera.resolution_width = size
    return camera
