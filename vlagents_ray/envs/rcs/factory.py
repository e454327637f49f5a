"""Finds RCS's packages and assets without ever downloading, and configures its scenes."""

from __future__ import annotations

import copy
import importlib.util
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vlagents_ray.envs.rcs.tasks import ControlMode, RcsTask
from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.errors import ConfigError, MissingDependency, UnknownEnv
from vlagents_ray.registry import require

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
    prepare_rendering()
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
    control_mode: ControlMode,
    delta: bool,
    control_hz: float,
    binary_gripper: bool,
    size: tuple[int, int],
    cameras: Sequence[str] | None,
    record_size: tuple[int, int] | None,
) -> None:
    """Set up a scene's configuration for an evaluation; sizes are (height, width) in pixels.

    The simulation runs without a window, as fast as it can, and for 1 / `control_hz` s a step, whether
    or not the arms have arrived.
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
    unknown = sorted(set(cameras or ()) - set(have))
    if unknown:
        raise ConfigError(f"the scene has no camera {unknown}: want some of {sorted(have)}")
    chosen = {name: have[name] for name in (have if cameras is None else cameras)}
    views = {name: _sized(camera, size) for name, camera in chosen.items()}
    if record_size is not None:
        views |= {RECORD + name: _sized(camera, record_size) for name, camera in chosen.items()}
    config.camera_cfgs = views or None
    if config.camera_adds is not None:
        config.camera_adds = {name: added for name, added in config.camera_adds.items() if name in chosen}


def _sized(camera: Any, size: tuple[int, int]) -> Any:
    camera = copy.copy(camera)
    camera.resolution_height, camera.resolution_width = size
    return camera
