"""ManiSkill's tasks in words, and the construction of its environments in processes without a terminal."""

from __future__ import annotations

import contextlib
import functools
import gc
import io
import logging
import re
import sys
import warnings
from collections.abc import Iterator
from typing import Any

from vlagents_ray.envs.rendering.graphics import prepare_rendering
from vlagents_ray.envs.rendering.render_probe import vulkan_cure
from vlagents_ray.errors import ConfigError, EnvFailed, UnknownEnv
from vlagents_ray.registry import require

DEFAULT_CONTROL_MODE = "pd_ee_delta_pose"

# The tasks whose assets come with the package.
INSTRUCTIONS: dict[str, str] = {
    "LiftPegUpright-v1": "lift the peg and stand it upright on the table",
    "PegInsertionSide-v1": "pick up the peg and insert its orange end into the hole in the box",
    "PickCube-v1": "pick up the red cube and move it to the goal",
    "PlugCharger-v1": "pick up the charger and plug it into the receptacle",
    "PokeCube-v1": "poke the cube with the peg and push it onto the red and white target",
    "PullCube-v1": "pull the cube onto the red and white target",
    "PullCubeTool-v1": "pick up the L-shaped tool and pull the cube towards the robot with it",
    "PushCube-v1": "push the cube onto the red and white target",
    "PushT-v1": "push the T-shaped block onto the T-shaped target",
    "RollBall-v1": "roll the ball onto the red and white target",
    "StackCube-v1": "pick up the red cube and stack it on the green cube",
}


def instruction_for(task: str) -> str:
    """The task's instruction; for a task not in `INSTRUCTIONS` its name in words.

    "PickSingleYCB-v1" becomes "pick single ycb".
    """
    if task in INSTRUCTIONS:
        return INSTRUCTIONS[task]
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", re.sub(r"-v\d+$", "", task))
    return " ".join(words).lower()


def registered_limit(task: str) -> int | None:
    """The step limit that ManiSkill registers for `task`; imports ManiSkill and readies the process for it."""
    prepare_rendering()
    require("sapien")
    require("mani_skill.envs")
    _prepare_process()
    registered = require("mani_skill.utils.registration").REGISTERED_ENVS
    if task not in registered:
        raise UnknownEnv(f"maniskill has no task {task!r}: want one of {sorted(INSTRUCTIONS)}, or another of its ids")
    limit: int | None = registered[task].max_episode_steps
    return limit


def step_limit(env: str, wanted: int | None, own: int | None) -> int:
    """`wanted`, or `own`, which is the task's; `ConfigError` if there is none."""
    limit = own if wanted is None else wanted
    if limit is None:
        raise ConfigError(f"{env} has no step limit of its own; set max_steps")
    if limit < 1:
        raise ConfigError(f"{env}: max_steps is {limit}, want at least 1")
    return limit


def sensor_settings(env: str, width: int, height: int, shader: str | None) -> dict[str, Any]:
    """ManiSkill's settings of all cameras; a shader of None is the task's own."""
    for name, value in (("width", width), ("height", height)):
        if value < 1:
            raise ConfigError(f"{env}: {name} is {value}, want at least 1")
    return {"width": width, "height": height} | ({"shader_pack": shader} if shader else {})


def render_backend(wanted: str) -> str:
    """`wanted`, or for "auto" the GPU if SAPIEN can render there and torch can wait for it, else the CPU."""
    if wanted != "auto":
        return wanted
    try:
        require("sapien").Device("cuda")
    except RuntimeError:  # how SAPIEN says that there is none
        return "cpu"
    return "gpu" if require("torch").cuda.is_available() else "cpu"


def make(task: str, control_mode: str | None, *, sim_backend: str, render_backend: str, **options: Any) -> Any:
    """The bare environment, without Gymnasium's wrappers; options that are None are left to ManiSkill.

    `control_mode` None is the default one, or the robot's own if it lacks that. Raises `ConfigError`
    for a control mode that the robot lacks, else `EnvFailed`.
    """
    given = {name: value for name, value in options.items() if value is not None}
    given |= {"sim_backend": sim_backend, "render_backend": render_backend}
    gymnasium = require("gymnasium")
    with _no_prompts(task), _named_errors(task), warnings.catch_warnings():
        # the digital twin of the cubes makes a tensor from a list of arrays: 24 rows, once
        warnings.filterwarnings("ignore", "Creating a tensor from a list of numpy", UserWarning)
        _keep_renderer(sim_backend, render_backend)
        try:
            return gymnasium.make(task, control_mode=control_mode or DEFAULT_CONTROL_MODE, **given).unwrapped
        except AssertionError as error:
            if "not in supported modes" not in str(error):
                raise
            if control_mode is not None:
                raise ConfigError(f"maniskill/{task}: control_mode {error}") from error
        return gymnasium.make(task, **given).unwrapped


@contextlib.contextmanager
def _named_errors(task: str) -> Iterator[None]:
    try:
        yield
    except ConfigError:
        raise
    except Exception as error:
        about_vulkan = re.search(r"vk::|rendering device|Vulkan", str(error))
        cure = f"; {vulkan_cure()}" if about_vulkan else ""
        raise EnvFailed(f"maniskill/{task} could not be made: {type(error).__name__}: {error}{cure}") from error


@contextlib.contextmanager
def _no_prompts(task: str) -> Iterator[None]:
    """ManiSkill asks on stdin whether to download missing assets, and exits when the answer is no."""
    output = io.StringIO()
    stdin, sys.stdin = sys.stdin, io.StringIO("n\n")
    try:
        with contextlib.redirect_stdout(output):
            yield
    except SystemExit as error:
        lacks = next((line for line in output.getvalue().splitlines() if "found" in line), "it did not say which")
        robot = re.match(r"Robot (\S+) ", lacks)
        raise EnvFailed(
            f"maniskill/{task}: assets are missing ({lacks.partition(' Would you')[0]}); download them with: "
            f"python -m mani_skill.utils.download_asset {robot[1] if robot else task}"
        ) from error
    finally:
        sys.stdin = stdin
        sys.stdout.write(output.getvalue())


@functools.cache
def _prepare_process() -> None:
    """Once a process: make rebuilding a scene cheap, and keep repeated warnings out of the log."""
    # ManiSkill collects garbage at each reconfiguration. Most of that time, 150 ms, goes into
    # looking at the modules just imported, which are not garbage.
    gc.collect()
    gc.freeze()
    logging.getLogger("mani_skill ").addFilter(_not_about_its_own_code)  # the name ends with a space


@functools.cache
def _keep_renderer(sim_backend: str, render_backend: str) -> object:
    """Hold one renderer for the life of the process.

    SAPIEN gives its device and compiled shaders back with the last scene that uses them; making the
    next environment would cost 5 s again, instead of 0.1 s.
    """
    import sapien.render

    parse = require("mani_skill.envs.utils.system.backend").parse_sim_and_render_backend
    device = parse(sim_backend, render_backend).render_device
    return None if device is None else sapien.render.RenderSystem(device)


def _not_about_its_own_code(record: logging.LogRecord) -> bool:
    """Some tasks and robots warn so in each reconfiguration: nothing a user could change."""
    return not record.getMessage().startswith(("No initial pose set for ", "Mimic targets dictionary is missing"))
